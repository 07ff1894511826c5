"""Where studies are kept: an Optuna journal file, or a database that several machines share."""

from __future__ import annotations

import re
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pipeline.config.tuning import TuningConfig
from pipeline.errors import StorageError
from pipeline.waiting import within

if TYPE_CHECKING:
    import optuna

_URL = re.compile(r"^[a-z][a-z0-9+]*://")
_LONGEST_REASON = 300


def place(storage: str) -> str:
    """``storage`` as it may be shown: without a password."""
    return re.sub(r"(\w://[^\s:/@]*):[^\s/@]+@", r"\1:***@", storage)


def open_storage(config: TuningConfig) -> optuna.storages.BaseStorage:
    """The configured storage, made where it is missing.

    :raises StorageError: where it can't be reached within ``timeout_seconds``, read or written
    """
    with storage_errors(config):
        if _URL.match(config.storage):
            return within(config.timeout_seconds, lambda: _database(config))
        return _journal(Path(config.storage))


@contextmanager
def storage_errors(config: TuningConfig) -> Iterator[None]:
    """What goes wrong with the storage inside the block leaves it as a StorageError."""
    import optuna
    import sqlalchemy.exc

    shown = place(config.storage)
    database = bool(_URL.match(config.storage))
    try:
        yield
    except TimeoutError as error:
        raise StorageError(
            f"tuning.storage must answer, but '{shown}' gave {error}: check its host and port, or leave it out for a "
            "file of this machine"
        ) from None
    except ModuleNotFoundError as error:
        if not database:
            raise
        raise StorageError(
            f"tuning.storage must name a database whose driver is installed, but '{shown}' needs {error.name}: for "
            "PostgreSQL write postgresql+psycopg://..."
        ) from None
    except (optuna.exceptions.StorageInternalError, sqlalchemy.exc.SQLAlchemyError) as error:
        raise StorageError(
            f"tuning.storage must be a database that can be used, but '{shown}' says: {_reason(error)}. No finished "
            "trial is lost; the same command goes on"
        ) from None
    except (ValueError, KeyError, TypeError, AssertionError, UnicodeDecodeError) as error:
        if database or not _is_corrupted(Path(config.storage)):
            raise
        raise StorageError(
            f"tuning.storage must be an Optuna journal, but '{shown}' can't be read as one ({_reason(error)}): move it "
            "away, and the next run begins a new one"
        ) from None
    except OSError as error:
        raise StorageError(
            f"tuning.storage must be writable, but '{shown}' is not ({error.strerror or error}): free the disk or "
            "choose another file with tuning.storage=FILE"
        ) from None


def _reason(error: BaseException) -> str:
    """The heart of an error's text, on one line, without passwords."""
    cause = error.__cause__ or error
    lines = [line.strip() for line in str(cause).splitlines() if line.strip() and "Background on this" not in line]
    text = place(re.sub(r"^\([\w.]+\)\s*", "", " ".join(lines)) or type(cause).__name__)
    return text[:_LONGEST_REASON].rstrip(". ")


# --- journal file ----------------------------------------------------------------------------------


def _journal(path: Path) -> optuna.storages.BaseStorage:
    import filelock
    from optuna.storages import JournalStorage
    from optuna.storages.journal import JournalFileBackend
    from optuna.storages.journal._file import BaseJournalFileLock

    class KernelLock(BaseJournalFileLock):
        """A lock that the kernel frees when its holder dies: Optuna's own makes the next one wait for half a minute."""

        def __init__(self) -> None:
            self._lock = filelock.FileLock(f"{path}.flock")

        def acquire(self) -> bool:
            self._lock.acquire()
            return True

        def release(self) -> None:
            self._lock.release()

    path.parent.mkdir(parents=True, exist_ok=True)
    lock = KernelLock()
    lock.acquire()
    try:
        _drop_torn_line(path)
    finally:
        lock.release()
    return JournalStorage(JournalFileBackend(str(path), lock_obj=lock))


def _drop_torn_line(path: Path) -> None:
    """Cut what a kill or a full disk left of a last line: the next record would be glued to it."""
    if not path.exists() or not path.stat().st_size:
        return
    with path.open("rb+") as file:
        data = file.read()
        if not data.endswith(b"\n"):
            file.truncate(data.rfind(b"\n") + 1)


def _is_corrupted(path: Path) -> bool:
    """Whether some line of the journal is no JSON object with an operation, as opposed to a bug of ours."""
    import json

    try:
        lines = path.read_bytes().splitlines()
        return not all(isinstance(json.loads(line).get("op_code"), int) for line in lines)
    except (ValueError, AttributeError):
        return True


# --- database --------------------------------------------------------------------------------------


def _database(config: TuningConfig) -> optuna.storages.BaseStorage:
    from optuna.storages import RDBStorage

    # psycopg counts whole seconds, and retries each address of a host by itself.
    seconds = max(2, int(config.timeout_seconds / 2))
    connect: dict[str, Any] = {}
    if config.storage.startswith("sqlite"):
        connect = {"timeout": config.timeout_seconds}
    elif config.storage.startswith("postgresql"):
        connect = {"connect_timeout": seconds}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # heartbeats are experimental in Optuna's words
        return RDBStorage(
            config.storage,
            engine_kwargs={"connect_args": connect, "pool_pre_ping": True},
            heartbeat_interval=config.heartbeat_seconds,
            grace_period=3 * config.heartbeat_seconds,
        )
