"""What a configuration may say, checked when it is made.

One class a concept, in the order of the straight line of data. Values are SI (see
:mod:`pipeline.config.quantities`); rotor speeds alone are in rpm here, named ``*_rpm``.
"""

from __future__ import annotations

import itertools
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, PositiveFloat, PositiveInt, model_validator

from pipeline.coefficients import CoefficientName
from pipeline.config.quantities import (
    Angle,
    Bore,
    Damping,
    Density,
    Deviation,
    Force,
    Inertia,
    Length,
    Mass,
    Pressure,
    Stiffness,
    UnbalanceMagnitude,
    Viscosity,
)
from pipeline.config.tuning import TuningConfig
from pipeline.unknowns import BearingUnknowns, Structure

NonNegativeInt = Annotated[int, Field(ge=0)]


class _Section(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, strict=False)


# --- rotor -------------------------------------------------------------------------------------


class MaterialConfig(_Section):
    """An isotropic shaft and disc material."""

    density: Density
    youngs_modulus: Pressure
    shear_modulus: Pressure


class ShaftSegmentConfig(_Section):
    """A cylindrical piece of shaft, divided into ``elements`` equal finite elements."""

    length: Length
    outer_diameter: Length
    inner_diameter: Bore = 0.0
    elements: PositiveInt = 1

    @model_validator(mode="after")
    def _hollow(self) -> ShaftSegmentConfig:
        if self.inner_diameter >= self.outer_diameter:
            raise ValueError(
                f"must have inner_diameter < outer_diameter, but got {self.inner_diameter:g} m and "
                f"{self.outer_diameter:g} m"
            )
        return self


class DiscConfig(_Section):
    """A rigid disc: by its geometry (width, diameters) or by its inertia (mass, Id, Ip)."""

    node: NonNegativeInt
    width: Length | None = None
    inner_diameter: Length | None = None
    outer_diameter: Length | None = None
    mass: Mass | None = None
    diametral_inertia: Inertia | None = None
    polar_inertia: Inertia | None = None

    @model_validator(mode="after")
    def _one_description(self) -> DiscConfig:
        geometry = (self.width, self.inner_diameter, self.outer_diameter)
        inertia = (self.mass, self.diametral_inertia, self.polar_inertia)
        complete = [all(v is not None for v in group) for group in (geometry, inertia)]
        given = [any(v is not None for v in group) for group in (geometry, inertia)]
        if given != complete or sum(complete) != 1:
            raise ValueError(
                "must give either width, inner_diameter and outer_diameter, or mass, diametral_inertia and "
                f"polar_inertia, but got {sorted(self.model_fields_set - {'node'})}"
            )
        inner, outer = self.inner_diameter, self.outer_diameter
        if inner is not None and outer is not None and inner >= outer:
            raise ValueError(f"must have inner_diameter < outer_diameter, but got {inner:g} m and {outer:g} m")
        return self


class RotorConfig(_Section):
    """Shaft, discs and bearing nodes; or ``file``, a rotor saved by ROSS (.toml, .json)."""

    file: str | None = None
    shaft: tuple[ShaftSegmentConfig, ...] = ()
    material: MaterialConfig | None = None
    discs: tuple[DiscConfig, ...] = ()
    bearing_nodes: tuple[NonNegativeInt, ...] = ()
    shear_effects: bool = True

    @model_validator(mode="after")
    def _nodes_exist(self) -> RotorConfig:
        if self.file is not None:
            return self
        if not self.shaft or self.material is None or not self.bearing_nodes:
            raise ValueError("must give shaft, material and bearing_nodes (or file, a rotor saved by ROSS)")
        last = sum(segment.elements for segment in self.shaft)
        if len(set(self.bearing_nodes)) != len(self.bearing_nodes):
            raise ValueError(f"must name each bearing node once, but got bearing_nodes {list(self.bearing_nodes)}")
        for what, nodes in (
            ("bearing_nodes", self.bearing_nodes),
            ("discs", [disc.node for disc in self.discs]),
        ):
            for node in nodes:
                if node > last:
                    raise ValueError(
                        f"must use nodes 0 to {last} (the shaft has {last} elements), but {what} got node {node}"
                    )
        return self


