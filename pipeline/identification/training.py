"""Training (paper, Algorithm 1): phases of an optimiser, held-out speeds, the best state, a named outcome."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from pipeline.coefficients import is_direct, is_stiffness
from pipeline.config.identification import (
    IdentifyConfig,
    LossConfig,
    ModelConfig,
    NetworkModelConfig,
    OptimizerConfig,
    TrainingConfig,
)
from pipeline.config.schema import Config
from pipeline.equations.bearing_equations import BearingEquations
from pipeline.equations.identifiability import Identifiability, identifiability, require_identifiable
from pipeline.equations.unknown_system import unknown_system
from pipeline.identification import optimizers
from pipeline.identification.coefficient_model import CoefficientModel, coefficient_model
from pipeline.identification.identified import IdentificationResult, IdentifiedModel
from pipeline.identification.outcome import Outcome
from pipeline.identification.problem import LeastSquares, ResidualProblem, data_scale, residual_problem, speed_scaling
from pipeline.rotor.bearing_table import BearingTable
from pipeline.unknowns import UnknownSet, unknown_set

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
    force: bool = False


def setup_of(config: Config) -> TrainingSetup:
    """The sections of a configuration that training reads."""
    return TrainingSetup(config.identify, config.model, config.loss, config.optimizer, config.training, config.force)


def phases(config: OptimizerConfig) -> tuple[str, ...]:
    """The optimiser's phases that have steps, in their order."""
    return tuple(name for name in type(config).model_fields if getattr(config, name).steps)


@dataclass(frozen=True, eq=False)
class PreparedTraining:
    """The problem on the training speeds and, where some are held out, on those."""

    model: CoefficientModel
    unknowns: UnknownSet
    train: LeastSquares
    held_out: LeastSquares | None
    held_out_per_speed: ResidualProblem | None  # the residual scaled per speed, whatever ``loss`` is
    bearing_nodes: tuple[int, ...]
    identifiability: tuple[Identifiability, ...]

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
        prepared = self.prepared
        network = prepared.train.network(self.parameters)[g]
        return IdentifiedModel(prepared.model, prepared.unknowns, prepared.bearing_nodes, network)

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
    """Everything before the first step.

    Raises IdentifiabilityError where the runs determine the unknowns of a bearing at no speed, unless ``setup.force``.
    """
    unknowns = unknown_set({node: setup.identify.at(node) for node in equations.bearing_nodes})
    system = unknown_system(equations, unknowns, known)
    alike, constant = setup.identify.tie_bearings, not isinstance(setup.model, NetworkModelConfig)
    accounts = identifiability(equations, system, alike, constant)
    if not setup.force:
        require_identifiable(accounts)
    members = 1 if alike else len(equations.bearing_nodes)
    model = coefficient_model(setup.model, unknowns.names, equations.speeds, data_scale(system, members))
    held_out = held_out_speeds(len(equations.speeds), setup.training.holdout_every)

    def problem(keep: np.ndarray, loss: LossConfig) -> ResidualProblem:
        made = residual_problem(model, equations, system, keep, speed_scaling(loss.scaling, equations))
        return made.preconditioned(loss.regularisation) if loss.kind == "preconditioned" else made

    some, judge = bool(held_out.any()), LossConfig(kind="residual", scaling="per_speed", regularisation=0.0)
    return PreparedTraining(
        model,
        unknowns,
        problem(~held_out, setup.loss),
        problem(held_out, setup.loss) if some else None,
        problem(held_out, judge) if some else None,
        equations.bearing_nodes,
        accounts,
    )


def held_out_speeds(count: int, every: int) -> np.ndarray:
    """(S,) mask of every ``every``-th speed; never the first and last, which would test extrapolation."""
    mask = np.zeros(count, dtype=bool)
    if every:
        mask[every // 2 : -1 : every] = True
        mask[:1] = False
    return mask


def initial_guess(
    setup: TrainingSetup, names: Sequence[str], members: int, stiffness: float | None = None
) -> np.ndarray:
    """(M, U) starting values, N/m and N s/m: as configured, or ``stiffness`` for every direct stiffness.

    Cross-coupled coefficients, which have either sign, start at zero.
    """
    model = setup.model
    values = [
        0.0
        if not is_direct(name)
        else (stiffness or model.initial_stiffness)
        if is_stiffness(name)
        else model.initial_damping
        for name in names
    ]
    return np.tile(values, (members, 1))


def initial_parameters(
    prepared: PreparedTraining, setup: TrainingSetup, seed: int, stiffness: float | None = None
) -> torch.Tensor:
    """(1, M, P) starting parameters from a seed and, if given, a guess of the stiffness.

    With ``model.initialisation`` of ``per_speed`` and no guess, the last layer is fitted to the regularised least
    squares of each training speed.
    """
    import torch

    model = prepared.model
    guess = initial_guess(setup, model.unknowns, len(model.scale), stiffness)
    start = model.initial_parameters(guess, torch.Generator().manual_seed(seed))
    if setup.model.initialisation == "per_speed" and stiffness is None:
        assert isinstance(prepared.train, ResidualProblem), "the response has a start of its own"
        _, answer = prepared.train.per_speed(setup.loss.regularisation)
        start = model.with_output_at(start, prepared.train.inputs, torch.as_tensor(answer) * prepared.train.scale)
    return start[None]


@dataclass
class _Monitor:
    """Sees every step: keeps the best state of each member, the history, and the decision to stop."""

    problem: LeastSquares
    held_out: LeastSquares | None
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
    rounding: Any = None  # (M,) losses below it are equal, or the processor's rounding would count as improvement

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
        if self.rounding is None:
            self.rounding = self.problem.rounding()
        known = torch.maximum(losses, self.rounding)  # NaN stays
        if self.reference is None:
            self.reference, self.stale = known, torch.zeros_like(losses)
        improved = known < self.reference * (1 - self.config.tolerance)
        self.reference = torch.where(improved, known, self.reference)
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
