"""Other processes: how many threads each has, Ctrl-C while they start; and a limit on the time of what has none."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from contextlib import AbstractContextManager, contextmanager
from multiprocessing import resource_tracker
from typing import Any, TypeVar

_T = TypeVar("_T")

_THREADS = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS")


def share_threads(threads: int, workers: int) -> int:
    """Threads of each worker: together no more than the machine has cores."""
    # Not every system can limit a process to some of its cores.
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return max(1, min(threads, cores // workers))


def limit_threads(threads: int) -> AbstractContextManager[object]:
    """Interpreters started in the block find the limit of their threads in the environment: BLAS reads it there."""
    from unittest.mock import patch  # it imports asyncio

    return patch.dict(os.environ, dict.fromkeys(_THREADS, str(threads)))


def end_with_parent() -> None:
    """End this process with the one that started it: one that was killed can't end those that it started."""
    parent = multiprocessing.parent_process()
    assert parent is not None

    def wait() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=wait, name="parent", daemon=True).start()


@contextmanager
def delay_interrupt() -> Iterator[None]:
    """Ctrl-C waits until the end of the block, and in processes started in it until they let it through: one that
    came while they import would end them with a traceback."""
    if hasattr(signal, "pthread_sigmask"):
        resource_tracker.ensure_running()  # it would let the signal through when the first process starts it
        signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        let_interrupt_through()


def let_interrupt_through() -> None:
    """End :func:`delay_interrupt` in a process that was started in it."""
    if hasattr(signal, "pthread_sigmask"):  # not on Windows
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})


@contextmanager
def open_pool(workers: int, threads: int) -> Iterator[Callable[..., Iterator[Any]]]:
    """Give ``map`` over as many processes; one worker is this process. Ctrl-C ends the others at once."""
    if workers == 1:
        yield map
        return
    each = share_threads(threads, workers)
    # New interpreters, since torch and BLAS don't survive a fork.
    with limit_threads(each), delay_interrupt():
        processes = multiprocessing.get_context("spawn").Pool(workers, _begin_worker, (each,))
    with processes:  # terminates them at its end
        yield processes.imap


def _begin_worker(threads: int) -> None:
    import torch

    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent gets it too
    torch.set_num_threads(threads)


def run_within(seconds: float, function: Callable[[], _T]) -> _T:
    """Return what ``function`` returns, or raise what it raises; after ``seconds``, raise :class:`TimeoutError`.

    The thread of a function that takes too long is left to itself.
    """
    answer: Future[_T] = Future()

    def work() -> None:
        try:
            answer.set_result(function())
        except Exception as error:
            answer.set_exception(error)

    # Not an executor's thread, which the interpreter would wait for at its end.
    threading.Thread(target=work, name="within", daemon=True).start()
    try:
        return answer.result(seconds)
    except TimeoutError:
        if answer.done():
            raise  # the function's own
        raise TimeoutError(f"no answer within {seconds:g} s") from None
