"""Where studies are kept: an Optuna journal file, or a database that several machines share."""

from __future__ import annotations

import os
import re
import time
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pipeline.config.tuning import TuningConfig
from pipeline.errors import StorageError, without_password
from pipeline.waiting import within

if TYPE_CHECKING:
    import optuna

_URL = re.compile(r"^[a-z][a-z0-9+]*://", re.IGNORECASE)
_LONGEST_REASON = 300
_FIRST_BYTES = b'{"op_code":'
_ATTEMPTS = 5


def place(storage: str) -> str:
    """``storage`` as it may be shown: without a password."""
    return without_password(storage)


def is_shared(config: TuningConfig) -> bool:
    """Whether the storage is a database, which several machines can reach, and not a file."""
    return bool(_URL.match(config.storage))


def open_storage(config: TuningConfig) -> optuna.storages.BaseStorage:
    """The configured storage, made where it is missing.

    :raises StorageError: where it can't be reached within ``timeout_seconds``, read or written
    """
    with storage_errors(config, "Check its user, password, host and name"):
        if is_shared(config):
            return within(config.timeout_seconds, lambda: _database(config))
        return _journal(Path(config.storage))


@contextmanager
def storage_errors(
    config: TuningConfig, next_step: str = "No finished trial is lost; the same command goes on"
) -> Iterator[None]:
    """What goes wrong with the storage inside the block leaves it as a StorageError."""
    import optuna
    import sqlalchemy.exc

    shown = place(config.storage)
    database = is_shared(config)
    try:
        yield
    except TimeoutError as error:
        raise StorageError(
            f"tuning.storage must answer, but '{shown}' gave {error}: check its host and port, or leave it out for a "
            "file of this machine"
        ) from None
    except ImportError as error:
        if not database:
            raise
        missing = getattr(error.__cause__ or error, "name", None)
        raise StorageError(
            f"tuning.storage must name a database whose driver is installed, but '{shown}' needs {missing}: for "
            "PostgreSQL write postgresql+psycopg://..."
        ) from None
    except (optuna.exceptions.StorageInternalError, sqlalchemy.exc.SQLAlchemyError) as error:
        raise StorageError(
            f"tuning.storage must be a database that can be used, but '{shown}' says: {_reason(error)}. {next_step}"
        ) from None
    except (ValueError, LookupError, TypeError, AssertionError) as error:
        if database or not _is_corrupted(Path(config.storage)):
            raise
        raise _no_journal(shown, _reason(error)) from None
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
    text = re.sub(r"[^\s'\"]+@", "***@", text)  # an "@" in a password makes the rest of it part of the host
    return text[:_LONGEST_REASON].rstrip(".? ")


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
            try:
                _drop_torn_line(path)
            except BaseException:
                self._lock.release()
                raise
            return True

        def release(self) -> None:
            self._lock.release()

    path.parent.mkdir(parents=True, exist_ok=True)
    _refuse_stranger(path)
    return JournalStorage(JournalFileBackend(str(path), lock_obj=KernelLock()))


def _no_journal(shown: str, reason: str) -> StorageError:
    return StorageError(
        f"tuning.storage must be an Optuna journal, but '{shown}' can't be read as one ({reason}): move it away, and "
        "the next run begins a new one"
    )


def _refuse_stranger(path: Path) -> None:
    """Raise StorageError for a file that begins as no journal does: repairing its last line would destroy it."""
    if not path.exists():
        return
    with path.open("rb") as file:
        start = file.read(len(_FIRST_BYTES))
    if not _FIRST_BYTES.startswith(start):
        raise _no_journal(str(path), "it begins as no journal does")


def _drop_torn_line(path: Path) -> None:
    """Cut what a kill or a full disk left of a last line: the next record would be glued to it."""
    with suppress(FileNotFoundError), path.open("rb+") as file:
        size = file.seek(0, os.SEEK_END)
        file.seek(max(size - 1, 0))
        if file.read() not in (b"", b"\n"):
            file.seek(0)
            file.truncate(file.read().rfind(b"\n") + 1)


def _is_corrupted(path: Path) -> bool:
    """Whether Optuna can't read the journal, as opposed to a bug of ours."""
    from optuna.storages import JournalStorage
    from optuna.storages.journal import JournalFileBackend

    try:
        JournalStorage(JournalFileBackend(str(path)))
    except Exception:  # it raises what the damage happens to break: KeyError, AttributeError, JSONDecodeError ...
        return True
    return False


# --- database --------------------------------------------------------------------------------------


def _database(config: TuningConfig) -> optuna.storages.BaseStorage:
    from optuna.storages import RDBStorage
    from sqlalchemy.engine import make_url
    from sqlalchemy.exc import ArgumentError, DBAPIError, IntegrityError

    try:
        make_url(config.storage)
    except ValueError:
        raise ArgumentError("the port must be a number") from None

    # psycopg counts whole seconds, and retries each address of a host by itself.
    seconds = max(2, int(config.timeout_seconds / 2))
    connect: dict[str, Any] = {}
    if config.storage.startswith("sqlite"):
        connect = {"timeout": config.timeout_seconds}
    elif config.storage.startswith("postgresql"):
        connect = {"connect_timeout": seconds}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # heartbeats are experimental in Optuna's words
        for attempt in range(1, _ATTEMPTS + 1):
            try:
                return RDBStorage(
                    config.storage,
                    engine_kwargs={"connect_args": connect, "pool_pre_ping": True},
                    heartbeat_interval=config.heartbeat_seconds,
                    grace_period=3 * config.heartbeat_seconds,
                )
            except DBAPIError as error:
                # Another machine may make the same tables in the same moment.
                made_meanwhile = isinstance(error, IntegrityError) or "already exists" in str(error)
                if attempt == _ATTEMPTS or not made_meanwhile:
                    raise
                time.sleep(0.1 * attempt)
    raise AssertionError("unreachable")
