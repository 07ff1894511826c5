"""The schema of a table of records: a row has its speed, the vectors of the probes and the known weights."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Field, model_validator

from pipeline.config.measured import (
    CsvConfig,
    MeasuredConfig,
    MeasuredRunConfig,
    ProbeConfig,
    TachoAngleConfig,
    Text,
    VectorConventionsConfig,
)
from pipeline.config.quantities import to_si
from pipeline.config.section import NonNegativeInt, Section


class ComplexColumnsConfig(Section):
    """The two columns of a complex number."""

    real: Text
    imaginary: Text


class RecordProbeConfig(ProbeConfig):
    """A probe with its columns."""

    columns: ComplexColumnsConfig


def _check_unit(value: Any) -> str:
    to_si(f"1 {value}", "kg * m", "100 g mm")
    return str(value)


class RecordWeightConfig(Section):
    """The weight that was on one plane in each record: complex, in ``unit``, its angle as ``shaft_angle`` says."""

    node: NonNegativeInt
    unit: Annotated[str, BeforeValidator(_check_unit)]
    columns: ComplexColumnsConfig

    @property
    def size(self) -> float:
        """One unit in kg m."""
        return to_si(f"1 {self.unit}", "kg * m", "100 g mm")


class RecordColumnsConfig(Section):
    """Names of columns. Records of one ``condition`` repeat each other: nothing on the machine was changed."""

    speed: Text
    condition: Text
    record: Text


class RecordsConfig(MeasuredConfig):
    """A table with a row for every record at a constant speed: CSV or Excel.

    Records whose speeds differ by less than :data:`pipeline.data.dataset.SYNCHRONOUS` belong to one nominal speed, and
    keep their own. Each probe stays a channel of its own: its angle may be an uncertain number of the model.
    """

    format: Literal["records"]
    conventions: VectorConventionsConfig
    columns: RecordColumnsConfig
    csv: CsvConfig = CsvConfig()
    tacho: TachoAngleConfig = TachoAngleConfig()
    probes: dict[str, RecordProbeConfig] = Field(min_length=1)
    weights: tuple[RecordWeightConfig, ...] = Field(min_length=1)

    @property
    def runs(self) -> tuple[MeasuredRunConfig, ...]:
        """None: the table says what the runs are."""
        return ()

    @model_validator(mode="after")
    def _lawful(self) -> RecordsConfig:
        if self.file is None:
            raise ValueError("must name the file with the records, but file is missing")
        if self.shaft_angle is None:
            raise ValueError(
                "must say in shaft_angle how angles of weights are measured (with_rotation or against_rotation from "
                "the mark, or from_x at the pulse), but it is missing"
            )
        if self.shaft_angle != "from_x" and self.tacho.angle is None:
            raise ValueError(
                "must give tacho.angle where angles of weights are measured from the mark, but it is missing: where "
                "nobody knows it, give 0 deg and identify.model_parameters.weight_angle"
            )
        for key in ("baseline", "speeds", "slow_roll", "conditions_file", "same_conditions"):
            if getattr(self, key):
                raise ValueError(f"must have no {key} for a table of records, but it has one: leave it out")
        self.check_units(self.conventions.unit, self.probes)
        places = [(probe.node, probe.angle) for probe in self.probes.values()]
        if len(set(places)) != len(places):
            raise ValueError("must give every probe a place of its own (node and angle), but two have the same")
        nodes = [weight.node for weight in self.weights]
        if len(set(nodes)) != len(nodes):
            raise ValueError(f"must give every plane of weights once, but weights has the nodes {nodes}")
        return self
