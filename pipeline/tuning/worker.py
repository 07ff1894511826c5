"""Workers: each takes trials from the study until none is left. On one machine: this process and others it starts."""

from __future__ import annotations

import math
import multiprocessing
import os
import signal
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from pipeline.config.promotion import apply_values
from pipeline.errors import PipelineError
from pipeline.identification.training import Outcome, setup_of
from pipeline.processes import delay_interrupt, end_with_parent, let_interrupt_through, limit_threads, share_threads
from pipeline.tuning.space import suggest, translate
from pipeline.tuning.storage import REASON, list_results, repeat_stopped, settle, translate_errors
from pipeline.tuning.study import StudyProblem, judge, open_study

if TYPE_CHECKING:
    import optuna

ROUNDING = 1e-13
"""Held-out losses below this are rounding, and count as this."""

Seen = Callable[["optuna.Study"], None]
"""Called at every step, to show progress; what it raises ends the worker."""


def score(loss: float) -> float:
    """log10 of the held-out loss: it spans many decades."""
    return math.log10(max(loss, ROUNDING))


def work(study: optuna.Study, problem: StudyProblem, seen: Seen, poll_seconds: float = 0.2) -> None:
    """Run trials until the first ``tuning.n_trials`` places have a result.

    KeyboardInterrupt and bugs leave the trial they came in stopped: the next worker repeats it.
    """
    from optuna.trial import TrialState

    config = problem.config.tuning
    while True:
        seen(study)
        latest = repeat_stopped(study, config)
        states = {trial.state for trial in latest}
        if len(latest) < config.n_trials or TrialState.WAITING in states:
            _run_next(study, problem, seen)
        elif TrialState.RUNNING in states:
            time.sleep(poll_seconds)  # trials of other workers, which may yet stop
        else:
            return


def _run_next(study: optuna.Study, problem: StudyProblem, seen: Seen) -> None:
    """One trial, from the queue or new, in Optuna's own loop: that keeps its heartbeats."""
    from optuna.exceptions import StorageInternalError, UpdateFinishedTrialError

    begun: list[int] = []

    def run(trial: optuna.trial.Trial) -> float:
        begun.append(trial.number)
        return run_trial(trial, problem, seen)

    try:
        study.optimize(run, n_trials=1)
    except (UpdateFinishedTrialError, ValueError):
        # Another worker took this one for dead and failed its trial; no other such error comes out of `run`.
        if not begun:
            raise
    except (AssertionError, UnboundLocalError) as error:
        hidden = error.__context__  # what Optuna's loop meets where the storage does not take the end of a trial
        if isinstance(hidden, StorageInternalError):
            raise hidden from hidden.__cause__
        raise


def run_trial(trial: optuna.trial.Trial, problem: StudyProblem, seen: Seen) -> float:
    """Train with the trial's parameters.

    :returns: log10 of the held-out loss; NaN, for which Optuna fails the trial, where there is none, with the reason
        in the trial, or where the study has its total already
    :raises optuna.TrialPruned: where its learning curve is worse than those before
    """
    import optuna

    config = problem.config
    sampler: Any = trial.study.sampler
    place = sampler.place
    if place >= config.tuning.n_trials:  # several workers asked for the last one
        return math.nan
    if place == 0:
        trial.set_user_attr("note", "the configured default")
    started, curve = time.perf_counter(), _Curve(trial, seen)

    def describe(**attributes: Any) -> None:
        for name, value in ({"training_seconds": round(time.perf_counter() - started, 3)} | attributes).items():
            trial.set_user_attr(name, value)

    try:
        values = translate(config.tuning.space, suggest(trial, config.tuning.space))
        started = time.perf_counter()  # sampling is no training; where it fails, the time of that is all there is
        setup = setup_of(apply_values(config, values, f"trial {place}"))
        verdict = judge(problem.measurement, setup, curve)
        if verdict.outcome is Outcome.INTERRUPTED:
            raise KeyboardInterrupt
        if verdict.outcome is Outcome.DIVERGED or not math.isfinite(verdict.loss):
            describe(outcome="diverged", epochs=verdict.steps, **{REASON: Outcome.DIVERGED.value})
            return math.nan
        curve.carry_to_the_end(verdict.loss)
        about = {"outcome": verdict.outcome.label, "epochs": verdict.steps, "training_loss": verdict.training_loss}
        describe(**about, held_out_loss=verdict.loss)
        return score(verdict.loss)
    except optuna.TrialPruned:
        describe(outcome="pruned", epochs=curve.steps, held_out_loss=10**curve.last)
        raise
    except optuna.exceptions.UpdateFinishedTrialError:
        raise
    except (ArithmeticError, MemoryError, PipelineError, RuntimeError, ValueError) as error:
        describe(outcome="failed", **{REASON: f"{type(error).__name__}: {error}"[:500]})
        return math.nan


@dataclass
class _Curve:
    """The learning curve of the last phase: reported at percents of its steps, and judged there by the pruner.

    Phases before it have curves of another shape; a trial is not judged by those. Without a loss on the way (output
    error) there is no curve, and nothing is pruned.
    """

    trial: optuna.trial.Trial
    seen: Seen
    steps: int = 0
    last: float = math.inf
    known: bool = False  # whether there is a loss on the way
    percent: int = 0  # up to which it was reported, a multiple of ten

    def __call__(self, phase: str, step: int, total: int, loss: Callable[[], float] | None) -> None:
        import optuna

        self.steps += 1
        self.seen(self.trial.study)
        self.known |= loss is not None
        if loss is None or (percent := min(10 * step // total, 10) * 10) <= self.percent:
            return
        self._report(percent, loss())
        if self.trial.should_prune():
            raise optuna.TrialPruned

    def _report(self, percent: int, loss: float) -> None:
        self.percent = percent
        if math.isfinite(loss):
            self.last = score(loss)
            self.trial.report(self.last, percent)

    def carry_to_the_end(self, loss: float) -> None:
        """A training that converged early keeps its loss: later trials are compared with it."""
        for percent in range(self.percent + 10, 101, 10) if self.known else ():
            self._report(percent, loss)


# --- several of them ----------------------------------------------------------------------------------


def run_study(problem: StudyProblem, seen: Seen) -> tuple[optuna.Study, list[str]]:
    """The study with all its trials done, and sentences on workers that died.

    :raises StorageError: where the storage fails
    :raises ConfigError: where a study of this name does not fit
    :raises KeyboardInterrupt: after every worker has stopped its trial
    """
    import torch
    from optuna.trial import TrialState

    config = problem.config
    with translate_errors(config.tuning), _catch_interrupts() as check:

        def look(study: optuna.Study) -> None:
            check()
            seen(study)

        study = open_study(problem)
        # Where trials are running already, the silence of dead workers shows after a while. Theirs come first in the
        # queue then, and the study goes on in the order that it would have had. A database counts whole seconds.
        ends = time.monotonic() + config.tuning.silence_seconds + 1.0
        while time.monotonic() < ends and TrialState.RUNNING in {t.state for t in repeat_stopped(study, config.tuning)}:
            look(study)
            time.sleep(0.2)
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


@contextmanager
def _start_others(
    problem: StudyProblem, count: int, threads: int, patience_seconds: float = 15.0
) -> Iterator[list[Any]]:
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
            worker.join(patience_seconds)
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
