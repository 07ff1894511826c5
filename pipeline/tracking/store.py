"""The way to a tracking store, in silence: its client and the experiment in it, and the pages of a study's trials.

An SQLite file is made once, in one piece.
"""

from __future__ import annotations

import errno
import logging
import math
import os
import sqlite3
import warnings
from collections.abc import Iterator
from contextlib import ExitStack, closing, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from pipeline.errors import StorageError
from pipeline.processes import run_within
from pipeline.tracking.entries import clean_name

if TYPE_CHECKING:
    from mlflow import MlflowClient

    from pipeline.config.schema import TrackingConfig

_SQLITE = "sqlite:///"


@contextmanager
def quiet_mlflow(timeout_seconds: float) -> Iterator[None]:
    """MLflow is imported, silent, and gives up on a server after ``timeout_seconds`` (s) while this lasts.

    Environment, log levels and warning filters are the process's own: one such block at a time, and nothing
    but logging in it. Telemetry stays off afterwards.

    :raises ImportError: if MLflow is not installed
    """
    from unittest.mock import patch  # it imports asyncio

    os.environ["MLFLOW_DISABLE_TELEMETRY"] = "true"
    os.environ["DO_NOT_TRACK"] = "1"
    environment = {
        # One retry, so each of the two attempts may take half of the time.
        "MLFLOW_HTTP_REQUEST_TIMEOUT": str(max(1, math.floor(timeout_seconds / 2))),
        "MLFLOW_HTTP_REQUEST_MAX_RETRIES": "1",
        "MLFLOW_SUPPRESS_PRINTING_URL_TO_STDOUT": "true",
        "MLFLOW_ENABLE_ARTIFACTS_PROGRESS_BAR": "false",
        "MLFLOW_UV_AUTO_DETECT": "false",
    }
    # MLflow uses deprecated parts of SQLAlchemy, which a user can't change. A warning that is raised as an error while
    # SQLAlchemy sets up its classes would leave them broken for the whole process.
    with patch.dict(os.environ, environment), warnings.catch_warnings(action="ignore"), ExitStack() as put_back:
        import mlflow  # noqa: F401  # for its effect: it sets the levels of these loggers when it is imported

        for logger in map(logging.getLogger, ("mlflow", "alembic", "sqlalchemy.engine", "urllib3.connectionpool")):
            put_back.callback(logger.setLevel, logger.level)
            logger.setLevel(logging.CRITICAL + 1)
        yield


def open_experiment(settings: TrackingConfig, name: str) -> tuple[MlflowClient, str]:
    """A client of the store and the id of the experiment ``name`` in it, both made where they are missing.

    :raises StorageError: if an SQLite file can't be used
    :raises TimeoutError: if a server or another database gives no answer within the settings' time
    :raises mlflow.exceptions.MlflowException: if the store refuses
    """
    # MLflow takes an empty URI for a database in the working directory.
    if settings.uri.startswith("sqlite:") or not settings.uri:
        database = settings.uri.removeprefix(_SQLITE)
        if not settings.uri.startswith(_SQLITE) or database in ("", ":memory:") or "?" in database:
            raise StorageError(
                f"'{settings.uri}' names no SQLite file; write sqlite:///FILE (relative) or sqlite:////FOLDER/FILE"
            )
        path = Path(database).absolute()
        prepare_database(path, settings.timeout_seconds)
        location = f"{_locate_artifacts(path)}/{clean_name(name).replace('/', '_')}"
        return _open(f"{_SQLITE}{path}", name, location)
    # Neither the look-up of a host's name nor MLflow's retries for a database heed a time limit of their own.
    return run_within(settings.timeout_seconds, lambda: _open(settings.uri, name, None))


def _open(uri: str, name: str, artifact_location: str | None) -> tuple[MlflowClient, str]:
    from mlflow import MlflowClient
    from mlflow.exceptions import MlflowException

    client = MlflowClient(tracking_uri=uri, registry_uri=uri)
    try:
        # Not asked for first: another process may make it between two calls.
        return client, client.create_experiment(name, artifact_location)
    except MlflowException as error:
        experiment = client.get_experiment_by_name(name) if error.error_code == "RESOURCE_ALREADY_EXISTS" else None
        if not experiment:
            raise
    if experiment.lifecycle_stage != "active":
        raise MlflowException(
            f"the experiment '{name}' was deleted there; "
            f"'mlflow experiments restore -x {experiment.experiment_id}' brings it back"
        )
    return client, experiment.experiment_id


def prepare_database(path: Path, timeout_seconds: float, creation_seconds: float = 60.0) -> None:
    """Make MLflow's database ``path`` where there is none, and see that it can be written.

    Safe in several processes at once. The database is filled under another name and then renamed, so that
    neither a second process nor a kill ever leaves a half-made one. A file ``<path>-lock`` stays beside it.

    :param timeout_seconds: how long another process may hold the database (s)
    :param creation_seconds: how long it may take to make it (s)
    :raises StorageError: if it can't be made, read or written
    """
    import filelock

    try:
        if not _is_filled(path):
            path.parent.mkdir(parents=True, exist_ok=True)
            with filelock.FileLock(f"{path}-lock", timeout=max(creation_seconds, timeout_seconds)):
                if not _is_filled(path):
                    _create(path)
        _probe(path, timeout_seconds)
    except filelock.Timeout:
        raise StorageError(f"another process has held {path}-lock for too long; end it and run again") from None
    except sqlite3.OperationalError as error:
        raise StorageError(f"the database {path} can't be written ({error}); is it in use, or read-only?") from error
    except sqlite3.DatabaseError as error:
        raise StorageError(
            f"{path} is not a sound SQLite database ({error}); move it away, the next run makes a new one"
        ) from error
    except (OSError, NotImplementedError) as error:  # filelock raises the latter where a file system has no locks
        reason = getattr(error, "strerror", None) or error
        raise StorageError(f"the database {path} can't be made there ({reason})") from error


def _locate_artifacts(path: Path) -> str:
    """The URI of the folder, beside the database ``path``, for the artifacts of its runs."""
    return (path.parent / "mlruns").as_uri()


def _is_filled(path: Path) -> bool:
    if path.is_dir():
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR))
    return path.is_file() and path.stat().st_size > 0


def _create(path: Path) -> None:
    from mlflow.store.tracking.sqlalchemy_store import SqlAlchemyStore

    unfinished = path.with_name(f"{path.name}-new-{os.getpid()}")
    try:
        store = SqlAlchemyStore(f"{_SQLITE}{unfinished}", _locate_artifacts(path))
        store.engine.dispose()
        os.replace(unfinished, path)
    finally:
        unfinished.unlink(missing_ok=True)


def _probe(path: Path, timeout_seconds: float) -> None:
    """Lock the database for writing once: MLflow itself would retry for minutes where that can't be done."""
    with closing(sqlite3.connect(path, timeout=timeout_seconds, isolation_level=None)) as connection:
        connection.execute("BEGIN IMMEDIATE")
        tables = {name for (name,) in connection.execute("SELECT name FROM sqlite_master WHERE type = 'table'")}
        connection.execute("ROLLBACK")
    if not {"alembic_version", "experiments", "runs"} <= tables:
        raise StorageError(f"{path} is a database, but not MLflow's; move it away or give another tracking.uri")
