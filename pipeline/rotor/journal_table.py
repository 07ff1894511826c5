"""Bearings from tables: dimensionless coefficients (such as Lund & Thomsen 1978), or coefficients over the speed."""

from __future__ import annotations

import numpy as np

from pipeline.config.bearings import JournalTableConfig, SpeedTableConfig
from pipeline.errors import ConfigError


def journal_coefficients(bearing: JournalTableConfig, speeds: np.ndarray) -> np.ndarray:
    """(S, 8) coefficients at ``speeds`` (S,) rad/s, N/m and N s/m.

    Raises ConfigError for a speed whose Sommerfeld number lies outside the table.
    """
    from scipy.interpolate import CubicSpline

    rows = np.array(bearing.rows)
    radius = bearing.journal_diameter / 2
    per_turn = bearing.oil_viscosity * bearing.length * bearing.journal_diameter / bearing.static_load
    sommerfeld = speeds / (2 * np.pi) * per_turn * (radius / bearing.radial_clearance) ** 2
    low, high = rows[[0, -1], 0]
    # A millionth of room, so that a speed made from a row of the table is in it.
    outside = sommerfeld[(sommerfeld < low * (1 - 1e-6)) | (sommerfeld > high * (1 + 1e-6))]
    if len(outside):
        span = (30 / np.pi) * speeds[0] / sommerfeld[0] * np.array([low, high])
        raise ConfigError(
            f"a bearing's table must span the Sommerfeld numbers of all speeds, but it has {low:g} to {high:g} and "
            f"{outside[0]:.3g} is needed: choose speeds from {span[0]:.0f} to {span[1]:.0f} rpm"
        )
    pure = CubicSpline(np.log(rows[:, 0]), rows[:, 1:])(np.log(sommerfeld))
    size = bearing.static_load / bearing.radial_clearance
    return np.concatenate([pure[:, :4] * size, pure[:, 4:] * size / speeds[:, None]], axis=1)


def interpolate_coefficients(bearing: SpeedTableConfig, speeds: np.ndarray) -> np.ndarray:
    """(S, 8) coefficients at ``speeds`` (S,) rad/s, N/m and N s/m: straight lines between the rows.

    Raises ConfigError for a speed outside the table.
    """
    rows, rpm = np.array(bearing.rows), speeds * 30 / np.pi
    low, high = rows[[0, -1], 0]
    outside = rpm[(rpm < low * (1 - 1e-6)) | (rpm > high * (1 + 1e-6))]
    if len(outside):
        raise ConfigError(
            f"a bearing's table must span all speeds, but it has {low:g} to {high:g} rpm and {outside[0]:.6g} rpm is "
            f"needed: add a row, or choose speeds within the table"
        )
    return np.stack([np.interp(rpm, rows[:, 0], column) for column in rows[:, 1:].T], axis=1)
