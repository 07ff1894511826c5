"""Several workers on one machine: this process and others that it starts."""

from __future__ import annotations

import multiprocessing
import os
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from pipeline.tuning.liveness import requeue_orphans
from pipeline.tuning.storage import storage_errors
from pipeline.tuning.study import StudyProblem, open_study
from pipeline.tuning.worker import Seen, work

if TYPE_CHECKING:
    import optuna

_THREADS = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS")
_PATIENCE_SECONDS = 15.0


class ParentGone(Exception):
    """The process that started this worker has died."""


def run_study(problem: StudyProblem, seen: Seen) -> tuple[optuna.Study, list[str]]:
    """The study with all its trials done, and sentences on workers that died.

    :raises StorageError: where the storage fails
    :raises ConfigError: where a study of this name does not fit
    :raises KeyboardInterrupt: after every worker has put its trial back to the queue
    """
    import torch

    config = problem.config
    with storage_errors(config.tuning):
        study = open_study(problem)
        threads = threads_each(config.threads, config.tuning.workers)
        torch.set_num_threads(threads)
        todo = config.tuning.n_trials - sum(t.state.is_finished() for t in study.get_trials(deepcopy=False))
        with _others(problem, min(config.tuning.workers, todo) - 1, threads) as others:
            try:
                work(study, problem, seen)
            except KeyboardInterrupt:
                _interrupt(others)
                requeue_orphans(study)
                raise
        codes = [worker.exitcode for worker in others if worker.exitcode]
    return study, [f"a worker ended with exit code {code}; the others took over its trial" for code in codes]


def threads_each(threads: int, workers: int) -> int:
    """Threads of each worker: together no more than the machine has cores."""
    # Not every system can limit a process to some of its cores.
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return max(1, min(threads, cores // workers))


@contextmanager
def _others(problem: StudyProblem, count: int, threads: int) -> Iterator[list[Any]]:
    """``count`` more workers. New interpreters, since torch and BLAS don't survive a fork; they read their limit
    of threads from the environment."""
    context = multiprocessing.get_context("spawn")
    before = {name: os.environ.get(name) for name in _THREADS}
    os.environ.update(dict.fromkeys(_THREADS, str(threads)))
    workers: list[Any] = []
    try:
        for _ in range(count):
            worker = context.Process(target=_work_beside, args=(problem, threads), daemon=True)
            worker.start()
            workers.append(worker)
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value
    try:
        yield workers
    finally:
        for worker in workers:
            worker.join(_PATIENCE_SECONDS)
            if worker.is_alive():
                worker.kill()
                worker.join()


def _interrupt(workers: list[Any]) -> None:
    """Ctrl-C reaches the whole group of a terminal, a signal to one process does not."""
    for worker in workers:
        if worker.is_alive():
            os.kill(worker.pid, signal.SIGINT)
    for worker in workers:
        worker.join(_PATIENCE_SECONDS)


def _work_beside(problem: StudyProblem, threads: int) -> None:
    """The whole life of another worker; it ends when its parent does, and its trial goes back to the queue."""
    import torch

    torch.set_num_threads(threads)
    parent = multiprocessing.parent_process()

    def seen(_: optuna.Study) -> None:
        if parent is not None and not parent.is_alive():
            raise ParentGone

    try:
        work(open_study(problem), problem, seen)
    except (KeyboardInterrupt, ParentGone):
        os._exit(0)  # without Python's words on an interrupt
