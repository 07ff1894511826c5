"""The schema of the fit: unknowns, model, loss, optimiser and training."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Annotated, Literal

from pydantic import Field, PositiveFloat, PositiveInt

from pipeline.coefficients import CoefficientName
from pipeline.config.operating import Conditions
from pipeline.config.quantities import Damping, Length, Mass, PositiveAngle, RotorSpeed, Stiffness, WeightLaw
from pipeline.config.section import NonNegativeInt, Once, Section, Share, ascending, rule
from pipeline.unknowns import BearingUnknowns, Structure, UnknownSet, unknown_set

Unknowns = Annotated[tuple[CoefficientName, ...], Once]


class OneBearingConfig(Section):
    """One bearing differs from the rest in these values; null stands for the value of the rest."""

    unknowns: Unknowns | None = None
    structure: Structure | None = None


PositiveShare = Annotated[float, Field(gt=0, lt=1)]


class ModelParametersConfig(Section):
    """Prior standard deviations of uncertain numbers of the model, which are then fitted with the coefficients.

    See :mod:`pipeline.problem.model_parameters` for what each moves; null stands for exactly known.
    """

    youngs_modulus: PositiveShare | None = None
    density: PositiveShare | None = None
    disc_mass: PositiveShare | None = None
    disc_inertia: PositiveShare | None = None
    coupling_stiffness: Stiffness | None = None
    coupling_mass: Mass | None = None
    support_stiffness: PositiveFloat | None = None
    support_damping: PositiveFloat | None = None
    support_mass: PositiveFloat | None = None
    base_participation: PositiveFloat | None = None
    base_softening: PositiveFloat | None = None
    bearing_position: Length | None = None
    bow: Length | None = None
    unbalance_magnitude: PositiveShare | None = None
    unbalance_phase: PositiveAngle | None = None
    weight_angle: PositiveAngle | None = None
    weight_law: WeightLaw | None = None
    weight_gain: PositiveFloat | None = None
    label_gain: PositiveFloat | None = None
    label_angle: PositiveAngle | None = None
    probe_gain: PositiveShare | None = None
    probe_angle: PositiveAngle | None = None
    probe_position: Length | None = None
    runout: Length | None = None
    known_coefficients: PositiveShare | None = None
    bearing_drift: PositiveShare | None = None

    @property
    def deviations(self) -> dict[str, float]:
        """Those that are given, by kind."""
        return {kind: value for kind, value in self if value}


class IdentifyConfig(Section):
    """Which coefficients are unknown, and what ties them together; the others are taken as known.

    ``bearings`` has exceptions by node; ``shared`` makes all bearings alike. With ``unbalance_planes`` a residual
    unbalance at these nodes is identified too, with ``model_parameters`` uncertain numbers of rotor, weights and probes
    (loss ``response``); a coupling that they name acts at ``coupling_node``. ``known_within`` is a factor: so near to
    ``known_stiffness`` and ``known_damping`` (null: to their initial guess, from which the fit only starts otherwise)
    coefficients are expected, one standard deviation of the logarithm (loss ``response``). With ``usual_tolerances``
    what is never known exactly of shaft, weights and probes, and is not among the model parameters, widens all
    deviations.
    """

    unknowns: Unknowns = Field(min_length=1)
    structure: Structure
    shared: bool
    unbalance_planes: tuple[NonNegativeInt, ...] = ()
    model_parameters: ModelParametersConfig = ModelParametersConfig()
    coupling_node: NonNegativeInt = 0
    usual_tolerances: bool = True
    known_within: Annotated[float, Field(gt=1)] | None = None
    known_stiffness: Stiffness | None = None
    known_damping: Damping | None = None
    bearings: dict[NonNegativeInt, OneBearingConfig] = Field(default_factory=dict)

    @rule
    def _lawful(self) -> Iterator[str]:
        if self.shared and self.bearings:
            yield "shared makes all bearings alike, but bearings has exceptions: leave one of them out"
        support = next((kind for kind in self.model_parameters.deviations if kind.startswith("support_")), "")
        if support and not self.known_within:
            yield (
                f"model_parameters.{support} must have known_within, a factor such as 30, beside it, since film and "
                "support in series are told apart in part only: give it"
            )
        if (self.known_stiffness or self.known_damping) and not self.known_within:
            yield "known_stiffness and known_damping must have known_within, a factor such as 30: give it, or neither"
        self.at(-1)
        for node in self.bearings:
            self.at(node)

    def at(self, node: int) -> BearingUnknowns:
        """Return what is unknown at the bearing of ``node``. Raises ValueError where half of a structure is known."""
        bearing = self.bearings.get(node, OneBearingConfig())
        return BearingUnknowns(
            self.unknowns if bearing.unknowns is None else bearing.unknowns, bearing.structure or self.structure
        )

    def unknowns_of(self, nodes: Sequence[int]) -> UnknownSet:
        """Return what is unknown at the bearings of these nodes."""
        return unknown_set({node: self.at(node) for node in nodes}, self.shared, self.unbalance_planes)

    def named(self) -> tuple[str, ...]:
        """Every coefficient that is unknown at some bearing, in the order of the configuration."""
        return tuple(
            dict.fromkeys([*self.unknowns, *(n for bearing in self.bearings.values() for n in bearing.unknowns or ())])
        )


class LossConfig(Section):
    """What training minimises.

    ``residual``: the residual of the equation of motion (paper, eq. 6), per speed divided by its size or not.
    ``preconditioned``: the same, multiplied at each speed by the regularised pseudo-inverse of its derivative by
    the unknowns; ``regularisation`` is relative to the largest singular value.
    ``response``: predicted less measured displacements over the sensors' noise, which is as ``stated_noise`` says or of
    that shape and ``estimated`` size; ``robust`` gives readings far off less weight. It keeps the hidden layers of a
    network as ``drawn`` (random features), or has them ``trained`` in so many ``networks``, whose mean is the answer.
    ``beyond_trend`` is the prior standard deviation of a coefficient from a power law and a straight line over the
    speed, of the model's output: its logarithm, or its share of the coefficient's size.
    """

    kind: Literal["residual", "preconditioned", "response"]
    scaling: Literal["per_speed", "none"]
    regularisation: Share
    noise: Literal["stated", "estimated"] = "stated"
    robust: bool = True
    beyond_trend: PositiveFloat = 0.3
    hidden: Literal["drawn", "trained"] = "drawn"
    networks: Annotated[int, Field(ge=4, le=200, multiple_of=2)] = 8

    @rule
    def _trains_hidden(self) -> Iterator[str]:
        if self.hidden == "trained" and self.kind != "response":
            yield f"hidden: trained must come with kind: response (others train all layers), got {self.kind}"

    @property
    def preconditioned(self) -> bool:
        """True where the residual is multiplied by the pseudo-inverse of its derivative."""
        return self.kind == "preconditioned"


class _PhaseConfig(Section):
    """Ends after ``steps``, or when the loss fell by less than ``training.tolerance`` in ``patience`` steps."""

    steps: NonNegativeInt
    patience: PositiveInt


class AdamConfig(_PhaseConfig):
    """Adam with the learning rate falling to ``final_rate_fraction`` of itself along a cosine."""

    learning_rate: PositiveFloat
    final_rate_fraction: Annotated[float, Field(gt=0, le=1)]


class LBFGSConfig(_PhaseConfig):
    """L-BFGS with a strong Wolfe line search."""

    history: PositiveInt


class LevenbergMarquardtConfig(_PhaseConfig):
    """Damped Gauss-Newton steps, each member of a batch with its own damping."""

    initial_damping: PositiveFloat


class OptimizerConfig(Section):
    """Phases run in this order; a phase of 0 steps is left out."""

    adam: AdamConfig
    lbfgs: LBFGSConfig
    levenberg_marquardt: LevenbergMarquardtConfig

    @rule
    def _some_steps(self) -> Iterator[str]:
        if self.adam.steps + self.lbfgs.steps + self.levenberg_marquardt.steps == 0:
            yield "must have a phase with steps > 0, but adam, lbfgs and levenberg_marquardt all have 0"


class TrainingConfig(Section):
    """Stopping and model selection, on held-out speeds."""

    holdout_every: NonNegativeInt
    holdout_runs: tuple[str, ...] = ()
    holdout_range: tuple[RotorSpeed, RotorSpeed] | None = None  # rad/s, speeds that are predicted, not fitted
    holdout_operating: Conditions = Field(default_factory=dict)  # SI, conditions that are predicted, not fitted
    tolerance: Share
    device: Literal["cpu", "cuda"] = "cpu"  # what is trained at once by a loss without a start of its own

    @rule
    def _leaves_training_speeds(self) -> Iterator[str]:
        if self.holdout_every == 1:
            yield "must have holdout_every = 0 (none) or at least 2, but got 1, which leaves no speed to train on"
        if self.holdout_range and self.holdout_range[0] > self.holdout_range[1]:
            low, high = self.holdout_range
            yield f"must have holdout_range = [from, to] with from <= to, but got {low:g} and {high:g} rad/s"


class RobustnessConfig(Section):
    """What is varied: initial guesses (log-spaced, for every unknown stiffness), seeds, the noise of modelled data, or
    (``refit``) all that differs from one measurement of the modelled machine to the next.
    """

    over: Literal["initial_guess", "seed", "refit"]
    lowest_stiffness: Stiffness
    highest_stiffness: Stiffness
    count: Annotated[int, Field(ge=2, le=1000)]
    seeds: tuple[NonNegativeInt, ...] = Field(min_length=1)
    workers: PositiveInt = 1  # processes of refits

    _span = ascending("lowest_stiffness", "highest_stiffness", strictly=True)
