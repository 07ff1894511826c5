"""Where studies are kept: a database that Optuna's RDBStorage opens.

By default it is an SQLite file of this machine; several machines share a PostgreSQL. Both are one class and keep
heartbeats. SQLite costs 0.1 s a trial; an Optuna journal costs 5 ms, but has neither heartbeats nor a lock that is
freed when its holder is killed. Four workers on one SQLite file, and two of which one was killed every few seconds,
met no locked database, lost no trial and gave no number twice (Optuna 5.0.0).

Trials that were stopped are repeated with their parameters. A trial whose worker died, was interrupted or met a bug is
failed without a ``reason``, by Optuna's heartbeats or by its worker. Its parameters go to the queue again, under a
number of Optuna's own and with the attribute ``repeats``. Optuna's RetryHeartbeatStaleTrialCallback would do so for the
first of the three alone, and hand on what the dead worker had written on it. What a trial keeps is its *place*: its
number among the trials that repeat none. The sampler draws by the place, and reports count by it, so that a study that
was stopped is told like one that was not.
"""

from __future__ import annotations

import errno
import os
import re
import socket
import sqlite3
import time
import warnings
from collections.abc import Iterator
from contextlib import closing, contextmanager, suppress
from datetime import datetime, timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pipeline.config.tuning import TuningConfig
from pipeline.errors import StorageError, without_password
from pipeline.processes import run_within

if TYPE_CHECKING:
    import optuna
    from optuna.trial import FrozenTrial

WORKER = "worker"
"""The attribute of a trial that names its worker, ``host:process``: set after the first heartbeat."""


def is_shared(config: TuningConfig) -> bool:
    """Whether several machines can reach the storage: a server, not a file."""
    return not config.storage.startswith("sqlite")


def open_storage(config: TuningConfig) -> optuna.storages.RDBStorage:
    """The configured storage, made where it is missing.

    :raises StorageError: where it can't be reached within ``timeout_seconds``, read or written
    """
    shared, file = is_shared(config), "Give another file: tuning.storage=sqlite:///FILE.db"
    with translate_errors(config, "Check its user, password, host and name" if shared else file):
        return run_within(config.timeout_seconds, lambda: _open_database(config)) if shared else _open_database(config)


def settle(config: TuningConfig) -> None:
    """Bring everything into the SQLite file itself: a copy of it without the files beside it is complete then."""
    from sqlalchemy.engine import make_url

    if not is_shared(config):
        with suppress(sqlite3.Error), closing(sqlite3.connect(make_url(config.storage).database or ":memory:")) as file:
            file.execute("pragma wal_checkpoint(truncate)")


def close_storage(storage: optuna.storages.RDBStorage) -> None:
    """Give up its connections now; else the garbage collector does at some time."""
    if hasattr(storage, "scoped_session"):  # one that was made, or partly made
        storage.remove_session()
        storage.engine.dispose()


@contextmanager
def translate_errors(
    config: TuningConfig, next_step: str = "No finished trial is lost; the same command goes on"
) -> Iterator[None]:
    """What goes wrong with the storage inside the block leaves it as a StorageError."""
    from optuna.exceptions import StorageInternalError
    from sqlalchemy.exc import SQLAlchemyError

    try:
        yield
    except (StorageInternalError, SQLAlchemyError, sqlite3.Error, OSError) as error:
        raise StorageError(
            f"tuning.storage must be a database that can be used, but '{without_password(config.storage)}' says: "
            f"{_tell_reason(error)}. {next_step}"
        ) from None


def _tell_reason(error: BaseException, longest: int = 300) -> str:
    """The main part of an error's text, on one line, without passwords."""
    cause = error.__cause__ or error
    text = str(getattr(cause, "strerror", None) or cause).partition("(Background on this")[0]
    text = without_password(re.sub(r"^\([\w.]+\)\s*", "", " ".join(text.split())) or type(cause).__name__)
    text = re.sub(r"[^\s'\"]+@", "***@", text)  # an "@" in a password makes the rest of it part of the host
    return text[:longest].rstrip(".? ")


def _open_database(config: TuningConfig, attempts: int = 5) -> optuna.storages.RDBStorage:
    from sqlalchemy.engine import make_url
    from sqlalchemy.exc import ArgumentError, DBAPIError, IntegrityError

    try:
        url = make_url(config.storage)
    except ValueError:
        raise ArgumentError("the port must be a number") from None
    connect: dict[str, Any] = {}
    if not is_shared(config):
        _prepare_file(Path(url.database or ":memory:"), config.storage)
        connect = {"timeout": config.timeout_seconds}
    elif config.storage.startswith("postgresql"):
        # psycopg counts whole seconds, and retries each address of a host by itself.
        connect = {"connect_timeout": max(2, int(config.timeout_seconds / 2))}
    try:
        return _connect(config, connect)
    except RuntimeError as error:  # tables of another version of Optuna
        raise ArgumentError(str(error)) from None
    except ImportError as error:
        driver = getattr(error.__cause__, "name", None)
        raise ArgumentError(f"it needs {driver}: for PostgreSQL write postgresql+psycopg://...") from None
    except DBAPIError as error:
        # Another process or machine may make the same tables in the same moment.
        if not attempts or not (isinstance(error, IntegrityError) or "already exists" in str(error)):
            raise
        time.sleep(0.5 / attempts)
        return _open_database(config, attempts - 1)


