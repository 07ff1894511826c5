"""The schema of the whole configuration, checked when it is made.

One class a concept, in the order of the straight line of data. Values are SI (see
:mod:`pipeline.config.quantities`); rotor speeds alone are in rpm here, named ``*_rpm``.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Literal, get_args

from pydantic import Field, PositiveFloat, PositiveInt

from pipeline.config.balance import BalanceConfig, PredictConfig
from pipeline.config.comparison import ComparisonConfig
from pipeline.config.identification import LossConfig, OptimizerConfig, RobustnessConfig, TrainingConfig
from pipeline.config.machine import MachineConfig
from pipeline.config.measured import Known
from pipeline.config.models import ModelConfig
from pipeline.config.operating import Conditions, Differences
from pipeline.config.promotion import PromotedTrial
from pipeline.config.runs import DesignConfig, NoiseConfig
from pipeline.config.section import NonNegativeInt, Section, rule
from pipeline.config.tuning import TuningConfig
from pipeline.parameters.identify import IdentifyConfig


class DataConfig(Section):
    """The files that training reads; null stands for the experiment's own. ``known`` may be values in place of a file,
    or ``bearings``: those of the machine's bearings.

    ``baseline`` is the run of the machine as it was found, which is subtracted from the others. Operating conditions in
    files of the user's own that differ by no more than ``same_conditions`` are one.
    """

    vibration: str | None = None
    excitation: str | None = None
    known: Known = None
    baseline: str | None = None
    same_conditions: Differences = Field(default_factory=dict)


class TrackingConfig(Section):
    """MLflow keeps the records at ``uri``; ``enabled: false`` keeps none."""

    enabled: bool
    uri: str
    timeout_seconds: PositiveFloat


class CheckConfig(Section):
    """Experiments that ``stage=check`` looks at; empty stands for all in ``conf/thresholds``.

    Metrics that ``changed`` by more than this share since they were committed are printed first; ``commit`` commits.
    """

    experiments: tuple[str, ...] = ()
    changed: PositiveFloat
    commit: bool


class ReportConfig(Section):
    """``reference`` is a table of coefficients (CSV, Excel) that the report draws beside the identified ones."""

    reference: str | None = None


ExportFormat = Literal["ross", "csv", "excel", "json", "dyrobes", "ansys"]


class ExportConfig(Section):
    """``stage=export`` writes the identified bearings in these formats; ROSS's files are SI whatever the ``units``.

    ``operating`` are the states at which it does so, of data with operating conditions; none for the measured ones.
    """

    units: Literal["si", "us"]
    formats: tuple[ExportFormat, ...] = Field(min_length=1)
    operating: tuple[Conditions, ...] = ()


class NewConfig(Section):
    """``stage=new`` writes a machine file for this kind of bearings, what they stand on, what the probes measure the
    motion of, and this source of data, or for that of a file of a logger (``from``), filled with what is recognised in
    it."""

    bearings: Literal["rolling", "fluid_film"]
    supports: Literal["none", "pedestals", "base"] = "none"
    probes: Literal["shaft", "relative", "casing", "both"] = "shaft"
    data: Literal["recordings", "tables", "exciter", "processed", "simulated"]
    source: str | None = Field(default=None, alias="from")


class PromotedConfig(PromotedTrial):
    """What a study promoted, the values of it that are in force, and those that the command line overrode (by dotted
    key)."""

    configured: dict[str, bool | int | float | str]  # what was in the place of those in force
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
    force: bool
    machine: MachineConfig
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
    comparison: ComparisonConfig
    tracking: TrackingConfig
    check: CheckConfig
    report: ReportConfig = Field(default=ReportConfig())
    balance: BalanceConfig = BalanceConfig()
    predict: PredictConfig = PredictConfig()
    export: ExportConfig = Field(default=ExportConfig(units="si", formats=get_args(ExportFormat)), exclude=True)
    new: NewConfig = Field(default=NewConfig(bearings="fluid_film", data="simulated"), exclude=True)
    chosen_by: str = Field(default="", exclude=True)
    overrides: tuple[str, ...] = Field(default=(), exclude=True)  # what the command line changed of the experiment

    @property
    def chosen(self) -> str:
        """The overrides that name this experiment in another command."""
        return self.chosen_by or f"experiment={self.name}"

    def describe_noise(self) -> str:
        """The stated noise, such as ``0.1 % noise``, or what takes its place in records of conditions."""
        if self.machine.recordings.by_frequency:
            return "the noise of the averages"
        noise, floors = self.stated_noise, " or ".join(self.machine.floors)
        parts = [f"{100 * noise.multiplicative:g} %"] if noise.multiplicative else []
        parts += [f"{1e6 * noise.additive:g} um"] if noise.additive else []
        stated = " and ".join([*parts, floors] if floors else parts) + " noise"
        levels = "the noise of the conditions (where they are too few to tell it, "
        return f"{levels}{stated})" if self.machine.recordings.planes else stated

    @rule
    def _has_noise(self) -> Iterator[str]:
        if not (self.stated_noise.additive or self.stated_noise.multiplicative or self.machine.floors):
            yield (
                "stated_noise must have an additive or a multiplicative part above zero, or a probe a floor, but there "
                "is none"
            )

    @rule
    def _fits_its_loss(self) -> Iterator[str]:
        if self.loss.kind == "response" and self.stage == "robustness" and self.robustness.over != "refit":
            yield (
                "robustness over seeds and guesses must have loss=residual or loss=preconditioned, but got "
                "loss=response, which has a start of its own: use stage=robustness robustness=refits"
            )
        if self.loss.kind == "response" and self.training.device == "cuda":
            yield (
                "training.device=cuda must go with loss=residual or loss=preconditioned, whose trainings are one "
                "batch, but got loss=response, which solves the rotor on the processor: leave it out"
            )
        if self.loss.kind != "response" and self.identify.model_parameters.deviations:
            yield (
                "identify.model_parameters must come with loss=response, which fits them with the coefficients, but "
                f"got loss={self.loss.kind}"
            )
        if self.loss.kind != "response" and self.model.families:
            law = f"model={self.model.kind} must come with loss=response, which has its prior"
            yield f"{law}, but got loss={self.loss.kind}"
