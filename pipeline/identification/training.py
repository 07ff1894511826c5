"""Training (paper, Algorithm 1): phases of an optimiser, held-out speeds, the best state, a named outcome."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from pipeline.coefficients import is_stiffness
from pipeline.config.schema import Config, IdentifyConfig, LossConfig, ModelConfig, OptimizerConfig, TrainingConfig
from pipeline.equations.bearing_equations import BearingEquations, require_independent_orbits, unknown_system
from pipeline.identification import optimizers
from pipeline.identification.coefficient_model import CoefficientModel, coefficient_model
from pipeline.identification.identified import IdentificationResult, IdentifiedModel
from pipeline.identification.outcome import Outcome
from pipeline.identification.problem import ResidualProblem, data_scale, residual_problem, speed_scaling
from pipeline.rotor.bearing_table import BearingTable

if TYPE_CHECKING:
    import torch

_DIVERGED_FACTOR = 10.0
"""A final loss this far above the first one is a divergence, not a slow start."""


class Watch(Protocol):
    """Something that follows the best state (G, M, P) of a training; what it raises ends the training."""

    def __call__(self, phase: str, step: int, total: int, best: torch.Tensor, /) -> None: ...


class Progress(Protocol):
    """Something that shows a training while it runs, such as a progress bar."""

    def __call__(self, phase: str, step: int, total: int, loss: float, /) -> None: ...


@dataclass(frozen=True)
class TrainingSetup:
    """What is trained, and how: the sections of the configuration that training reads."""

    identify: IdentifyConfig
    model: ModelConfig
    loss: LossConfig
    optimizer: OptimizerConfig
    training: TrainingConfig


def setup_of(config: Config) -> TrainingSetup:
    """The sections of a configuration that training reads."""
    return TrainingSetup(config.identify, config.model, config.loss, config.optimizer, config.training)


def phases(config: OptimizerConfig) -> tuple[str, ...]:
    """The optimiser's phases that have steps, in their order."""
    return tuple(name for name in type(config).model_fields if getattr(config, name).steps)


@dataclass(frozen=True, eq=False)
class PreparedTraining:
    """The problem on the training speeds and, where some are held out, on those."""

    model: CoefficientModel
    train: ResidualProblem
    held_out: ResidualProblem | None
    held_out_per_speed: ResidualProblem | None  # scaled per speed whatever ``loss.scaling`` is
    bearing_nodes: tuple[int, ...]

    def per_speed_held_out_loss(self, parameters: torch.Tensor) -> np.ndarray:
        """(G,) what trainings of any loss are compared by; ``parameters`` (G, M, P).

        Root mean square, over bearings and held-out speeds, of the residual divided by the bearing force of its speed.
        """
        assert self.held_out_per_speed is not None, "no speed is held out"
        return _root_mean_square(self.held_out_per_speed.loss(parameters))


@dataclass(frozen=True, eq=False)
class TrainedBatch:
    """G trainings done at once. Losses are (G,), over the members of each."""

    prepared: PreparedTraining
    parameters: torch.Tensor  # (G, M, P), the best state of every member
    outcomes: tuple[Outcome, ...]
    loss: np.ndarray
    held_out_loss: np.ndarray | None
    steps: int
    seconds: float
    history: tuple[Mapping[str, float | str], ...]
    trajectory: tuple[tuple[int, torch.Tensor], ...]  # (step, parameters), where it was asked for

    def per_speed_held_out_loss(self) -> np.ndarray:
        """(G,) see :meth:`PreparedTraining.per_speed_held_out_loss`."""
        return self.prepared.per_speed_held_out_loss(self.parameters)

    def identified(self, g: int = 0) -> IdentifiedModel:
        """The model of training g."""
        return IdentifiedModel(self.prepared.model, self.prepared.bearing_nodes, self.parameters[g])

    def result(self) -> IdentificationResult:
        """The only training of a batch of one."""
        held_out = None if self.held_out_loss is None else float(self.held_out_loss[0])
        return IdentificationResult(
            self.identified(),
            self.outcomes[0],
            float(self.loss[0]),
            held_out,
            self.steps,
            self.seconds,
            self.history,
        )


