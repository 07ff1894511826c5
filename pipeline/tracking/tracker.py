"""From one record to one MLflow run; whatever fails on the way becomes a sentence.

MLflow is in a process of its own, which imports it while the stage computes: the command then hardly waits for it.
Measured on two cores, ball_bearing: `stage=train` takes 5.7 s with it and 7.2 s without; `stage=evaluate` 11.5 s and
17 s beside other programs, of which the processor worked 5.7 s and 7.3 s. A process that is lost is done without.
"""

from __future__ import annotations

import gc
import json
import os
import re
import signal
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from functools import partial
from multiprocessing import get_context
from multiprocessing.connection import Client, Connection
from pathlib import Path
from typing import TYPE_CHECKING, NoReturn

from pipeline.errors import StorageError, without_password
from pipeline.processes import delay_interrupt, let_interrupt_through
from pipeline.tracking.entries import (
    NAME_LENGTH,
    RUNNING,
    MetricValue,
    StageRecord,
    collect_history,
    collect_values,
    describe_provenance,
    flatten_parameters,
    flatten_tags,
    shorten,
    simplify,
)
from pipeline.tracking.model import log_model
from pipeline.tracking.store import open_experiment, quiet_mlflow

if TYPE_CHECKING:
    from mlflow import MlflowClient
    from mlflow.entities import Run

    from pipeline.config.schema import TrackingConfig

SHARED = "PIPELINE_RECORDER"
"""Where the recorder listens that the commands of `docs/recorder.py` share."""

_running: list[tuple[int, Connection]] = []
"""The process beside, and the way to it."""
_begun: dict[tuple[str, str], tuple[MlflowClient, Run, set[str]]] = {}
"""By experiment and stage: the run of a stage that still runs, and which of its children it has."""


@contextmanager
def recorder_beside(enabled: bool) -> Iterator[None]:
    """Stages of the block are logged by another process, which is ready when the first of them ends."""
    with ExitStack() as ends:
        if enabled:
            _running.append(_ask_shared(ends) or _start(ends))
            ends.callback(_running.pop)
        yield


def _ask_shared(ends: ExitStack) -> tuple[int, Connection] | None:
    """A process that has imported MLflow already, if commands share it."""
    with suppress(KeyError, OSError, EOFError):
        near = ends.enter_context(Client(os.environ[SHARED], "AF_UNIX"))
        near.send((os.getcwd(), dict(os.environ)))
        return near.recv(), near
    return None


def _start(ends: ExitStack) -> tuple[int, Connection]:
    context = get_context("spawn")
    near, far = context.Pipe()
    process = context.Process(target=_import_and_serve, args=(far,), daemon=True)
    with delay_interrupt():
        process.start()
    far.close()
    ends.callback(process.join)
    ends.callback(near.close)  # first: it ends then
    return process.pid or 0, near


def _import_and_serve(connection: Connection) -> None:
    become_silent()
    import_mlflow()
    serve(connection)


def become_silent() -> None:
    """Ctrl-C is for the stage, whose record then says so; what MLflow prints is for nobody."""
    os.setsid()
    let_interrupt_through()
    for stream in (sys.stdout, sys.stderr):
        os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())


def import_mlflow() -> None:
    """So that :func:`track` finds it imported; what can't be imported is told with the record."""
    gc.set_threshold(100_000, 50, 100)  # as for the stage: looking through its objects is a fifth of the import
    with suppress(Exception), quiet_mlflow(1.0):
        from mlflow import MlflowClient, pyfunc  # noqa: F401  # in time for :func:`track`
        from mlflow.store.tracking.sqlalchemy_store import SqlAlchemyStore  # noqa: F401  # behind the client


def serve(connection: Connection) -> NoReturn:
    """Log what comes until the other end is closed."""
    try:
        while True:
            record, settings = connection.recv()
            sentences = track(record, settings)
            if record.status != RUNNING:
                connection.send(sentences)
    except (KeyboardInterrupt, OSError, EOFError):
        for client, run, _ in _begun.values():  # of a stage that was interrupted
            with suppress(Exception):
                client.set_terminated(run.info.run_id, "KILLED")
        os._exit(0)  # taking MLflow down in order takes a while, and the command waits for it


def hand_over(record: StageRecord, settings: TrackingConfig) -> None:
    """Log the children of a stage that still runs, without waiting for it: its last record has those that it lacks.

    Only another process does it (:func:`recorder_beside`).
    """
    if settings.enabled and _running:
        with suppress(OSError):
            _running[-1][1].send((record, settings))


def track(record: StageRecord, settings: TrackingConfig) -> list[str]:
    """Log ``record`` as one finished run of the MLflow experiment ``record.experiment``.

    :returns: sentences that say what was not logged and why; empty when all was, or when not enabled
    :raises KeyboardInterrupt: the run is then marked as killed; nothing else is raised
    """
    if not settings.enabled:
        return []
    with suppress(OSError, EOFError):  # of a process that was lost
        if _running:
            return _log_beside(record, settings)
    try:
        with quiet_mlflow(settings.timeout_seconds):
            return _log(record, settings)
    except Exception as error:
        place = without_password(settings.uri)
        return [
            f"Stage '{record.stage}' of '{record.experiment}' is not in MLflow ({place}): {_tell_reason(error)}. "
            "Its files are kept. Check tracking.uri, or switch tracking off with tracking.enabled=false."
        ]


def _log_beside(record: StageRecord, settings: TrackingConfig, patience_seconds: float = 10.0) -> list[str]:
    """Let the other process do it.

    :param patience_seconds: how long it may take to mark a run as killed
    """
    process, connection = _running[-1]
    try:
        connection.send((record, settings))
        answer: list[str] = connection.recv()
        return answer
    except KeyboardInterrupt:
        os.kill(process, signal.SIGINT)
        connection.poll(patience_seconds)  # it closes its end
        raise