# --- bearings: the model that data are generated from ------------------------------------------


class BallBearingConfig(_Section):
    """ROSS ``BallBearingElement`` (Friswell et al. 2010, pages 182-185)."""

    kind: Literal["ball"]
    n_balls: PositiveInt
    ball_diameter: Length
    static_load: Force
    contact_angle: Angle


class CylindricalBearingConfig(_Section):
    """ROSS ``CylindricalBearing``, a short fluid-film bearing (Friswell et al. 2010, page 177).

    ``static_load`` of null shares the rotor's weight equally among the bearings.
    """

    kind: Literal["cylindrical"]
    journal_diameter: Length
    length: Length
    radial_clearance: Length
    oil_viscosity: Viscosity
    static_load: Force | None = None


class JournalTableConfig(_Section):
    """A journal bearing from a published table of dimensionless coefficients over the Sommerfeld number.

    ``rows`` are (S, Kxx, Kxy, Kyx, Kyy, Bxx, Bxy, Byx, Byy), with x the direction of the load,
    S = viscosity N L D / W (R / C)^2, N in 1/s; k = K W / C and c = B W / (w C). Between the rows: cubic splines of the
    logarithm of S.
    """

    kind: Literal["journal_table"]
    rows: tuple[Annotated[tuple[float, ...], Field(min_length=9, max_length=9)], ...] = Field(min_length=4)
    journal_diameter: Length
    length: Length
    radial_clearance: Length
    oil_viscosity: Viscosity
    static_load: Force

    @model_validator(mode="after")
    def _ascending(self) -> JournalTableConfig:
        numbers = [row[0] for row in self.rows]
        if numbers[0] <= 0 or any(b <= a for a, b in itertools.pairwise(numbers)):
            raise ValueError(f"must have rows with ascending Sommerfeld numbers above zero, but got {numbers}")
        return self


class LinearBearingConfig(_Section):
    """A support with the same coefficients at every speed, N/m and N s/m."""

    kind: Literal["linear"]
    kxx: float = 0.0
    kxy: float = 0.0
    kyx: float = 0.0
    kyy: float = 0.0
    cxx: float = 0.0
    cxy: float = 0.0
    cyx: float = 0.0
    cyy: float = 0.0


class RotorFileBearingConfig(_Section):
    """The bearings that are saved in ``rotor.file``."""

    kind: Literal["rotor_file"]


AnyBearingConfig = Annotated[
    BallBearingConfig | CylindricalBearingConfig | JournalTableConfig | LinearBearingConfig, Field(discriminator="kind")
]


class PerNodeBearingConfig(_Section):
    """Bearings that differ, by node."""

    kind: Literal["per_node"]
    nodes: dict[NonNegativeInt, AnyBearingConfig] = Field(min_length=1)


BearingConfig = Annotated[
    BallBearingConfig
    | CylindricalBearingConfig
    | JournalTableConfig
    | LinearBearingConfig
    | PerNodeBearingConfig
    | RotorFileBearingConfig,
    Field(discriminator="kind"),
]


# --- excitation --------------------------------------------------------------------------------


class SpeedsConfig(_Section):
    """Rotor speeds from ``start_rpm`` to ``stop_rpm`` inclusive."""

    start_rpm: PositiveFloat
    stop_rpm: PositiveFloat
    step_rpm: PositiveFloat

    @model_validator(mode="after")
    def _ascending(self) -> SpeedsConfig:
        if self.start_rpm > self.stop_rpm:
            raise ValueError(f"must have start_rpm <= stop_rpm, but got {self.start_rpm:g} and {self.stop_rpm:g}")
        return self

    def rpm(self) -> list[float]:
        """The speeds, ascending, in rpm."""
        count = int((self.stop_rpm - self.start_rpm) / self.step_rpm + 1e-9) + 1
        return [self.start_rpm + i * self.step_rpm for i in range(count)]


