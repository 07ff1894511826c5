"""From one record to one MLflow run; whatever fails on the way becomes a sentence."""

from __future__ import annotations

import re
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

from pipeline.errors import without_password
from pipeline.tracking.beside import log_beside
from pipeline.tracking.entries import (
    MetricValue,
    collect_final,
    collect_history,
    flatten_parameters,
    flatten_tags,
    shorten,
    simplify,
)
from pipeline.tracking.model import log_model
from pipeline.tracking.provenance import describe_provenance
from pipeline.tracking.quiet import quiet_mlflow
from pipeline.tracking.record import StageRecord
from pipeline.tracking.store import DatabaseProblem, open_experiment

if TYPE_CHECKING:
    from mlflow import MlflowClient
    from mlflow.entities import Run

    from pipeline.config.schema import TrackingConfig

_T = TypeVar("_T")
_METRICS_A_BATCH = 1000
_PARAMETERS_A_BATCH = 100
_FIGURES = {".png", ".svg", ".jpg", ".jpeg"}
_REASON_LENGTH = 300


def track(record: StageRecord, settings: TrackingConfig) -> list[str]:
    """Log ``record`` as one finished run of the MLflow experiment ``record.experiment``.

    :returns: sentences that say what was not logged and why; empty when all was, or when not enabled
    :raises KeyboardInterrupt: the run is then marked as killed; nothing else is raised
    """
    if not settings.enabled:
        return []
    told = log_beside(record, settings)
    if told is not None:
        return told
    try:
        with quiet_mlflow(settings.timeout_seconds):
            return _log(record, settings)
    except Exception as error:
        place = without_password(settings.uri)
        return [
            f"Stage '{record.stage}' of '{record.experiment}' is not in MLflow ({place}): {_tell_reason(error)}. "
            "Its files are kept. Check tracking.uri, or switch tracking off with tracking.enabled=false."
        ]


def get_ready() -> None:
    """Import what :func:`track` uses, which takes seconds."""
    with suppress(Exception), quiet_mlflow(1.0):  # what can't be imported is told with the record
        from mlflow import MlflowClient, pyfunc  # noqa: F401  # so that `track` finds them imported
        from mlflow.store.tracking.sqlalchemy_store import SqlAlchemyStore  # noqa: F401  # behind the client


def _log(record: StageRecord, settings: TrackingConfig) -> list[str]:
    client, experiment_id = open_experiment(settings, record.experiment)
    run = client.create_run(
        experiment_id, start_time=round(1000 * record.started), tags=_make_tags(record), run_name=record.stage
    )
    run_id = run.info.run_id
    try:
        problems = _log_parts(client, run, record, settings.timeout_seconds)
    except BaseException as error:
        with suppress(Exception):
            client.set_terminated(run_id, "KILLED" if isinstance(error, KeyboardInterrupt) else "FAILED")
        raise
    try:
        client.set_terminated(run_id, record.status, end_time=round(1000 * record.ended))
    except Exception as error:
        problems.append(f"MLflow does not know that stage '{record.stage}' has ended: {_tell_reason(error)}.")
    return problems


def _make_tags(record: StageRecord) -> dict[str, str]:
    place = {"pipeline.experiment": record.experiment, "pipeline.stage": record.stage}
    return flatten_tags(describe_provenance() | place | dict(record.tags))


def _log_parts(client: MlflowClient, run: Run, record: StageRecord, patience_seconds: float) -> list[str]:
    run_id = run.info.run_id
    parts = _Parts(record.stage, patience_seconds)
    not_finite: list[str] = []
    final = partial(collect_final, record.metrics, record.ended)
    history = partial(collect_history, record.history, record.started, record.ended)

    parts.log("the parameters", lambda: _log_parameters(client, run_id, record))
    parts.log("the configuration", lambda: client.log_text(run_id, _write_yaml(record), "config.yaml"))
    # The model comes before the metrics, which belong to it too.
    model_id = parts.log("the model", partial(log_model, client, run, record)) if record.model else None
    not_finite += parts.log("the metrics", lambda: _log_metrics(client, run_id, final(), model_id)) or []
    not_finite += parts.log("the history", lambda: _log_metrics(client, run_id, history())) or []
    for path, artifact_folder in _sort_files(record.files):
        parts.log(f"the file {path}", partial(_log_file, client, run_id, path, artifact_folder))
    for child in record.children:
        parts.log(child.stage, partial(_log_child, client, run, record, child))
    if not_finite:
        names = ", ".join(dict.fromkeys(not_finite))
        parts.problems.append(f"MLflow does not have the values of {names} that are not finite.")
    if parts.not_tried:
        names = ", ".join(parts.not_tried)
        parts.problems.append(f"MLflow took too long to answer, so these were not tried: {names}.")
    return parts.problems


