"""How long a server or a database that does not answer is waited for, against what the configuration says."""

from __future__ import annotations

import socket
import sqlite3
import time
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from tempfile import TemporaryDirectory

from benchmarks.measure import BENCHMARKS, Action, Aim, Times, seconds

_TURNS = 3


@BENCHMARKS.add("unreachable_tracking_server", "a refused MLflow server", "timeout_seconds of 2 s", Aim(1.5))
def unreachable_tracking_server() -> Times:
    """Nobody listens at the port."""
    return _waits(lambda: _track("http://127.0.0.1:9", 2.0), 2.0)


@BENCHMARKS.add("silent_tracking_server", "an MLflow server that never answers", "timeout_seconds of 1 s", Aim(1.5))
def silent_tracking_server() -> Times:
    """The connection is taken, and nothing is said."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        uri = f"http://127.0.0.1:{server.getsockname()[1]}"
        return _waits(lambda: _track(uri, 1.0), 1.0)


@BENCHMARKS.add("locked_tracking_database", "a locked MLflow database", "timeout_seconds of 0.2 s", Aim(2))
def locked_tracking_database() -> Times:
    """Another process writes to it."""
    with TemporaryDirectory() as folder:
        path = Path(folder) / "mlflow.db"
        _track(f"sqlite:///{path}", 30.0)
        with closing(sqlite3.connect(path, isolation_level=None)) as other:
            other.execute("BEGIN IMMEDIATE")
            return _waits(lambda: _track(f"sqlite:///{path}", 0.2), 0.2)


@BENCHMARKS.add("silent_study_database", "a study database that never answers", "tuning.timeout_seconds of 3 s", Aim(2))
def silent_study_database() -> Times:
    """The connection is taken, and nothing is said."""
    with closing(socket.create_server(("127.0.0.1", 0))) as server:
        return _waits(_refused_study(f"127.0.0.1:{server.getsockname()[1]}", 3.0), 3.0)


@BENCHMARKS.add("refused_study_database", "a refused study database", "tuning.timeout_seconds of 4 s", Aim(1.5))
def refused_study_database() -> Times:
    """Nobody listens at the port."""
    return _waits(_refused_study("127.0.0.1:1", 4.0), 4.0)


def _waits(action: Action, patience: float) -> Times:
    action()  # imports what it needs
    return Times([seconds(action) for _ in range(_TURNS)], [patience] * _TURNS)


def _track(uri: str, patience: float) -> list[str]:
    from pipeline.config.schema import TrackingConfig
    from pipeline.tracking import StageRecord, track

    record = StageRecord(experiment="rig", stage="train", started=time.time() - 1, ended=time.time())
    return track(record, TrackingConfig(enabled=True, uri=uri, timeout_seconds=patience))


def _refused_study(place: str, patience: float) -> Callable[[], None]:
    from benchmarks.machines import machine
    from pipeline.config.compose import compose_config
    from pipeline.errors import StorageError
    from pipeline.tuning.study import StudyProblem
    from pipeline.tuning.worker import run_study

    made = machine("experiment=ball_bearing")
    storage = f"tuning.storage='postgresql+psycopg://me@{place}/x'"
    config = compose_config(["stage=tune", "experiment=ball_bearing", storage, f"tuning.timeout_seconds={patience}"])
    problem = StudyProblem(config, made.measurement)

    def run() -> None:
        try:
            run_study(problem, lambda _: None)
        except StorageError:
            return
        raise RuntimeError(f"a study at {place} must be refused, but it ran")

    return run
