"""From one record to one MLflow run; whatever fails on the way becomes a sentence."""

from __future__ import annotations

import re
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from pipeline.errors import StorageError, without_password
from pipeline.tracking.beside import log_beside
from pipeline.tracking.entries import (
    MetricValue,
    StageRecord,
    collect_history,
    collect_values,
    flatten_parameters,
    flatten_tags,
    shorten,
    simplify,
)
from pipeline.tracking.model import log_model
from pipeline.tracking.provenance import describe_provenance
from pipeline.tracking.store import open_experiment, quiet_mlflow

if TYPE_CHECKING:
    from mlflow import MlflowClient
    from mlflow.entities import Run

    from pipeline.config.schema import TrackingConfig

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
    tags = flatten_tags(describe_provenance() | _stage_tags(record) | dict(record.tags))
    start = round(1000 * record.started)
    run = client.create_run(experiment_id, start_time=start, tags=tags, run_name=record.stage)
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


def _stage_tags(record: StageRecord) -> dict[str, str]:
    """Tags by which the runs of an experiment and of a stage are looked for."""
    return {"pipeline.experiment": record.experiment, "pipeline.stage": record.stage}


def _log_parts(client: MlflowClient, run: Run, record: StageRecord, patience_seconds: float) -> list[str]:
    """Log each part of the record by itself; sentences on those that MLflow does not have."""
    run_id = run.info.run_id
    model_ids: list[str] = []
    not_finite: list[str] = []

    def log_metrics(collected: tuple[list[MetricValue], list[str]], *model_id: str) -> None:
        _log_values(client, run_id, collected[0], {}, *model_id)
        not_finite.extend(collected[1])

    parts: list[tuple[str, Callable[[], object]]] = [
        ("the parameters", lambda: _log_values(client, run_id, (), record.parameters)),
        ("the configuration", lambda: client.log_text(run_id, _write_yaml(record), "config.yaml")),
    ]
    if record.model:  # it comes before the metrics, which belong to it too
        parts.append(("the model", lambda: model_ids.append(log_model(client, run, record))))
    parts += [
        ("the metrics", lambda: log_metrics(collect_values(record.metrics, record.ended), *model_ids)),
        ("the history", lambda: log_metrics(collect_history(record.history, record.started, record.ended))),
    ]
    parts += [
        (f"the file {path}", partial(_log_file, client, run_id, path, f)) for path, f in _sort_files(record.files)
    ]
    parts += [(child.stage, partial(_log_child, client, run, record, child)) for child in record.children]
    problems = try_parts(parts, record.stage, patience_seconds)
    if not_finite:
        names = ", ".join(dict.fromkeys(not_finite))
        problems.append(f"MLflow does not have the values of {names} that are not finite.")
    return problems


def try_parts(parts: Sequence[tuple[str, Callable[[], object]]], stage: str, patience_seconds: float) -> list[str]:
    """Log each part until those that failed have taken ``patience_seconds`` together; sentences on what is missing."""
    problems, not_tried = [], []
    for name, log in parts:
        if patience_seconds <= 0:
            not_tried.append(name)
            continue
        begin = time.monotonic()
        try:
            log()
        except Exception as error:
            patience_seconds -= time.monotonic() - begin
            problems.append(f"MLflow does not have {name} of stage '{stage}': {_tell_reason(error)}.")
    if not_tried:
        problems.append(f"MLflow took too long to answer, so these were not tried: {', '.join(not_tried)}.")
    return problems


def _write_yaml(record: StageRecord) -> str:
    import yaml

    return without_password(yaml.safe_dump(simplify(record.parameters), sort_keys=False, allow_unicode=True))


def _log_values(
    client: MlflowClient,
    run_id: str,
    metrics: Sequence[MetricValue],
    parameters: Mapping[str, object],
    model_id: str | None = None,
) -> None:
    """Log metrics and parameters in as few requests as MLflow takes them in."""
    from mlflow.entities import Metric, Param
    from mlflow.utils import chunk_list

    params = [Param(name, text) for name, text in flatten_parameters(parameters).items()]
    for batch in chunk_list(params, _PARAMETERS_A_BATCH):
        client.log_batch(run_id, params=batch)
    for batch in chunk_list([Metric(*value, model_id=model_id, run_id=run_id) for value in metrics], _METRICS_A_BATCH):
        client.log_batch(run_id, metrics=batch)


def _log_child(client: MlflowClient, run: Run, record: StageRecord, child: StageRecord) -> None:
    """Log a run below ``run`` in few requests, since a study has many."""
    tags = flatten_tags(_stage_tags(record) | dict(child.tags) | {"mlflow.parentRunId": run.info.run_id})
    start = round(1000 * child.started)
    below = client.create_run(run.info.experiment_id, start_time=start, tags=tags, run_name=child.stage).info.run_id
    final, _ = collect_values(child.metrics, child.ended)
    history, _ = collect_history(child.history, child.started, child.ended)
    _log_values(client, below, final + history, child.parameters)
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
    if not isinstance(error, StorageError):
        text = shorten(text, _REASON_LENGTH)
    return without_password(text).rstrip(".")
