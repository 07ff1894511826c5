"""What a configuration may say, checked when it is made: the whole.

One class a concept, in the order of the straight line of data. Values are SI (see
:mod:`pipeline.config.quantities`); rotor speeds alone are in rpm here, named ``*_rpm``.
"""

from __future__ import annotations

from pydantic import Field, PositiveFloat, PositiveInt, model_validator

from pipeline.config.comparison import ComparisonConfig
from pipeline.config.excitation import DesignConfig, ExcitationConfig, NoiseConfig, UnbalanceConfig
from pipeline.config.identification import (
    IdentifyConfig,
    LossConfig,
    ModelConfig,
    OptimizerConfig,
    RobustnessConfig,
    TrainingConfig,
)
from pipeline.config.ingest import IngestConfig
from pipeline.config.machine import BearingConfig, PerNodeBearingConfig, RotorConfig
from pipeline.config.section import NonNegativeInt, Section
from pipeline.config.sensors import SensorsConfig
from pipeline.config.tuning import TuningConfig


class DataConfig(Section):
    """The files that training reads; null stands for the experiment's own.

    ``baseline`` is the run of the machine as it was found, which is subtracted from the others.
    """

    vibration: str | None = None
    excitation: str | None = None
    known: str | None = None
    baseline: str | None = None


class PredictionConfig(Section):
    """An unbalance that training never saw, and where and when to look at its vibration."""

    node: NonNegativeInt
    speed_rpm: PositiveFloat
    unbalances: tuple[UnbalanceConfig, ...] = Field(min_length=1)


class TrackingConfig(Section):
    """Where MLflow keeps the records; ``enabled: false`` keeps none."""

    enabled: bool
    uri: str
    timeout_seconds: PositiveFloat


class CheckConfig(Section):
    """Experiments that ``stage=check`` looks at; empty stands for all in ``conf/thresholds``."""

    experiments: tuple[str, ...] = ()


class PromotedConfig(Section):
    """Values of a study that are in force, and those that the command line overrode (by dotted key)."""

    study: str
    trial: NonNegativeInt
    in_force: dict[str, bool | int | float | str]
    overridden: dict[str, bool | int | float | str]


class Config(Section):
    """A complete experiment and the stage to run."""

    stage: str
    name: str = Field(pattern=r"^[A-Za-z0-9_-]+$")
    description: str
    output: str = Field(min_length=1)
    seed: NonNegativeInt
    threads: PositiveInt
    device: str = Field(pattern=r"^(cpu|cuda(:\d+)?)$")
    force: bool
    rotor: RotorConfig
    bearing: BearingConfig
    excitation: ExcitationConfig
    sensors: SensorsConfig
    ingest: IngestConfig
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
    comparison: ComparisonConfig
    tracking: TrackingConfig
    check: CheckConfig

    @model_validator(mode="after")
    def _trains_by_a_residual(self) -> Config:
        other = self.stage in ("tune", "samplers") or (self.stage == "robustness" and self.robustness.over != "noise")
        if self.loss.kind == "response" and other:
            raise ValueError(
                "studies, and robustness over seeds and guesses, must have loss=residual or loss=preconditioned, but "
                "got loss=response, which has a start of its own: use stage=robustness robustness=noise_seeds"
            )
        return self

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
        if not isinstance(self.sensors.probes, str):
            used += [("sensors.probes", probe.node) for probe in self.sensors.probes]
        for what, node in [*used, ("prediction.node", self.prediction.node)]:
            if node > last:
                raise ValueError(f"must use nodes 0 to {last} of the rotor, but {what} got node {node}")
        return self
