"""Critical speeds beyond the speeds of the data, of bearings that are constants by assumption.

Legend: S speeds.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from pipeline.errors import ConfigError
from pipeline.identification.identified import IdentifiedModel
from pipeline.identification.uncertainty import Uncertainty
from pipeline.problem.measurement import Measurement
from pipeline.rotor.bearing_table import BearingTable
from pipeline.twin.mode_deviations import deviate_modes
from pipeline.twin.modes import find_critical_speeds, find_modes


@dataclass(frozen=True)
class ExpectedCritical:
    """A critical speed with its standard deviation, rad/s, and its logarithmic decrement with its own."""

    speed: float
    deviation: float
    logarithmic_decrement: float
    decrement_deviation: float


def expect_criticals(
    measurement: Measurement, identified: IdentifiedModel, uncertainty: Uncertainty, speeds: np.ndarray
) -> list[ExpectedCritical]:
    """The critical speeds within ``speeds`` (S,) rad/s, ascending.

    ``measurement`` is at the fitted model parameters. Raises ConfigError where a coefficient, identified or known,
    depends on the speed: nothing says what it is beyond the data.
    """
    known = measurement.updated_known
    if identified.model.hidden is not None or np.ptp(known.values, axis=1).any():
        raise ConfigError(
            "critical speeds beyond the data must be of coefficients that do not depend on the speed, but some do: use "
            "model=constant and known values, or measure there"
        )
    table = BearingTable(known.nodes, speeds, np.repeat(known.values[:, :1], len(speeds), axis=1))
    updated = replace(measurement, known=table)
    bearings = identified.table(table)
    modes = find_modes(updated.updated_rotor, bearings)
    deviations = deviate_modes(modes, updated, bearings, identified, uncertainty)
    criticals = [(speed, deviations.of_critical(speed)) for speed in find_critical_speeds(modes)]
    return [
        ExpectedCritical(c.speed, speed_deviation, c.logarithmic_decrement, of_dec)
        for c, (speed_deviation, of_dec) in criticals
    ]
