"""Training (paper, Algorithm 1): phases of an optimiser, the best state, a named outcome.

Legend: G trainings done at once, M members of each, Q parameters.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from enum import StrEnum
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.config.identification import LossConfig, OptimizerConfig, TrainingConfig
from pipeline.config.models import ModelConfig
from pipeline.errors import ConfigError
from pipeline.identification import optimizers
from pipeline.identification.optimizers import LeastSquares
from pipeline.problem.measurement import Guess
from pipeline.unknowns import UnknownSet

if TYPE_CHECKING:
    import torch

    from pipeline.config.schema import Config


class Outcome(StrEnum):
    """The end of a training, and what to try next where it fell short."""

    CONVERGED = (
        "converged: the last steps lowered the loss by less than training.tolerance, or by less than the scatter of "
        "the data lets tell"
    )
    BUDGET_SPENT = (
        "budget spent: the loss still fell at the last step; give the last phase more steps "
        "(such as optimizer.levenberg_marquardt.steps=1000)"
    )
    DIVERGED = (
        "diverged: the loss is not finite or ended above its start; "
        "try a smaller optimizer.adam.learning_rate, model.parametrisation=log or loss.scaling=per_speed"
    )
    INTERRUPTED = "interrupted: the best state so far was kept"

    @property
    def label(self) -> str:
        """Short form for tables and tags."""
        return self.name.lower()


Watch = Callable[["torch.Tensor", "torch.Tensor", str, int, int], None]
"""Follows a training: its state and the best one so far (G, M, Q), by phase, step and their total; what it raises ends
the training."""
Progress = Callable[[str, int, int, float], None]
"""Shows a training while it runs, by phase, step, their total and the loss, such as a progress bar."""


@dataclass(frozen=True)
class FitSetup:
    """How a measurement is fitted: the sections of the configuration that a fit reads."""

    model: ModelConfig
    loss: LossConfig
    optimizer: OptimizerConfig
    training: TrainingConfig
    seed: int = 0
    force: bool = False  # fit what the data do not determine, too

    def __hash__(self) -> int:
        return hash((self.model, self.optimizer, self.seed, self.force))  # not of mappings, which have none

    @property
    def constant(self) -> bool:
        """Whether the coefficients are the same at every speed."""
        return not self.model.varies

    def ending(self, patience: int, tolerance: float) -> FitSetup:
        """The same where Levenberg-Marquardt ends once so many steps lower the loss by less than this share."""
        section = self.optimizer.levenberg_marquardt.model_copy(update={"patience": patience})
        return replace(
            self,
            optimizer=self.optimizer.model_copy(update={"levenberg_marquardt": section}),
            training=self.training.model_copy(update={"tolerance": tolerance}),
        )


def setup_of(config: Config) -> FitSetup:
    """The sections of a configuration that a fit reads."""
    return FitSetup(config.model, config.loss, config.optimizer, config.training, config.seed, config.force)


def phases(config: OptimizerConfig) -> tuple[str, ...]:
    """The optimiser's phases that have steps, in their order."""
    return tuple(name for name in type(config).model_fields if getattr(config, name).steps)


def initial_guess(setup: FitSetup, unknowns: UnknownSet, stiffness: float | None = None) -> np.ndarray:
    """(M, U) starting values, N/m and N s/m: as configured, or ``stiffness`` for every direct stiffness.

    Cross-coupled coefficients start at zero.
    """
    return Guess(stiffness or setup.model.initial_stiffness, setup.model.initial_damping).direct(unknowns)


@dataclass(frozen=True, eq=False, kw_only=True)
class Minimum:
    """Where G trainings, done at once, ended. Losses are (G,), over the members of each."""

    parameters: torch.Tensor  # (G, M, Q), the best state of every member
    outcomes: tuple[Outcome, ...]
    loss: np.ndarray
    held_out_loss: np.ndarray | None
    steps: int
    seconds: float
    history: tuple[Mapping[str, float | str], ...]

    def after(self, before: Minimum) -> Minimum:
        """The same with the history, steps and time of the training ``before`` it."""
        rows = tuple(dict(row) | {"step": before.steps + i} for i, row in enumerate(self.history))
        steps, seconds = before.steps + self.steps, before.seconds + self.seconds
        return replace(self, history=(*before.history, *rows), steps=steps, seconds=seconds)