def _log(record: StageRecord, settings: TrackingConfig) -> list[str]:
    key = record.experiment, record.stage
    if key not in _begun:
        client, experiment_id = open_experiment(settings, record.experiment)
        run = _begin(client, experiment_id, record, describe_provenance() | _stage_tags(record))
        _begun[key] = client, run, set()
    client, run, logged = _begun[key]
    run_id = run.info.run_id
    if record.status == RUNNING:
        for child in record.children:
            _log_child(client, run, record, child)
            logged.add(child.stage)
        return []
    del _begun[key]
    try:
        problems = _log_parts(client, run, record, settings.timeout_seconds, logged)
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


def _begin(client: MlflowClient, experiment_id: str, record: StageRecord, tags: Mapping[str, str]) -> Run:
    """A run with these tags and the record's own."""
    return client.create_run(
        experiment_id,
        start_time=round(1000 * record.started),
        tags=flatten_tags(dict(tags) | dict(record.tags)),
        run_name=shorten(record.title or record.stage, NAME_LENGTH),
    )


def _log_parts(
    client: MlflowClient, run: Run, record: StageRecord, patience_seconds: float, logged: set[str]
) -> list[str]:
    """Log each part of the record by itself, without the children ``logged``; sentences on those that are missing."""
    import yaml
    from mlflow.entities import RunTag

    run_id = run.info.run_id
    model_ids: list[str] = []
    not_finite: list[str] = []
    write = partial(yaml.safe_dump, sort_keys=False, allow_unicode=True)

    def log_metrics(collected: tuple[list[MetricValue], list[str]], *model_id: str) -> None:
        _log_values(client, run_id, collected[0], {}, *model_id)
        not_finite.extend(collected[1])

    tags = [RunTag(*tag) for tag in flatten_tags(dict(record.tags)).items() if tag[0] not in run.data.tags]
    has_data = bool(record.data and record.tags.get("data_fingerprint"))
    parts: list[tuple[str, Callable[[], object]]] = [
        *([("the tags", partial(client.log_batch, run_id, tags=tags))] if tags else []),
        ("the parameters", lambda: _log_values(client, run_id, (), record.parameters)),
        (
            "the configuration",
            lambda: client.log_text(run_id, without_password(write(simplify(record.parameters))), "config.yaml"),
        ),
        *([("the data", partial(_log_data, client, run_id, record))] if has_data else []),
        # It comes before the metrics, which belong to it too.
        *([("the model", lambda: model_ids.append(log_model(client, run, record)))] if record.model else []),
        ("the metrics", lambda: log_metrics(collect_values(record.metrics, record.ended), *model_ids)),
        ("the history", lambda: log_metrics(collect_history(record.history, record.started, record.ended))),
        *(
            (f"the file {path}", partial(client.log_artifact, run_id, str(path), folder))
            for path, folder in _sort_files(record.files)
        ),
        *(
            (child.stage, partial(_log_child, client, run, record, child))
            for child in record.children
            if child.stage not in logged
        ),
    ]
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
    from mlflow.utils.validation import MAX_METRICS_PER_BATCH, MAX_PARAMS_TAGS_PER_BATCH

    params = [Param(name, text) for name, text in flatten_parameters(parameters).items()]
    for batch in chunk_list(params, MAX_PARAMS_TAGS_PER_BATCH):
        client.log_batch(run_id, params=batch)
    for batch in chunk_list(
        [Metric(*value, model_id=model_id, run_id=run_id) for value in metrics], MAX_METRICS_PER_BATCH
    ):
        client.log_batch(run_id, metrics=batch)


def _log_data(client: MlflowClient, run_id: str, record: StageRecord) -> None:
    """The vibration as MLflow's dataset: named by its experiment, with its fingerprint for a digest."""
    from mlflow.entities import Dataset, DatasetInput, InputTag

    where = json.dumps({"uri": str(record.data)})
    data = Dataset(record.experiment, record.tags["data_fingerprint"], "local", where)
    client.log_inputs(run_id, datasets=[DatasetInput(data, [InputTag("mlflow.data.context", record.stage)])])


def _log_child(client: MlflowClient, run: Run, record: StageRecord, child: StageRecord) -> None:
    """Log a run below ``run`` in few requests, since a study has many."""
    tags = _stage_tags(record) | {"mlflow.parentRunId": run.info.run_id}
    below = _begin(client, run.info.experiment_id, child, tags).info.run_id
    final, _ = collect_values(child.metrics, child.ended)
    history, _ = collect_history(child.history, child.started, child.ended)
    _log_values(client, below, final + history, child.parameters)
    client.set_terminated(below, child.status, end_time=round(1000 * child.ended))


def _sort_files(files: Sequence[Path]) -> Iterator[tuple[Path, str]]:
    """Each file with its artifact folder; a second file of one name goes below its own folder's name."""
    taken: set[tuple[str, str]] = set()
    for path in files:
        folder = "figures" if path.suffix.lower() in (".png", ".svg", ".jpg", ".jpeg") else "files"
        if (folder, path.name) in taken:
            folder = f"{folder}/{path.parent.name}"
        taken.add((folder, path.name))
        yield path, folder


def _tell_reason(error: Exception, longest: int = 300) -> str:
    """The main part of an error's text, on one line, without passwords."""
    text = " ".join(str(error).split()) or type(error).__name__
    system = re.search(r"\[Errno -?\d+\] ([\w ]+)", text)
    if system and "Max retries exceeded" in text:
        text = f"the server can't be reached ({system.group(1).strip().lower()})"
    if not isinstance(error, StorageError):
        text = shorten(text, longest)
    return without_password(text).rstrip(".")