class UnbalanceConfig(_Section):
    """An unbalance (kg m) at a node; it excites forward whirl at the rotor speed."""

    node: NonNegativeInt
    magnitude: UnbalanceMagnitude
    phase: Angle = 0.0


class ForceConfig(_Section):
    """A rotating force (N) at a node, of a shaker or a magnetic bearing."""

    node: NonNegativeInt
    magnitude: Force
    phase: Angle = 0.0
    whirl: Literal["forward", "backward"] = "forward"


class RunConfig(_Section):
    """One configuration of unbalances and forces, measured over all speeds.

    The forces turn at the rotor speed, or at ``frequency_hz``, or at ``frequency_ratio`` times the rotor speed;
    unbalances always turn with the rotor.
    """

    name: str = Field(min_length=1)
    unbalances: tuple[UnbalanceConfig, ...] = ()
    forces: tuple[ForceConfig, ...] = ()
    frequency_hz: PositiveFloat | None = None
    frequency_ratio: PositiveFloat | None = None

    @model_validator(mode="after")
    def _excited(self) -> RunConfig:
        if not self.unbalances and not self.forces:
            raise ValueError(f"run '{self.name}' must have an unbalance or a force, but it has none")
        if self.frequency_hz is not None and self.frequency_ratio is not None:
            raise ValueError(f"run '{self.name}' must have frequency_hz or frequency_ratio, but it has both")
        if self.unbalances and (self.frequency_hz or self.frequency_ratio):
            raise ValueError(
                f"run '{self.name}' must have no unbalances where its forces have a frequency of their own (unbalances "
                "turn with the rotor), but it has some: put them into another run"
            )
        return self


class ExcitationConfig(_Section):
    """The runs and the speeds that vibration is generated for; ``file`` is where they came from, if from a file."""

    file: str | None = None
    speeds: SpeedsConfig
    runs: tuple[RunConfig, ...] = Field(min_length=1)

    @model_validator(mode="after")
    def _names(self) -> ExcitationConfig:
        names = [run.name for run in self.runs]
        if len(set(names)) != len(names):
            raise ValueError(f"must give every run a name of its own, but got {names}")
        return self


class DataConfig(_Section):
    """The files that training reads; null stands for the experiment's own."""

    vibration: str | None = None
    excitation: str | None = None
    known: str | None = None


# --- identification ----------------------------------------------------------------------------


class OneBearingConfig(_Section):
    """What one bearing has otherwise than the rest; null stands for what the rest has."""

    unknowns: tuple[CoefficientName, ...] | None = None
    structure: Structure | None = None


class IdentifyConfig(_Section):
    """Which coefficients are unknown, and what ties them together; the others are taken as known.

    ``bearings`` has exceptions by node; ``tie_bearings`` makes all bearings alike.
    """

    unknowns: tuple[CoefficientName, ...] = Field(min_length=1)
    structure: Structure
    tie_bearings: bool
    bearings: dict[NonNegativeInt, OneBearingConfig] = {}

    @model_validator(mode="after")
    def _lawful(self) -> IdentifyConfig:
        if self.tie_bearings and self.bearings:
            raise ValueError(
                "tie_bearings makes all bearings alike, but bearings has exceptions: leave one of them out"
            )
        for unknowns in (self.unknowns, *(one.unknowns or () for one in self.bearings.values())):
            if len(set(unknowns)) != len(unknowns):
                raise ValueError(f"must name each unknown once, but got {list(unknowns)}")
        self.at(-1)
        for node in self.bearings:
            self.at(node)
        return self

    def at(self, node: int) -> BearingUnknowns:
        """What is unknown of the bearing at ``node``. Raises ValueError for a structure that half of is known."""
        one = self.bearings.get(node, OneBearingConfig())
        return BearingUnknowns(self.unknowns if one.unknowns is None else one.unknowns, one.structure or self.structure)

    def named(self) -> tuple[str, ...]:
        """Every coefficient that is unknown at some bearing, in the order of the configuration."""
        return tuple(
            dict.fromkeys([*self.unknowns, *(n for one in self.bearings.values() for n in one.unknowns or ())])
        )


