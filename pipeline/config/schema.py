"""What a configuration may say, checked when it is made.

One class a concept, in the order of the straight line of data. Values are SI (see
:mod:`pipeline.config.quantities`); rotor speeds alone are in rpm here, named ``*_rpm``.
"""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, PositiveFloat, PositiveInt, model_validator

from pipeline.coefficients import COEFFICIENTS, CoefficientName
from pipeline.config.quantities import (
    Angle,
    Bore,
    Damping,
    Density,
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


class RotorFileBearingConfig(_Section):
    """The bearings that are saved in ``rotor.file``."""

    kind: Literal["rotor_file"]


BearingConfig = Annotated[
    BallBearingConfig | CylindricalBearingConfig | RotorFileBearingConfig, Field(discriminator="kind")
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


class ForceConfig(_Section):
    """An unbalance (kg m) at a node; several make one run."""

    node: NonNegativeInt
    magnitude: UnbalanceMagnitude
    phase: Angle = 0.0


class RunConfig(_Section):
    """One unbalance configuration, measured over all speeds."""

    name: str = Field(min_length=1)
    unbalances: tuple[ForceConfig, ...] = Field(min_length=1)


class ExcitationConfig(_Section):
    """The runs and the speeds that vibration is generated for."""

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


class IdentifyConfig(_Section):
    """Which coefficients are unknown; the others are taken as known."""

    unknowns: tuple[CoefficientName, ...] = Field(min_length=1)
    tie_bearings: bool = False

    @model_validator(mode="after")
    def _once(self) -> IdentifyConfig:
        if len(set(self.unknowns)) != len(self.unknowns):
            raise ValueError(f"must name each unknown once, but got {list(self.unknowns)}")
        return self

    def known(self) -> tuple[str, ...]:
        """The coefficients that are not identified."""
        return tuple(name for name in COEFFICIENTS if name not in self.unknowns)


class _CoefficientModelConfig(_Section):
    parametrisation: Literal["log", "scaled"]
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
    """The residual of the equation of motion (paper, eq. 6), per speed divided by its size or not."""

    kind: Literal["residual"]
    scaling: Literal["per_speed", "none"]


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
    unbalances: tuple[ForceConfig, ...] = Field(min_length=1)


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
        last = sum(segment.elements for segment in self.rotor.shaft)
        used = [(f"excitation run '{run.name}'", u.node) for run in self.excitation.runs for u in run.unbalances]
        used += [("prediction.unbalances", u.node) for u in self.prediction.unbalances]
        for what, node in [*used, ("prediction.node", self.prediction.node)]:
            if node > last:
                raise ValueError(f"must use nodes 0 to {last} of the rotor, but {what} got node {node}")
        return self
