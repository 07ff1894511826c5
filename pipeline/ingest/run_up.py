"""A run-up's Bode table: its section of the configuration, and its vectors over the speed with the rate of the ramp."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import Field, PositiveFloat

from pipeline.config.measured import ConventionsConfig, PhaseSense
from pipeline.config.motion import Sensitivity, find_volts, to_motion
from pipeline.config.section import Section, Text, ascending, rule
from pipeline.data.tables import read_table
from pipeline.errors import DataError
from pipeline.ingest.conventions import RAD_S, to_lead
from pipeline.ingest.tracks import sort_track
from pipeline.sweep.fit import RunUp, measure_rate
from pipeline.units import RAD_S_PER_RPM
from pipeline.write_numbers import write_number


class RunUpColumnsConfig(Section):
    """Names of the three columns."""

    speed: Text = "speed"
    amplitude: Text = "amplitude"
    phase: Text = "phase"


class RunUpConfig(ConventionsConfig):
    """A Bode table of one probe, a row a revolution in the order of time or of speed, and what its numbers mean.

    ``from_rpm`` to ``to_rpm`` is the part of it in which the speed changes at one rate. ``phase`` null: both senses are
    tried. ``rate_rpm_per_s`` is needed where rows are no revolutions; a run-down has a negative one. ``steady_rows`` is
    how many rows the steady reading averages.
    """

    file: Text
    probe: Text = "probe"
    columns: RunUpColumnsConfig = RunUpColumnsConfig()
    scale: Sensitivity | None = None
    phase: PhaseSense | None = None  # type: ignore[assignment]  # of a table it must be known
    from_rpm: PositiveFloat
    to_rpm: PositiveFloat
    rate_rpm_per_s: float | None = None
    background_degree: Annotated[int, Field(ge=0, le=4)] = 2
    steady_rows: Annotated[int, Field(ge=1)] = 1
    most_lag: Annotated[float, Field(gt=0, lt=0.5)] = 0.01

    _span = ascending("from_rpm", "to_rpm", strictly=True)

    @rule
    def _lawful(self) -> Iterator[str]:
        if (not find_volts(self.unit)) != (not self.scale):
            yield (
                "must have a scale (such as 7.87 V/mm) for voltages and for nothing else, but got the unit "
                f"{self.unit} and the scale {self.scale}"
            )
        if to_motion(self.unit, self.scale)[0]:
            yield f"must be displacements, but got {self.unit} with the scale {self.scale}"
        if self.rate_rpm_per_s == 0:
            yield "must have a rate_rpm_per_s that is not 0, but got 0: leave it out, to measure it"


def read_run_up(config: RunUpConfig, straight: float = 0.01) -> RunUp:
    """The rows of the ramp, phases as leads (or as they stand, where no sense is stated).

    The rate is measured where the configuration does not give it. Raises DataError: no such file or column, impossible
    numbers, fewer than 40 rows on the ramp, rows that lie on no straight ramp (to the share ``straight`` of the highest
    speed).
    """
    path, names = Path(config.file), config.columns
    table = read_table(path, dict.fromkeys((names.speed, names.amplitude, names.phase), "number"))
    speeds = table[names.speed] * RAD_S[config.speed]
    phases = np.radians(table[names.phase]) if config.phase_unit == "deg" else table[names.phase]
    size = to_motion(config.unit, config.scale)[1]
    values = table[names.amplitude] * np.exp(1j * phases)
    vectors = to_lead(values, size, config.amplitude, config.phase or "lead")
    on_ramp = (speeds >= config.from_rpm * RAD_S_PER_RPM) & (speeds <= config.to_rpm * RAD_S_PER_RPM)
    speeds, vectors = speeds[on_ramp], vectors[on_ramp]
    where = f"'{path}' from {config.from_rpm:g} to {config.to_rpm:g} rpm"
    if config.rate_rpm_per_s:
        rate, deviation, departure = config.rate_rpm_per_s * RAD_S_PER_RPM, None, None
        if not len(speeds):
            raise DataError(f"{where} must have rows, but it has none: give the range of the ramp (from_rpm, to_rpm)")
    else:
        rate, deviation, departure = measure_rate(speeds, where)
        if departure > straight * speeds.max():
            raise DataError(
                f"{where} must be a ramp of one rate with a row a revolution, but a row is "
                f"{write_number(departure / RAD_S_PER_RPM, digits=3)} rpm off: choose the range of the ramp "
                "(from_rpm, to_rpm), or give rate_rpm_per_s"
            )
    track = sort_track(speeds, vectors, where)
    return RunUp(track.speeds, track.vectors, rate, deviation, departure)
