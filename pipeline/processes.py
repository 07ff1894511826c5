"""Other processes: how many threads each has, Ctrl-C while they start, one that a file may kill; and a limit on the
time of what has none."""

from __future__ import annotations

import json
import multiprocessing
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import AbstractContextManager, contextmanager, suppress
from functools import cache
from multiprocessing import resource_tracker
from pathlib import Path
from pkgutil import resolve_name
from typing import Any, TypeVar

from pipeline.errors import PipelineError

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


def settle_torch(threads: int, kept: int = 1 << 28) -> None:
    """Let torch use so many threads, and the C library keep up to so many bytes that large arrays leave: given back and
    taken anew for each array, pages cost a tenth of a fit."""
    import ctypes

    import torch

    torch.set_num_threads(threads)
    if sys.platform == "linux" and hasattr(libc := ctypes.CDLL(None), "mallopt"):  # of glibc
        for threshold in (-1, -3):  # M_TRIM_THRESHOLD and M_MMAP_THRESHOLD
            libc.mallopt(threshold, kept)


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


def run_all(
    function: Callable[[Any], Any], each: Sequence[Any], workers: int, threads: int, less: str
) -> Iterator[tuple[int, Any]]:
    """The place of each, and what the ``function`` makes of it, as they end in so many processes; one worker is this
    process. Ctrl-C ends what is at work.

    Raises PipelineError where a process is killed; ``less`` is the override that needs less memory.
    """
    if min(workers, len(each)) <= 1:
        yield from enumerate(map(function, each))
        return
    others = multiprocessing.active_children()
    shared, context = share_threads(threads, workers), multiprocessing.get_context("spawn")  # torch survives no fork
    with ProcessPoolExecutor(min(workers, len(each)), context, _begin_worker, (shared,)) as pool:
        try:
            with limit_threads(shared), delay_interrupt():
                futures = {pool.submit(_work, function, given): i for i, given in enumerate(each)}
            for future in as_completed(futures):
                yield futures[future], future.result()
        except BrokenProcessPool:
            raise PipelineError(
                "every process must live, but one was killed (too little memory?): run the same command again, with "
                f"{less} for less memory"
            ) from None
        except BaseException:
            processes = [process for process in multiprocessing.active_children() if process not in others]
            pool.shutdown(wait=False, cancel_futures=True)
            for process in processes:
                process.terminate()
            raise


_working = _left = False
"""In a worker, whether it is at work, and whether it is to take nothing more."""


def _begin_worker(threads: int) -> None:
    # The parent gets Ctrl-C too, and says when it is over: what is at work then ends, and the process in its own time.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, _leave)
    end_with_parent()
    settle_torch(threads)


def _leave(*_: object) -> None:
    global _left
    _left = True
    if _working:
        raise SystemExit


def _work(function: Callable[[Any], Any], given: Any) -> Any:
    global _working
    _working = True
    try:
        return None if _left else function(given)
    finally:
        _working = False


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


def ask_aside(function: str, question: str, seconds: float, memory: float) -> bytes:
    """What a ``function`` (``module:name``, of a text, to bytes) gives in an interpreter beside this one, which a crash
    may end: within so many ``seconds`` and bytes of ``memory``. It is kept for the next question.

    Raises RuntimeError with what the function raised, or that it ended the interpreter.
    """
    process: Any = _open_aside()  # both of its pipes are there
    try:
        process.stdin.write(json.dumps([function, question, seconds, memory]).encode() + b"\n")
        process.stdin.flush()
        head = process.stdout.read(9)
        content = process.stdout.read(int.from_bytes(head[1:], "big"))
        if not head:
            raise RuntimeError(f"it makes its reader crash, or takes longer than {seconds:g} s")
    except BaseException:  # the next question would get the answer to one that was interrupted
        _open_aside.cache_clear()
        process.kill()
        process.communicate()
        raise
    if head[:1] != b"+":
        raise RuntimeError(content.decode())
    return content


@cache
def _open_aside() -> subprocess.Popen[bytes]:
    """It ends with this process, which closes its pipes then; Ctrl-C is for this one alone."""
    return subprocess.Popen(
        [
            sys.executable,
            "-P",
            "-c",
            f"import sys; sys.path.insert(0, sys.argv[1]); import {__name__} as p; p.answer()",
            str(Path(__file__).parents[1]),
        ],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
        env=os.environ | dict.fromkeys(_THREADS, "1"),
    )


def answer() -> None:
    """Answer the questions of :func:`ask_aside`, one a line."""
    for line in sys.stdin.buffer:
        function, question, seconds, memory = json.loads(line)
        try:
            _limit(int(seconds), int(memory))
            mark, content = b"+", resolve_name(function)(question)
        except Exception as error:
            mark, content = b"-", (str(error) or type(error).__name__).encode()
        _limit(0, -1)
        sys.stdout.buffer.write(mark + len(content).to_bytes(8, "big") + content)
        sys.stdout.flush()


def _limit(seconds: int, memory: int) -> None:
    """What this process may take from now on; 0 and -1 for any."""
    with suppress(ImportError, ValueError):  # Windows has no limits, macOS none of memory
        import resource

        signal.alarm(seconds)
        resource.setrlimit(resource.RLIMIT_AS, (memory, -1))