def prepare(equations: BearingEquations, known: BearingTable, setup: TrainingSetup) -> PreparedTraining:
    """Everything before the first step. Raises IdentifiabilityError where the runs are too few."""
    system = unknown_system(equations, setup.identify.unknowns, known)
    require_independent_orbits(equations, system)
    members = 1 if setup.identify.tie_bearings else len(equations.bearing_nodes)
    model = coefficient_model(setup.model, setup.identify.unknowns, equations.speeds, data_scale(system, members))
    scaling = speed_scaling(setup.loss.scaling, equations)
    held_out = held_out_speeds(len(equations.speeds), setup.training.holdout_every)
    some = bool(held_out.any())
    judged = speed_scaling("per_speed", equations)
    return PreparedTraining(
        model,
        residual_problem(model, equations, system, ~held_out, scaling),
        residual_problem(model, equations, system, held_out, scaling) if some else None,
        residual_problem(model, equations, system, held_out, judged) if some else None,
        equations.bearing_nodes,
    )


def held_out_speeds(count: int, every: int) -> np.ndarray:
    """(S,) mask of every ``every``-th speed; never the first and last, which would test extrapolation."""
    mask = np.zeros(count, dtype=bool)
    if every:
        mask[every // 2 : -1 : every] = True
        mask[:1] = False
    return mask


def initial_guess(setup: TrainingSetup, members: int, stiffness: float | None = None) -> np.ndarray:
    """(M, U) starting values, N/m and N s/m: as configured, or ``stiffness`` for every unknown stiffness."""
    model = setup.model
    values = [
        (stiffness or model.initial_stiffness) if is_stiffness(name) else model.initial_damping
        for name in setup.identify.unknowns
    ]
    return np.tile(values, (members, 1))


def initial_parameters(
    prepared: PreparedTraining, setup: TrainingSetup, seed: int, stiffness: float | None = None
) -> torch.Tensor:
    """(1, M, P) starting parameters from a seed and, if given, a guess of the stiffness."""
    import torch

    generator = torch.Generator().manual_seed(seed)
    return prepared.model.initial_parameters(initial_guess(setup, len(prepared.model.scale), stiffness), generator)[
        None
    ]


@dataclass
class _Monitor:
    """Sees every step: keeps the best state of each member, the history, and the decision to stop."""

    problem: ResidualProblem
    held_out: ResidualProblem | None
    config: TrainingConfig
    progress: Progress | None
    record_trajectory: bool
    watch: Watch | None
    phase: str = ""
    total: int = 0
    patience: int = 1
    step: int = 0
    phase_start: int = 0
    started: float = field(default_factory=time.perf_counter)
    history: list[dict[str, float | str]] = field(default_factory=list)
    trajectory: list[tuple[int, Any]] = field(default_factory=list)
    best: Any = None  # (G, M, P)
    best_score: Any = None  # (G, M)
    first_loss: Any = None  # (G, M)
    last_loss: Any = None  # (G, M)
    reference: Any = None  # (G, M) loss that the next improvement is measured from
    stale: Any = None  # (G, M) steps since the last improvement of more than the tolerance

    def begin(self, phase: str, total: int, patience: int) -> None:
        self.phase, self.total, self.patience, self.phase_start = phase, total, patience, self.step
        self.reference = self.stale = None

    def __call__(self, parameters: torch.Tensor, losses: torch.Tensor) -> torch.Tensor:
        import torch

        self.last_loss = losses
        score = losses if self.held_out is None else self.held_out.loss(parameters).detach()
        if self.best is None:
            self.best, self.best_score, self.first_loss = parameters.clone(), score.clone(), losses.clone()
        better = (score < self.best_score) | self.best_score.isnan()
        self.best = torch.where(better[..., None], parameters, self.best)
        self.best_score = torch.where(better, score, self.best_score)
        if self.reference is None:
            self.reference, self.stale = losses.clone(), torch.zeros_like(losses)
        improved = losses < self.reference * (1 - self.config.tolerance)
        self.reference = torch.where(improved, losses, self.reference)
        self.stale = torch.where(improved, torch.zeros_like(self.stale), self.stale + 1)
        self._record(parameters, losses, score)
        self.step += 1
        return (self.stale >= self.patience) | ~losses.isfinite()

    def _record(self, parameters: torch.Tensor, losses: torch.Tensor, score: torch.Tensor) -> None:
        loss = float(losses.square().mean().sqrt())
        row: dict[str, float | str] = {"step": self.step, "phase": self.phase, "loss": loss}
        if self.held_out is not None:
            row["held_out_loss"] = float(score.square().mean().sqrt())
        row["seconds"] = time.perf_counter() - self.started
        self.history.append(row)
        if self.record_trajectory:
            self.trajectory.append((self.step, parameters.clone()))
        if self.progress is not None:
            self.progress(self.phase, self.step - self.phase_start + 1, self.total, loss)
        if self.watch is not None:
            self.watch(self.phase, self.step - self.phase_start + 1, self.total, self.best)

    def converged(self) -> np.ndarray:
        """(G,) all members of a training without improvement for ``patience`` steps."""
        return (self.stale >= self.patience).all(dim=1).numpy()


_MINIMISERS: dict[str, Callable[..., torch.Tensor]] = {
    "adam": optimizers.adam,
    "lbfgs": optimizers.lbfgs,
    "levenberg_marquardt": optimizers.levenberg_marquardt,
}


def run_training(
    prepared: PreparedTraining,
    parameters: torch.Tensor,
    setup: TrainingSetup,
    progress: Progress | None = None,
    record_trajectory: bool = False,
    watch: Watch | None = None,
) -> TrainedBatch:
    """Train G starting points (G, M, P) at once. Ctrl-C ends it with the best state so far."""
    monitor = _Monitor(prepared.train, prepared.held_out, setup.training, progress, record_trajectory, watch)
    interrupted = False
    monitor.begin("start", 1, 1)
    monitor(parameters, prepared.train.loss(parameters))
    try:
        for name in phases(setup.optimizer):
            section = getattr(setup.optimizer, name)
            monitor.begin(name, section.steps, section.patience)
            parameters = _MINIMISERS[name](prepared.train, parameters, section, monitor)
    except KeyboardInterrupt:
        interrupted = True
    return _finish(prepared, monitor, interrupted)


def _finish(prepared: PreparedTraining, monitor: _Monitor, interrupted: bool) -> TrainedBatch:
    losses = prepared.train.loss(monitor.best)
    held_out = None if prepared.held_out is None else prepared.held_out.loss(monitor.best)
    return TrainedBatch(
        prepared,
        monitor.best,
        _outcomes(monitor, interrupted),
        _root_mean_square(losses),
        None if held_out is None else _root_mean_square(held_out),
        monitor.step,
        time.perf_counter() - monitor.started,
        tuple(monitor.history),
        tuple(monitor.trajectory),
    )


def _root_mean_square(losses: torch.Tensor) -> np.ndarray:
    return losses.square().mean(dim=1).sqrt().numpy()


def _outcomes(monitor: _Monitor, interrupted: bool) -> tuple[Outcome, ...]:
    losses = monitor.last_loss
    if interrupted:
        return (Outcome.INTERRUPTED,) * len(losses)
    diverged = (~losses.isfinite() | (losses > _DIVERGED_FACTOR * monitor.first_loss)).any(dim=1).numpy()
    converged = monitor.converged()
    return tuple(
        Outcome.DIVERGED if d else Outcome.CONVERGED if c else Outcome.BUDGET_SPENT
        for d, c in zip(diverged, converged, strict=True)
    )