class _Parts:
    """It logs each part by itself, until the parts that failed have taken ``patience_seconds`` together."""

    def __init__(self, stage: str, patience_seconds: float) -> None:
        self.problems: list[str] = []
        self.not_tried: list[str] = []
        self._stage = stage
        self._patience_seconds = patience_seconds

    def log(self, what: str, action: Callable[[], _T]) -> _T | None:
        """What ``action`` returns; None where it failed or was not tried, and that is noted."""
        if self._patience_seconds <= 0:
            self.not_tried.append(what)
            return None
        begin = time.monotonic()
        try:
            return action()
        except Exception as error:
            self._patience_seconds -= time.monotonic() - begin
            self.problems.append(f"MLflow does not have {what} of stage '{self._stage}': {_tell_reason(error)}.")
            return None


def _log_parameters(client: MlflowClient, run_id: str, record: StageRecord) -> None:
    from mlflow.entities import Param
    from mlflow.utils import chunk_list

    parameters = [Param(name, text) for name, text in flatten_parameters(record.parameters).items()]
    for batch in chunk_list(parameters, _PARAMETERS_A_BATCH):
        client.log_batch(run_id, params=batch)


def _write_yaml(record: StageRecord) -> str:
    import yaml

    return without_password(yaml.safe_dump(simplify(record.parameters), sort_keys=False, allow_unicode=True))


def _log_metrics(
    client: MlflowClient, run_id: str, found: tuple[list[MetricValue], list[str]], model_id: str | None = None
) -> list[str]:
    """Log the values that were ``found``; the names of those that are not finite."""
    from mlflow.entities import Metric
    from mlflow.utils import chunk_list

    values, not_finite = found
    for batch in chunk_list([Metric(*value, model_id=model_id, run_id=run_id) for value in values], _METRICS_A_BATCH):
        client.log_batch(run_id, metrics=batch)
    return not_finite


def _log_child(client: MlflowClient, run: Run, record: StageRecord, child: StageRecord) -> None:
    """Log a run below ``run`` in three requests, since a study has many."""
    from mlflow.entities import Metric, Param

    place = {"pipeline.experiment": record.experiment, "pipeline.stage": record.stage}
    tags = flatten_tags(place | dict(child.tags) | {"mlflow.parentRunId": run.info.run_id})
    below = client.create_run(
        run.info.experiment_id, start_time=round(1000 * child.started), tags=tags, run_name=child.stage
    ).info.run_id
    values = collect_final(child.metrics, child.ended)[0]
    values += collect_history(child.history, child.started, child.ended)[0]
    metrics = [Metric(*value) for value in values[:_METRICS_A_BATCH]]
    parameters = [Param(name, text) for name, text in flatten_parameters(child.parameters).items()]
    client.log_batch(below, metrics=metrics, params=parameters[:_PARAMETERS_A_BATCH])
    client.set_terminated(below, child.status, end_time=round(1000 * child.ended))


def _log_file(client: MlflowClient, run_id: str, path: Path, folder: str) -> None:
    if not path.is_file():
        raise FileNotFoundError("there is no such file")
    client.log_artifact(run_id, str(path), folder)


def _sort_files(files: Sequence[Path]) -> Iterator[tuple[Path, str]]:
    """Each file with its artifact folder; a second file of one name goes below its own folder's name."""
    taken: set[tuple[str, str]] = set()
    for path in files:
        folder = "figures" if path.suffix.lower() in _FIGURES else "files"
        if (folder, path.name) in taken:
            folder = f"{folder}/{path.parent.name}"
        taken.add((folder, path.name))
        yield path, folder


def _tell_reason(error: Exception) -> str:
    """The main part of an error's text, on one line, without passwords."""
    text = " ".join(str(error).split()) or type(error).__name__
    system = re.search(r"\[Errno -?\d+\] ([\w ]+)", text)
    if system and "Max retries exceeded" in text:
        text = f"the server can't be reached ({system.group(1).strip().lower()})"
    if not isinstance(error, DatabaseProblem):
        text = shorten(text, _REASON_LENGTH)
    return without_password(text).rstrip(".")