class _CoefficientModelConfig(_Section):
    parametrisation: Literal["log", "scaled"]
    initialisation: Literal["guess", "per_speed"]
    initial_stiffness: Stiffness
    initial_damping: Damping


class ConstantModelConfig(_CoefficientModelConfig):
    """One trainable parameter a coefficient, the same at every speed (paper, section 4.1)."""

    kind: Literal["constant"]


class NetworkModelConfig(_CoefficientModelConfig):
    """A multilayer perceptron of the rotor speed (paper, section 4.2)."""

    kind: Literal["network"]
    width: Annotated[int, Field(ge=1, le=512)]
    depth: Annotated[int, Field(ge=1, le=8)]
    activation: Literal["tanh", "silu", "sine"]
    input_scaling: Literal["rpm", "log_rpm"]


ModelConfig = Annotated[ConstantModelConfig | NetworkModelConfig, Field(discriminator="kind")]


class LossConfig(_Section):
    """What training minimises.

    ``residual``: the residual of the equation of motion (paper, eq. 6), per speed divided by its size or not.
    ``preconditioned``: the same, multiplied at each speed by the regularised pseudo-inverse of its derivative by
    the unknowns; ``regularisation`` is relative to the largest singular value.
    """

    kind: Literal["residual", "preconditioned"]
    scaling: Literal["per_speed", "none"]
    regularisation: Annotated[float, Field(ge=0, lt=1)]


class _PhaseConfig(_Section):
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


class OptimizerConfig(_Section):
    """Phases run in this order; a phase of 0 steps is left out."""

    adam: AdamConfig
    lbfgs: LBFGSConfig
    levenberg_marquardt: LevenbergMarquardtConfig

    @model_validator(mode="after")
    def _some_steps(self) -> OptimizerConfig:
        if self.adam.steps + self.lbfgs.steps + self.levenberg_marquardt.steps == 0:
            raise ValueError("must have a phase with steps > 0, but adam, lbfgs and levenberg_marquardt all have 0")
        return self


class TrainingConfig(_Section):
    """Stopping and model selection, on held-out speeds."""

    holdout_every: NonNegativeInt
    tolerance: Annotated[float, Field(ge=0, lt=1)]

    @model_validator(mode="after")
    def _leaves_training_speeds(self) -> TrainingConfig:
        if self.holdout_every == 1:
            raise ValueError(
                "must have holdout_every = 0 (none) or at least 2, but got 1, which leaves no speed to train on"
            )
        return self


# --- after training ----------------------------------------------------------------------------


class RobustnessConfig(_Section):
    """What is varied: initial guesses (log-spaced, for every unknown stiffness) or seeds."""

    over: Literal["initial_guess", "seed"]
    lowest_stiffness: Stiffness
    highest_stiffness: Stiffness
    count: Annotated[int, Field(ge=2, le=1000)]
    seeds: tuple[NonNegativeInt, ...] = Field(min_length=1)

    @model_validator(mode="after")
    def _ascending(self) -> RobustnessConfig:
        if self.lowest_stiffness >= self.highest_stiffness:
            raise ValueError(
                "must have lowest_stiffness < highest_stiffness, "
                f"but got {self.lowest_stiffness:g} and {self.highest_stiffness:g} N/m"
            )
        return self


class PredictionConfig(_Section):
    """An unbalance that training never saw, and where and when to look at its vibration."""

    node: NonNegativeInt
    speed_rpm: PositiveFloat
    unbalances: tuple[UnbalanceConfig, ...] = Field(min_length=1)


