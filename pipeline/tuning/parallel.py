"""Several workers on one machine: this process and others that it starts."""

from __future__ import annotations

import multiprocessing
import os
import signal
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from pipeline.errors import PipelineError
from pipeline.processes import delay_interrupt, end_with_parent, let_interrupt_through, limit_threads, share_threads
from pipeline.tuning.attempts import list_results, repeat_stopped
from pipeline.tuning.storage import settle, translate_errors
from pipeline.tuning.study import StudyProblem, open_study
from pipeline.tuning.worker import Seen, work

if TYPE_CHECKING:
    import optuna

_PATIENCE_SECONDS = 15.0


def run_study(problem: StudyProblem, seen: Seen) -> tuple[optuna.Study, list[str]]:
    """The study with all its trials done, and sentences on workers that died.

    :raises StorageError: where the storage fails
    :raises ConfigError: where a study of this name does not fit
    :raises KeyboardInterrupt: after every worker has stopped its trial
    """
    import torch

    config = problem.config
    with translate_errors(config.tuning), _catch_interrupts() as check:

        def look(study: optuna.Study) -> None:
            check()
            seen(study)

        study = open_study(problem)
        _wait_for_the_silent(study, problem, look)
        threads = share_threads(config.threads, config.tuning.workers)
        torch.set_num_threads(threads)
        todo = config.tuning.n_trials - len(list_results(study))
        with _start_others(problem, min(config.tuning.workers, todo) - 1, threads) as others:
            try:
                work(study, problem, look)
            except KeyboardInterrupt:
                # Ctrl-C reaches the whole group of a terminal, a signal to one process does not.
                for worker in others:
                    if worker.is_alive():
                        os.kill(worker.pid, signal.SIGINT)
                raise
            finally:
                settle(config.tuning)
        check()
        codes = [worker.exitcode for worker in others if worker.exitcode]
    return study, [f"a worker ended with exit code {code}; the others took over its trial" for code in codes]


@contextmanager
def _catch_interrupts() -> Iterator[Callable[[], None]]:
    """Give a function that raises KeyboardInterrupt if Ctrl-C came in the block.

    One in the middle of a call of the storage, or while Optuna tells the end of a trial, would leave the trial running
    and end in errors of theirs.
    """
    came: list[int] = []

    def check() -> None:
        if came:
            raise KeyboardInterrupt

    before = signal.getsignal(signal.SIGINT)
    if before is signal.default_int_handler:  # a shell's background job ignores it
        signal.signal(signal.SIGINT, lambda number, _: came.append(number))
    try:
        yield check
    finally:
        signal.signal(signal.SIGINT, before)


def _wait_for_the_silent(study: optuna.Study, problem: StudyProblem, seen: Seen) -> None:
    """Where trials are running already, wait until the silence of dead workers shows.

    They come first in the queue then, and the study goes on in the order that it would have had.
    """
    from optuna.trial import TrialState

    config = problem.config.tuning
    ends = time.monotonic() + config.silence_seconds + 1.0  # a database counts whole seconds
    while TrialState.RUNNING in {trial.state for trial in repeat_stopped(study, config)} and time.monotonic() < ends:
        seen(study)
        time.sleep(0.2)


@contextmanager
def _start_others(problem: StudyProblem, count: int, threads: int) -> Iterator[list[Any]]:
    """``count`` more workers; they have ended at the end of the block."""
    context = multiprocessing.get_context("spawn")
    workers = [context.Process(target=_work_beside, args=(problem, threads), daemon=True) for _ in range(count)]
    with limit_threads(threads), delay_interrupt():
        for worker in workers:
            worker.start()
    try:
        yield workers
    finally:
        for worker in workers:
            worker.join(_PATIENCE_SECONDS)
            if worker.is_alive():
                worker.kill()
                worker.join()


def _work_beside(problem: StudyProblem, threads: int) -> None:
    """The whole life of another worker; it ends with its parent, and its trial is found by its silence."""
    import torch

    torch.set_num_threads(threads)
    end_with_parent()
    try:
        let_interrupt_through()
        with translate_errors(problem.config.tuning), _catch_interrupts() as check:
            work(open_study(problem), problem, lambda _: check())
    except KeyboardInterrupt:
        os._exit(0)  # without Python's words on an interrupt
    except PipelineError:
        os._exit(2)  # what is wrong with the storage, the parent finds and says too
