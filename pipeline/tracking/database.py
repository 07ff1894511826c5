"""MLflow's SQLite file: made once, by one process, in one piece."""

from __future__ import annotations

import errno
import os
import sqlite3
from contextlib import closing
from pathlib import Path

ARTIFACT_FOLDER = "mlruns"
_CREATION_SECONDS = 60.0


class DatabaseProblem(Exception):
    """A database that can't be used; the text says why and what to do."""


def prepare_database(path: Path, timeout_seconds: float) -> None:
    """Make MLflow's database ``path`` where there is none, and see that it can be written.

    Safe in several processes at once. The database is filled under another name and then renamed, so that
    neither a second process nor a kill ever leaves a half-made one. A file ``<path>-lock`` stays beside it.

    :param timeout_seconds: how long another process may hold the database (s)
    :raises DatabaseProblem: if it can't be made, read or written
    """
    import filelock

    try:
        if not _is_filled(path):
            path.parent.mkdir(parents=True, exist_ok=True)
            with filelock.FileLock(f"{path}-lock", timeout=max(_CREATION_SECONDS, timeout_seconds)):
                if not _is_filled(path):
                    _create(path)
        _probe(path, timeout_seconds)
    except filelock.Timeout:
        raise DatabaseProblem(f"another process has held {path}-lock for too long; end it and run again") from None
    except sqlite3.OperationalError as error:
        raise DatabaseProblem(f"the database {path} can't be written ({error}); is it in use, or read-only?") from error
    except sqlite3.DatabaseError as error:
        raise DatabaseProblem(
            f"{path} is not a sound SQLite database ({error}); move it away, the next run makes a new one"
        ) from error
    except (OSError, NotImplementedError) as error:  # filelock raises the latter where a file system has no locks
        reason = getattr(error, "strerror", None) or error
        raise DatabaseProblem(f"the database {path} can't be made there ({reason})") from error


def artifact_root(path: Path) -> str:
    """The URI of the folder, beside the database ``path``, for the artifacts of its runs."""
    return (path.parent / ARTIFACT_FOLDER).as_uri()


def sqlite_uri(path: Path) -> str:
    """The SQLAlchemy URI of the absolute ``path``."""
    return f"sqlite:///{path}"


def _is_filled(path: Path) -> bool:
    if path.is_dir():
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR))
    return path.is_file() and path.stat().st_size > 0


def _create(path: Path) -> None:
    from mlflow.store.tracking.sqlalchemy_store import SqlAlchemyStore

    unfinished = path.with_name(f"{path.name}-new-{os.getpid()}")
    try:
        store = SqlAlchemyStore(sqlite_uri(unfinished), artifact_root(path))
        store.engine.dispose()
        os.replace(unfinished, path)
    finally:
        unfinished.unlink(missing_ok=True)


def _probe(path: Path, timeout_seconds: float) -> None:
    """Lock the database for writing once: MLflow itself would retry for minutes where that can't be done."""
    with closing(sqlite3.connect(path, timeout=timeout_seconds, isolation_level=None)) as connection:
        connection.execute("BEGIN IMMEDIATE")
        found = {name for (name,) in connection.execute("SELECT name FROM sqlite_master WHERE type = 'table'")}
        connection.execute("ROLLBACK")
    if not {"alembic_version", "experiments", "runs"} <= found:
        raise DatabaseProblem(f"{path} is a database, but not MLflow's; move it away or give another tracking.uri")
