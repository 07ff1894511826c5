"""Seals: known forces on the shaft, whose coefficients change with the rotor speed.

Legend: T seals, S speeds, R rows. SI units.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

COLUMNS = tuple(f"{kind}{axes}" for kind in "kcm" for axes in ("xx", "xy", "yx", "yy"))


@dataclass(frozen=True, eq=False)
class Seals:
    """The coefficients of all seals, as the file of the rotor has them; between its speeds by ROSS's own spline."""

    rows: np.ndarray  # (R, 15): seal, its node, rotor speed in rad/s (NaN: at every speed), and COLUMNS in SI units

    @cached_property
    def nodes(self) -> tuple[int, ...]:
        """T."""
        return tuple(int(rows[0, 1]) for rows in self._by_seal)

    @cached_property
    def _by_seal(self) -> list[np.ndarray]:
        return [self.rows[self.rows[:, 0] == seal] for seal in np.unique(self.rows[:, 0])]

    def matrices(self, speeds: np.ndarray) -> np.ndarray:
        """(T, S, 3, 2, 2) stiffness, damping and mass at the rotor ``speeds`` (S,) rad/s."""
        interpolated = [_interpolate(rows[:, 2], rows[:, 3:], speeds) for rows in self._by_seal]
        return np.array(interpolated).reshape(len(interpolated), len(speeds), 3, 2, 2)

    def impedance(self, frequencies: np.ndarray, speeds: np.ndarray) -> np.ndarray:
        """(T, S, 2, 2) complex ``K + j w C - w^2 M`` in N/m at ``frequencies`` w (S,) and rotor ``speeds`` (S,)."""
        stiffness, damping, mass = np.moveaxis(self.matrices(speeds), 2, 0)
        w = frequencies[:, None, None]
        return stiffness + 1j * w * damping - w**2 * mass


NO_SEALS = Seals(np.zeros((0, 3 + len(COLUMNS))))


def _interpolate(at: np.ndarray, values: np.ndarray, speeds: np.ndarray, spline_points: int = 4) -> np.ndarray:
    """(S, 12): constant, a polynomial through two or three points, or a spline, as ROSS 2.3.0 has it."""
    if len(at) == 1:
        return np.tile(values[0], (len(speeds), 1))
    from scipy.interpolate import UnivariateSpline, interp1d

    if len(at) < spline_points:
        curve = interp1d(at, values, kind=len(at) - 1, axis=0, fill_value="extrapolate")
        return np.asarray(curve(speeds))
    return np.stack([UnivariateSpline(at, column)(speeds) for column in values.T], axis=1)