class NoiseConfig(_Section):
    """Root mean square of the noise of each measured complex displacement: ``additive``, and a share of its size."""

    additive: Deviation
    multiplicative: Annotated[float, Field(ge=0, lt=1)]

    @model_validator(mode="after")
    def _some(self) -> NoiseConfig:
        if not self.additive and not self.multiplicative:
            raise ValueError("must have an additive or a multiplicative part above zero, but both are zero")
        return self


class CandidateConfig(_Section):
    """What an experimenter can do: trial unbalances and rotating forces, at these nodes and phases."""

    unbalance_nodes: tuple[NonNegativeInt, ...]
    unbalance: UnbalanceMagnitude
    force_nodes: tuple[NonNegativeInt, ...]
    force: Force
    whirls: tuple[Literal["forward", "backward"], ...]
    phases_deg: tuple[float, ...] = Field(min_length=1)

    @model_validator(mode="after")
    def _some(self) -> CandidateConfig:
        if not self.unbalance_nodes and not (self.force_nodes and self.whirls):
            raise ValueError("must have an unbalance node, or a force node and a whirl, but there is no candidate")
        return self


class DesignConfig(_Section):
    """Which runs ``stage=design`` chooses: so many of the candidates, best by the criterion over speeds."""

    runs: PositiveInt
    criterion: Literal["A", "D"]
    speeds: Annotated[int, Field(ge=2)]
    simulations: NonNegativeInt
    candidates: CandidateConfig


class TrackingConfig(_Section):
    """Where MLflow keeps the records; ``enabled: false`` keeps none."""

    enabled: bool
    uri: str
    timeout_seconds: PositiveFloat


class CheckConfig(_Section):
    """Experiments that ``stage=check`` looks at; empty stands for all in ``conf/thresholds``."""

    experiments: tuple[str, ...] = ()


class PromotedConfig(_Section):
    """Values of a study that are in force, and those that the command line overrode (by dotted key)."""

    study: str
    trial: NonNegativeInt
    in_force: dict[str, bool | int | float | str]
    overridden: dict[str, bool | int | float | str]


class Config(_Section):
    """A complete experiment and the stage to run."""

    stage: str
    name: str = Field(pattern=r"^[A-Za-z0-9_-]+$")
    description: str
    output: str = Field(min_length=1)
    seed: NonNegativeInt
    threads: PositiveInt
    force: bool
    rotor: RotorConfig
    bearing: BearingConfig
    excitation: ExcitationConfig
    data: DataConfig
    identify: IdentifyConfig
    model: ModelConfig
    loss: LossConfig
    optimizer: OptimizerConfig
    training: TrainingConfig
    tuned: bool
    tuning: TuningConfig
    promoted: PromotedConfig | None = None
    stated_noise: NoiseConfig
    design: DesignConfig
    robustness: RobustnessConfig
    prediction: PredictionConfig
    tracking: TrackingConfig
    check: CheckConfig

    @model_validator(mode="after")
    def _nodes_exist(self) -> Config:
        if self.rotor.file is not None:
            return self
        if self.bearing.kind == "rotor_file":
            raise ValueError("must give rotor.file where bearing.kind is rotor_file, but rotor.file is null")
        if isinstance(self.bearing, PerNodeBearingConfig):
            without = [node for node in self.rotor.bearing_nodes if node not in self.bearing.nodes]
            if without:
                raise ValueError(
                    f"bearing.nodes must have a bearing for every bearing node of the rotor, but node {without[0]} has "
                    f"none (it has {', '.join(map(str, self.bearing.nodes))})"
                )
        last = sum(segment.elements for segment in self.rotor.shaft)
        used = [
            (f"excitation run '{run.name}'", node)
            for run in self.excitation.runs
            for node in (*(u.node for u in run.unbalances), *(f.node for f in run.forces))
        ]
        used += [("prediction.unbalances", u.node) for u in self.prediction.unbalances]
        for what, node in [*used, ("prediction.node", self.prediction.node)]:
            if node > last:
                raise ValueError(f"must use nodes 0 to {last} of the rotor, but {what} got node {node}")
        return self