@dataclass(kw_only=True)
class _Monitor:
    """Sees every step: keeps the best state of each member, the history, and the decision to stop."""

    problem: LeastSquares
    held_out: LeastSquares | None
    config: TrainingConfig
    progress: Progress | None
    watch: Watch | None
    together: bool = False  # all trainings end where no score falls any more, not each by its loss
    phase: str = ""
    total: int = 0
    patience: int = 1
    step: int = 0
    phase_start: int = 0
    started: float = field(default_factory=time.perf_counter)
    history: list[dict[str, float | str]] = field(default_factory=list)
    best: Any = None  # (G, M, Q)
    best_score: Any = None  # (G, M)
    first_loss: Any = None  # (G, M)
    last_loss: Any = None  # (G, M)
    reference: Any = None  # (G, M) loss that the next improvement is measured from
    stale: Any = None  # (G, M) steps since the last improvement of more than the tolerance
    rounding: Any = None  # (M,) losses below it are equal, or the processor's rounding would count as improvement

    def begin(self, phase: str, total: int, patience: int) -> None:
        self.phase, self.total, self.patience, self.phase_start = phase, total, patience, self.step
        self.rounding = self.problem.rounding()

    def __call__(self, parameters: torch.Tensor, losses: torch.Tensor) -> torch.Tensor:
        import torch

        self.last_loss = losses
        score = losses if self.held_out is None else self.held_out.loss(parameters).detach()
        if not self.step:
            self.best, self.best_score, self.first_loss = parameters.clone(), score.clone(), losses.clone()
        before = self.best_score
        better = (score < before) | before.isnan()
        self.best = torch.where(better[..., None], parameters, self.best)
        self.best_score = torch.where(better, score, self.best_score)
        known = torch.maximum(losses, self.rounding)  # NaN stays
        if self.step == self.phase_start:
            self.reference, self.stale = known, torch.zeros_like(losses)
        # A small gain tells of a minimum where the step was a second-order one; a gradient's may cross a plateau.
        second_order = self.phase == "levenberg_marquardt"
        tolerance = max(self.config.tolerance, self.problem.scatter() if second_order else 0.0)
        improved = known < self.reference * (1 - tolerance)
        if self.together:
            improved = (score < before * (1 - tolerance)).any().expand_as(score)
        self.reference = torch.where(improved, known, self.reference)
        self.stale = torch.where(improved, torch.zeros_like(self.stale), self.stale + 1)
        self._record(parameters, losses, score)
        self.step += 1
        over: torch.Tensor = (self.stale >= self.patience) | ~losses.isfinite()
        return over

    def _record(self, parameters: torch.Tensor, losses: torch.Tensor, score: torch.Tensor) -> None:
        loss = float(losses.square().mean().sqrt())
        row: dict[str, float | str] = {"step": self.step, "phase": self.phase, "loss": loss}
        if self.held_out is not None:
            row["held_out_loss"] = float(score.square().mean().sqrt())
        row["seconds"] = time.perf_counter() - self.started
        self.history.append(row)
        if self.progress is not None:
            self.progress(self.phase, self.step - self.phase_start + 1, self.total, loss)
        if self.watch is not None:
            self.watch(parameters.cpu(), self.best.cpu(), self.phase, self.step - self.phase_start + 1, self.total)


def minimise(
    problem: LeastSquares,
    parameters: torch.Tensor,
    setup: FitSetup,
    *,
    held_out: LeastSquares | None = None,
    progress: Progress | None = None,
    watch: Watch | None = None,
    together: bool = False,
) -> Minimum:
    """Train G starting points (G, M, Q) at once; ``held_out`` chooses the best state. Ctrl-C ends it with that.

    ``together``: by Levenberg-Marquardt steps alone, until none of the trainings predicts better what it holds out.
    Raises ConfigError for more trainings than a GPU has memory for.
    """
    from contextlib import nullcontext

    import torch

    device = setup.training.device
    # What the steps make lies there, too. On the processor it does so anyway: saying it would slow each call of torch.
    try:
        with nullcontext() if device == "cpu" else torch.device(device):
            judge = held_out and held_out.on(device)
            return _minimise(problem.on(device), parameters.to(device), setup, judge, progress, watch, together)
    except torch.OutOfMemoryError:
        raise ConfigError(
            f"all trainings of a batch must have room in the GPU's memory, but {len(parameters)} have not: train fewer "
            "at once (robustness.count), or leave training.device out"
        ) from None


_MINIMISERS: dict[str, Callable[..., torch.Tensor]] = {
    "adam": optimizers.adam,
    "lbfgs": optimizers.lbfgs,
    "levenberg_marquardt": optimizers.levenberg_marquardt,
}


def _minimise(
    problem: LeastSquares,
    parameters: torch.Tensor,
    setup: FitSetup,
    held_out: LeastSquares | None,
    progress: Progress | None,
    watch: Watch | None,
    together: bool,
) -> Minimum:
    """As :func:`minimise`, where the tensors are."""
    monitor = _Monitor(
        problem=problem,
        held_out=held_out,
        config=setup.training,
        progress=progress,
        watch=watch,
        together=together,
    )
    interrupted = False
    monitor.begin("start", 1, 1)
    monitor(parameters, problem.loss(parameters))
    try:
        for name in ("levenberg_marquardt",) if together else phases(setup.optimizer):
            section = getattr(setup.optimizer, name)
            monitor.begin("trained" if together else name, section.steps, section.patience)
            parameters = _MINIMISERS[name](problem, parameters, section, monitor)
    except KeyboardInterrupt:
        interrupted = True
    return Minimum(
        parameters=monitor.best.cpu(),
        outcomes=_outcomes(monitor, interrupted),
        loss=root_mean_square(monitor.best_score if held_out is None else problem.loss(monitor.best)),
        held_out_loss=None if held_out is None else root_mean_square(monitor.best_score),
        steps=monitor.step,
        seconds=time.perf_counter() - monitor.started,
        history=tuple(monitor.history),
    )


def root_mean_square(losses: torch.Tensor) -> np.ndarray:
    """(G,) over the members of losses (G, M)."""
    return np.asarray(losses.square().mean(dim=1).sqrt().cpu().numpy())


def _outcomes(monitor: _Monitor, interrupted: bool, diverged_factor: float = 10.0) -> tuple[Outcome, ...]:
    """A final loss ``diverged_factor`` times above the first one is a divergence, not a slow start."""
    losses = monitor.last_loss
    if interrupted:
        return (Outcome.INTERRUPTED,) * len(losses)
    diverged = (~losses.isfinite() | (losses > diverged_factor * monitor.first_loss)).any(dim=1).cpu().numpy()
    converged = (monitor.stale >= monitor.patience).all(dim=1).cpu().numpy()  # all members
    return tuple(
        Outcome.DIVERGED if d else Outcome.CONVERGED if c else Outcome.BUDGET_SPENT
        for d, c in zip(diverged, converged, strict=True)
    )