def _connect(config: TuningConfig, connect: dict[str, Any]) -> optuna.storages.RDBStorage:
    from optuna.storages import RDBStorage

    class Storage(RDBStorage):
        """One whose heartbeats outlive a moment without the database, and whose trials name their worker."""

        def __init__(self, *arguments: Any, **options: Any) -> None:
            try:
                super().__init__(*arguments, **options)
            except BaseException:
                close_storage(self)  # the pool of one that was not made would keep its connections
                raise

        def record_heartbeat(self, trial_id: int) -> None:
            with suppress(Exception):  # the trial itself tells where the database is gone for good
                super().record_heartbeat(trial_id)
                if WORKER not in self.get_trial(trial_id).user_attrs:
                    self.set_trial_user_attr(trial_id, WORKER, f"{socket.gethostname()}:{os.getpid()}")

    with warnings.catch_warnings(action="ignore"):  # heartbeats are experimental, in Optuna's words
        return Storage(
            config.storage.replace("{", "{{").replace("}", "}}"),  # Optuna takes it for a template
            engine_kwargs={"connect_args": connect, "pool_pre_ping": True},
            heartbeat_interval=config.heartbeat_seconds,
            grace_period=config.silence_seconds,
        )


def _prepare_file(path: Path, url: str) -> None:
    """Make the folder of a new file; raise StorageError for one that holds something else, and leave it as it is.

    SQLite itself says whether the file is a database. To open and close one here would free the locks that other
    connections of this process hold on it, and another process would remove the log under them: the database reads as
    malformed then (SQLite, How To Corrupt An SQLite Database File, section 2.2).
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.is_dir():
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR))
    if not path.exists() or not path.stat().st_size:
        with closing(sqlite3.connect(path)) as connection:
            connection.execute("pragma journal_mode=wal")  # a commit waits for the disk once, not three times
        return
    try:
        with closing(sqlite3.connect(path)) as connection:
            tables = {name for (name,) in connection.execute("select name from sqlite_master where type = 'table'")}
        if not tables or tables & {"studies", "version_info"}:
            return
        what = "has tables that are not of Optuna"
    except sqlite3.DatabaseError as error:
        if error.sqlite_errorcode != sqlite3.SQLITE_NOTADB:
            raise
        what = "holds something else"
        if path.read_bytes().startswith(b'{"op_code"'):
            what = "is an Optuna journal of an earlier version, whose studies can't be gone on with; their reports stay"
    raise StorageError(
        f"tuning.storage must be a database of studies, but '{url}' {what}: "
        "give another file, such as tuning.storage=sqlite:///studies/optuna.db"
    )


# --- trials that were stopped ---------------------------------------------------------------------------

REPEATS = "repeats"
REASON = "reason"
"""The attribute of a trial that failed by itself."""


def list_attempts(study: optuna.Study) -> list[FrozenTrial]:
    """The latest attempt at each place.

    Two workers may put one trial back to the queue at once: the first of its repeats counts, others have no place.
    """
    latest: dict[int, FrozenTrial] = {}  # number of the first attempt -> latest
    first: dict[int, int] = {}  # number of the latest attempt -> first
    for trial in study.get_trials(deepcopy=False):
        repeated = trial.user_attrs.get(REPEATS, trial.number)
        if repeated == trial.number or repeated in first:
            first[trial.number] = first.pop(repeated, repeated)
            latest[first[trial.number]] = trial
    return list(latest.values())


def list_results(study: optuna.Study) -> dict[int, FrozenTrial]:
    """Place -> finished trial; a trial that was stopped is not finished."""
    return {
        place: trial
        for place, trial in enumerate(list_attempts(study))
        if trial.state.is_finished() and not _was_stopped(trial)
    }


def repeat_stopped(study: optuna.Study, config: TuningConfig) -> list[FrozenTrial]:
    """The latest attempt at each place of the study's total, after those that stopped were put back to the queue."""
    from optuna.storages import fail_stale_trials

    with warnings.catch_warnings(action="ignore"):  # experimental, in Optuna's words
        fail_stale_trials(study)
    latest = list_attempts(study)[: config.n_trials]
    stopped = [trial for trial in latest if _was_stopped(trial) or _has_died_early(study, trial, config)]
    for trial in stopped:
        study.enqueue_trial(dict(trial.params), user_attrs={REPEATS: trial.number})
    return list_attempts(study)[: config.n_trials] if stopped else latest


def _was_stopped(trial: FrozenTrial) -> bool:
    return trial.state.name == "FAIL" and REASON not in trial.user_attrs


def _has_died_early(study: optuna.Study, trial: FrozenTrial, config: TuningConfig) -> bool:
    """Fail a trial that died before its first heartbeat, which Optuna doesn't notice; True if it was one."""
    from optuna.exceptions import UpdateFinishedTrialError
    from optuna.trial import TrialState

    silence = abs(datetime.now() - (trial.datetime_start or datetime.now()))
    told_or_young = WORKER in trial.user_attrs or silence < timedelta(seconds=config.silence_seconds)
    if trial.state != TrialState.RUNNING or told_or_young:
        return False
    with suppress(UpdateFinishedTrialError, ValueError):  # another worker did so
        study.tell(trial.number, state=TrialState.FAIL)
    return True
