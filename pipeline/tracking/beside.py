"""MLflow in a process of its own, which imports it while the stage computes: the command then hardly waits for it.

Measured on two cores, ball_bearing: `stage=train` takes 5.7 s with it and 7.2 s without; `stage=evaluate` 11.5 s and
17 s beside other programs, of which the processor worked 5.7 s and 7.3 s. A process that is lost is done without.
"""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from multiprocessing.connection import Connection
from typing import TYPE_CHECKING

from pipeline.processes import delay_interrupt, let_interrupt_through
from pipeline.tracking.entries import StageRecord

if TYPE_CHECKING:
    from multiprocessing.context import SpawnProcess

    from pipeline.config.schema import TrackingConfig

_running: list[tuple[SpawnProcess, Connection]] = []


@contextmanager
def recorder_beside(enabled: bool) -> Iterator[None]:
    """Stages of the block are logged by another process, which is ready when the first of them ends."""
    if not enabled:
        yield
        return
    from multiprocessing import get_context

    context = get_context("spawn")
    near, far = context.Pipe()
    process = context.Process(target=_serve, args=(far,), daemon=True)
    with delay_interrupt():
        process.start()
    far.close()
    _running.append((process, near))
    try:
        yield
    finally:
        _running.pop()
        near.close()
        process.join()


def log_beside(record: StageRecord, settings: TrackingConfig, patience_seconds: float = 10.0) -> list[str] | None:
    """Let the other process do :func:`pipeline.tracking.tracker.track`; None where there is no such process.

    :param patience_seconds: how long it may take to mark a run as killed
    """
    if not _running:
        return None
    process, connection = _running[-1]
    try:
        connection.send((record, settings))
        answer: list[str] = connection.recv()
    except (OSError, EOFError):
        return None
    except KeyboardInterrupt:
        os.kill(process.pid or 0, signal.SIGINT)
        process.join(patience_seconds)
        raise
    return answer


def _serve(connection: Connection) -> None:
    """Log what comes until the other end is closed."""
    from pipeline.tracking.tracker import get_ready, track

    os.setsid()  # Ctrl-C is for the stage, whose record then says so
    let_interrupt_through()
    for stream in (sys.stdout, sys.stderr):
        os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())
    try:
        get_ready()
        while True:
            connection.send(track(*connection.recv()))
    except (KeyboardInterrupt, OSError, EOFError):
        os._exit(0)  # taking MLflow down in order takes a while, and the command waits for it
