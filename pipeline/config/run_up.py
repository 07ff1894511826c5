"""The schema of a run-up through a critical speed, which ``stage=runup`` fits."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated, Literal

from pydantic import Field, PositiveFloat

from pipeline.config.measured import AmplitudeKind, PhaseSense, SpeedUnit, Text
from pipeline.config.motion import MotionConfig, Sensitivity, find_volts, to_motion
from pipeline.config.section import Section, rule


class RunUpColumnsConfig(Section):
    """Names of the three columns."""

    speed: Text = "speed"
    amplitude: Text = "amplitude"
    phase: Text = "phase"


class RunUpConfig(MotionConfig):
    """A Bode table of one probe, a row a revolution in the order of time or of speed, and what its numbers mean.

    ``from_rpm`` to ``to_rpm`` is the part of it in which the speed changes at one rate. ``phase`` null: both senses are
    tried. ``rate_rpm_per_s`` is needed where rows are no revolutions; a run-down has a negative one. ``steady_rows`` is
    how many rows the steady reading averages.
    """

    file: Text
    probe: Text = "probe"
    columns: RunUpColumnsConfig = RunUpColumnsConfig()
    scale: Sensitivity | None = None
    amplitude: AmplitudeKind
    phase: PhaseSense | None = None
    phase_unit: Literal["deg", "rad"]
    speed: SpeedUnit
    from_rpm: PositiveFloat
    to_rpm: PositiveFloat
    rate_rpm_per_s: float | None = None
    background_degree: Annotated[int, Field(ge=0, le=4)] = 2
    steady_rows: Annotated[int, Field(ge=1)] = 1
    most_lag: Annotated[float, Field(gt=0, lt=0.5)] = 0.01

    @rule
    def _lawful(self) -> Iterator[str]:
        if self.from_rpm >= self.to_rpm:
            yield f"must have from_rpm below to_rpm, but got {self.from_rpm:g} and {self.to_rpm:g}"
        if (find_volts(self.unit) is None) != (self.scale is None):
            yield (
                "must have a scale (such as 7.87 V/mm) for voltages and for nothing else, but got the unit "
                f"{self.unit} and the scale {self.scale}"
            )
        if to_motion(self.unit, self.scale)[0]:
            yield f"must be displacements, but got {self.unit} with the scale {self.scale}"
        if self.rate_rpm_per_s == 0:
            yield "must have a rate_rpm_per_s that is not 0, but got 0: leave it out, to measure it"
