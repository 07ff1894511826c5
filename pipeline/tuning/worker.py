"""One worker: takes trials from the study until none is left."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from pipeline.config.promotion import with_values
from pipeline.errors import PipelineError
from pipeline.identification.outcome import Outcome
from pipeline.identification.residual_loss import ResidualTraining, initial_parameters, prepare_residual
from pipeline.identification.training import Minimum, minimise, phases, setup_of
from pipeline.tuning.liveness import requeue, requeue_orphans, working_on
from pipeline.tuning.space import suggest, values_of
from pipeline.tuning.study import StudyProblem

if TYPE_CHECKING:
    import optuna
    import torch

ROUNDING = 1e-13
"""Held-out losses below this are rounding, and count as this."""
CHECKPOINTS = tuple(range(10, 101, 10))
"""Percents of the last phase's steps at which the learning curve is reported."""
_POLL_SECONDS = 0.2

Seen = Callable[["optuna.Study"], None]
"""Called now and then, to show progress; what it raises ends the worker."""


def objective(loss: float) -> float:
    """log10 of the held-out loss: it spans many decades."""
    return math.log10(max(loss, ROUNDING))


def work(study: optuna.Study, problem: StudyProblem, seen: Seen) -> None:
    """Run trials until the study has its total. KeyboardInterrupt leaves the trial it was at in the queue."""
    from optuna.trial import TrialState

    total = problem.config.tuning.n_trials
    while True:
        seen(study)
        if requeue_orphans(study):
            time.sleep(_POLL_SECONDS)  # a trial is just being taken, or its taker died that moment
            continue
        trial = _next(study, total)
        if trial is None:
            running = study.get_trials(deepcopy=False, states=(TrialState.RUNNING,))
            if not any(other.number < total for other in running):
                return
            time.sleep(_POLL_SECONDS)  # those of other workers, which may yet come back to the queue
            continue
        try:
            with working_on(study, trial._trial_id):
                run_trial(study, trial, problem, seen)
        except BaseException:
            with suppress(Exception):  # where the storage is gone, the trial's worker will be found dead
                requeue(study, trial._trial_id)
            raise


def _next(study: optuna.Study, total: int) -> optuna.trial.Trial | None:
    """A trial from the queue, or a new one; None where the total is reached."""
    import warnings

    from optuna.trial import TrialState

    trials = study.get_trials(deepcopy=False)
    waiting = any(trial.state == TrialState.WAITING and trial.number < total for trial in trials)
    if not waiting and len(trials) >= total:
        return None
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Heartbeat of storage")  # see liveness.working_on
        trial = study.ask()
    if trial.number >= total:  # several workers asked for the last one
        requeue(study, trial._trial_id)
        return None
    return trial


def run_trial(study: optuna.Study, trial: optuna.trial.Trial, problem: StudyProblem, seen: Seen) -> None:
    """Train with the trial's parameters and tell the study its loss, or why there is none."""
    import optuna
    from optuna.trial import TrialState

    config = problem.config
    started = time.perf_counter()
    curve: _Curve | None = None
    try:
        values = values_of(config.tuning.space, suggest(trial, config.tuning.space))
        started = time.perf_counter()  # sampling is no training; where it fails, the time of that is all there is
        setup = setup_of(with_values(config, values, f"trial {trial.number}"))
        training = prepare_residual(problem.measurement, setup)
        curve = _Curve(study, trial, training, phases(setup.optimizer)[-1], seen)
        start = initial_parameters(training, setup, config.seed)
        found = minimise(training.problem, start, setup, held_out=training.held_out, watch=curve)
        state, value, account = _finished(curve, found)
    except optuna.TrialPruned:
        assert curve is not None
        state, value = TrialState.PRUNED, None
        account = {"outcome": "pruned", "epochs": curve.steps, "held_out_loss": 10**curve.last}
    except optuna.exceptions.UpdateFinishedTrialError:
        return  # another worker took this one for dead and finished it
    except (ArithmeticError, MemoryError, PipelineError, RuntimeError, ValueError) as error:
        state, value = TrialState.FAIL, None
        account = {"outcome": "failed", "reason": f"{type(error).__name__}: {error}"[:500]}
    try:
        for name, entry in (account | {"training_seconds": round(time.perf_counter() - started, 3)}).items():
            trial.set_user_attr(name, entry)
        study.tell(trial, value, state=state)
    except (optuna.exceptions.UpdateFinishedTrialError, ValueError):
        return  # another worker took this one for dead, and finished it or put it back to the queue


def _finished(curve: _Curve, found: Minimum) -> tuple[Any, float | None, dict[str, Any]]:
    from optuna.trial import TrialState

    outcome = found.outcomes[0]
    if outcome is Outcome.INTERRUPTED:
        raise KeyboardInterrupt
    account: dict[str, Any] = {"outcome": outcome.label, "epochs": found.steps}
    loss = float(curve.training.per_speed_held_out_loss(found.parameters)[0])
    if outcome is Outcome.DIVERGED or not math.isfinite(loss):
        return TrialState.FAIL, None, account | {"outcome": "diverged", "reason": Outcome.DIVERGED.value}
    curve.carry_to_the_end(loss)
    account |= {"held_out_loss": loss, "training_loss": float(found.loss[0])}
    return TrialState.COMPLETE, objective(loss), account


@dataclass
class _Curve:
    """The learning curve of the last phase: reported at percents of its steps, and judged there by the pruner.

    Phases before it have curves of another shape; a trial is not judged by those.
    """

    study: optuna.Study
    trial: optuna.trial.Trial
    training: ResidualTraining
    phase: str
    seen: Seen
    steps: int = 0
    last: float = math.inf
    known: dict[int, float] = field(default_factory=dict)  # of an earlier attempt that was stopped

    def __post_init__(self) -> None:
        frozen = self.study._storage.get_trial(self.trial._trial_id)
        self.known = dict(frozen.intermediate_values)
        self.due = list(CHECKPOINTS)

    def __call__(self, phase: str, step: int, total: int, best: torch.Tensor) -> None:
        import optuna

        self.steps += 1
        if phase != self.phase or not self.due or 100 * step < self.due[0] * total:
            return
        while self.due and 100 * step >= self.due[0] * total:
            percent = self.due.pop(0)
        self.report(percent, float(self.training.per_speed_held_out_loss(best)[0]))
        self.seen(self.study)
        # Optuna judges the latest step it knows: on a second attempt, wait until that is reached again.
        if percent >= max(self.known, default=0) and self.trial.should_prune():
            raise optuna.TrialPruned

    def report(self, percent: int, loss: float) -> None:
        """Add a point of the curve, where it is finite and not there yet."""
        if not math.isfinite(loss):
            return
        self.last = objective(loss)
        if percent not in self.known:
            self.trial.report(self.last, percent)

    def carry_to_the_end(self, loss: float) -> None:
        """A training that converged early keeps its loss: later trials are compared with it."""
        for percent in self.due:
            self.report(percent, loss)
        self.due = []
