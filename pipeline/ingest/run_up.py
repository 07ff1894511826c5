"""A run-up's Bode table as vectors over the speed, with the rate of its ramp."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from pipeline.config.motion import to_motion
from pipeline.config.run_up import RunUpConfig
from pipeline.data.tables import read_table
from pipeline.errors import DataError
from pipeline.ingest.conventions import RAD_S, to_vectors
from pipeline.ingest.tracks import sort_track
from pipeline.sweep.fit import MeasuredRate, RunUp, measure_rate
from pipeline.units import RAD_S_PER_RPM

_STRAIGHT = 0.01


def read_run_up(config: RunUpConfig) -> tuple[RunUp, MeasuredRate | None]:
    """The rows of the ramp, phases as leads (or as they stand, where no sense is stated), and the measured rate.

    The rate is None where the configuration gives it. Raises DataError: no such file or column, impossible numbers,
    fewer than 40 rows on the ramp, rows that lie on no straight ramp.
    """
    path, names = Path(config.file), config.columns
    table = read_table(path, dict.fromkeys((names.speed, names.amplitude, names.phase), "number"))
    speeds = table[names.speed] * RAD_S[config.speed]
    phases = np.radians(table[names.phase]) if config.phase_unit == "deg" else table[names.phase]
    size = to_motion(config.unit, config.scale)[1]
    vectors = to_vectors(table[names.amplitude], phases, size, config.amplitude, config.phase or "lead")
    on_ramp = (speeds >= config.from_rpm * RAD_S_PER_RPM) & (speeds <= config.to_rpm * RAD_S_PER_RPM)
    speeds, vectors = speeds[on_ramp], vectors[on_ramp]
    where = f"'{path}' from {config.from_rpm:g} to {config.to_rpm:g} rpm"
    if config.rate_rpm_per_s is not None:
        rate, measured = config.rate_rpm_per_s * RAD_S_PER_RPM, None
        if not len(speeds):
            raise DataError(f"{where} must have rows, but it has none: give the range of the ramp (from_rpm, to_rpm)")
    else:
        measured = measure_rate(speeds, where)
        rate = measured.rate
        if measured.departure > _STRAIGHT * speeds.max():
            raise DataError(
                f"{where} must be a ramp of one rate with a row a revolution, but a row is "
                f"{measured.departure / RAD_S_PER_RPM:.3g} rpm off: choose the range of the ramp (from_rpm, to_rpm), "
                "or give rate_rpm_per_s"
            )
    track = sort_track(speeds, vectors, where)
    return RunUp(track.speeds, track.vectors, rate), measured
