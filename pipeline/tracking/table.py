"""A network's coefficients as the table that the logged model returns."""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol

import numpy as np

from pipeline.coefficients import COEFFICIENTS
from pipeline.units import RAD_S_PER_RPM

if TYPE_CHECKING:
    import pandas as pd

SPEED = "speed_rpm"
NODE = "bearing_node"


class CoefficientModel(Protocol):
    """What can be evaluated: stiffnesses (N/m) and dampings (N s/m) by bearing node and name."""

    def coefficients(self, speed_rad_s: np.ndarray, /) -> dict[int, dict[str, np.ndarray]]: ...


def coefficient_table(model: CoefficientModel, speed_rpm: np.ndarray) -> pd.DataFrame:
    """The columns of ``identified_coefficients.csv``: a row for each bearing and speed, bearing by bearing.

    :param speed_rpm: rotor speeds, shape (n,), rev/min
    :returns: ``bearing_node``, ``speed_rpm`` and the identified coefficients (N/m, N s/m); NaN where a
        bearing lacks one that another bearing has
    """
    import pandas as pd

    speeds = np.asarray(speed_rpm, dtype=float)
    bearings = model.coefficients(speeds * RAD_S_PER_RPM)
    found = {name for values in bearings.values() for name in values}
    names = [name for name in COEFFICIENTS if name in found]
    missing = np.full(speeds.shape, np.nan)
    columns = {
        NODE: np.repeat(np.array(list(bearings), dtype=np.int64), speeds.size),
        SPEED: np.tile(speeds, len(bearings)),
    }
    for name in names:
        columns[name] = np.concatenate([values.get(name, missing) for values in bearings.values()])
    return pd.DataFrame(columns)
