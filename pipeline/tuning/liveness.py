"""Who works on a trial, and whether they still live: a trial whose worker died goes back to the queue.

A trial that goes back keeps its number and its parameters, so a study that was stopped - Ctrl-C, SIGKILL, power -
goes on with the very trial it was at. On this machine the process table tells at once; workers of other
machines are judged by the heartbeats that the database keeps.
"""

from __future__ import annotations

import os
import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from datetime import datetime, timedelta
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import optuna
    from optuna.storages._heartbeat import BaseHeartbeat

WORKER = "worker"
_NAMELESS_SECONDS = 5.0
"""How long a trial may run before its worker has put its name on it, which takes milliseconds."""


def this_worker() -> str:
    """Host, process and its start, which together no other worker has or will have."""
    import psutil

    return f"{socket.gethostname()}:{os.getpid()}:{psutil.Process().create_time():.2f}"


def is_dead(worker: str) -> bool:
    """True where ``worker`` was a process of this machine that is gone; False where it lives or can't be known."""
    import psutil

    host, pid, started = worker.rsplit(":", 2)
    if host != socket.gethostname():
        return False
    try:
        process = psutil.Process(int(pid))
        # The clock that a start is computed from is adjusted now and then.
        return abs(process.create_time() - float(started)) > 2.0 or process.status() == psutil.STATUS_ZOMBIE
    except psutil.NoSuchProcess:
        return True
    except psutil.AccessDenied:
        return False


def requeue(study: optuna.Study, trial_id: int) -> None:
    """Put a running trial back to the queue; another worker may have done so, or finished it, meanwhile.

    Without its worker's name, or whoever takes it next would be taken for dead until he has written his own.
    """
    from optuna.exceptions import UpdateFinishedTrialError
    from optuna.trial import TrialState

    with suppress(UpdateFinishedTrialError):
        study._storage.set_trial_user_attr(trial_id, WORKER, None)
        study._storage.set_trial_state_values(trial_id, state=TrialState.WAITING)


def requeue_orphans(study: optuna.Study) -> bool:
    """Put the trials of dead workers back; True where the worker of some trial can't be told yet."""
    from optuna.storages._heartbeat import BaseHeartbeat, is_heartbeat_enabled
    from optuna.trial import TrialState

    storage = study._storage
    running = study.get_trials(deepcopy=False, states=(TrialState.RUNNING,))
    if not running:
        return False
    silent: list[int] = []
    beats = False
    if isinstance(storage, BaseHeartbeat) and is_heartbeat_enabled(storage):
        beats = True
        silent = storage._get_stale_trial_ids(study._study_id)
    nameless = False
    for trial in running:
        worker = trial.user_attrs.get(WORKER)
        if worker is None and not _is_old(trial.datetime_start):
            nameless = True
        elif worker is None or is_dead(worker) or trial._trial_id in silent or not (beats or _is_here(worker)):
            latest = storage.get_trial(trial._trial_id)
            if (latest.datetime_start, latest.user_attrs.get(WORKER)) == (trial.datetime_start, worker):
                requeue(study, trial._trial_id)  # no other worker has done so
    return nameless


def _is_here(worker: str) -> bool:
    """A journal file is of one machine: a worker elsewhere is of a time when this one, or its container, had another
    name."""
    return worker.rsplit(":", 2)[0] == socket.gethostname()


def _is_old(started: datetime | None) -> bool:
    return started is None or abs(datetime.now() - started) > timedelta(seconds=_NAMELESS_SECONDS)


@contextmanager
def working_on(study: optuna.Study, trial_id: int) -> Iterator[None]:
    """Put this process's name on the trial and, where the storage keeps heartbeats, tell it at intervals that it lives.

    The first heartbeat comes before the name: a trial that was put back still has the last one of its dead worker.
    """
    from optuna.storages._heartbeat import BaseHeartbeat, is_heartbeat_enabled

    storage, ended = study._storage, threading.Event()
    beating = None
    if isinstance(storage, BaseHeartbeat) and is_heartbeat_enabled(storage):
        storage.record_heartbeat(trial_id)
        beating = threading.Thread(target=_beat, args=(storage, trial_id, ended), name="heartbeat", daemon=True)
        beating.start()
    try:
        storage.set_trial_user_attr(trial_id, WORKER, this_worker())
        yield
    finally:
        ended.set()
        if beating is not None:
            beating.join()


def _beat(storage: BaseHeartbeat, trial_id: int, ended: threading.Event) -> None:
    """Optuna's own loop ends, with a traceback, when the database is away for a moment."""
    interval = storage.get_heartbeat_interval()
    while not ended.wait(interval):
        with suppress(Exception):  # the trial itself tells where the database is gone for good
            storage.record_heartbeat(trial_id)
