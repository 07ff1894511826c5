"""Modelled bearings at operating points: films whose oil warms or whose load changes, and coefficients over the speed.

Legend: S operating points, 8 coefficients. SI units, temperatures in K.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.coefficients import COEFFICIENTS
from pipeline.config.bearings import (
    BearingConfig,
    CylindricalBearingConfig,
    JournalTableConfig,
    LinearBearingConfig,
    SpeedTableConfig,
)
from pipeline.config.guesses import CONDITION
from pipeline.errors import ConfigError
from pipeline.laws.files import make_film_table, packaged_file, read_film_table
from pipeline.laws.oil import viscosity_at
from pipeline.laws.points import LOAD, OIL_TEMPERATURE, turn_axes
from pipeline.laws.short_bearing import short_coefficients, short_eccentricity
from pipeline.laws.table import FilmTable

Operating = Mapping[str, np.ndarray]
_ROOM = 1e-6
"""So that a speed made from a row of a table is in it."""


def tabulate(bearing: BearingConfig, speeds: np.ndarray, operating: Operating, share: float) -> np.ndarray | None:
    """(S, 8) of a bearing that is a table itself, or a film that follows conditions; None for those that ROSS models.

    ``speeds`` (S,) are in rad/s; ``share`` is the load in N of a bearing that gives none. Raises ConfigError.
    """
    if isinstance(bearing, JournalTableConfig):
        return journal_coefficients(bearing, speeds, operating)
    if isinstance(bearing, CylindricalBearingConfig) and follows_conditions(bearing):
        return short_bearing_coefficients(bearing, share, speeds, operating)
    if isinstance(bearing, SpeedTableConfig):
        return interpolate_coefficients(bearing, speeds)
    if isinstance(bearing, LinearBearingConfig):
        return np.tile([getattr(bearing, name) for name in COEFFICIENTS], (len(speeds), 1))
    return None


def follows_conditions(bearing: Any) -> bool:
    """True for a bearing whose coefficients depend on more than the speed."""
    return getattr(bearing, "static_load", None) == CONDITION or OIL_TEMPERATURE in _needed(bearing)


def _needed(bearing: Any) -> tuple[str, ...]:
    oil = getattr(bearing, "oil_viscosity", 0.0)
    return () if isinstance(oil, float) or oil.law == "constant" else (OIL_TEMPERATURE,)


def pick_condition(operating: Operating, name: str, count: int) -> np.ndarray:
    """The condition ``name`` (S,) of ``count`` points.

    Raises ConfigError where it is missing, or not above zero.
    """
    if name not in operating:
        raise ConfigError(
            f"the modelled bearings need the operating condition {name}, but there is {', '.join(operating) or 'none'}"
            f": give machine.operating.{name}, or a number in place of what depends on it"
        )
    values = np.broadcast_to(np.asarray(operating[name], dtype=float), (count,))
    if not (values > 0).all():
        raise ConfigError(f"the modelled bearings need {name} above zero, but got {np.min(values):g}")
    return values


def find_load(load: float | str, operating: Operating, count: int) -> np.ndarray:
    """(S,) N of a ``static_load``. Raises ConfigError as :func:`pick_condition`."""
    return pick_condition(operating, LOAD, count) if isinstance(load, str) else np.full(count, load)


def _find_viscosity(oil: Any, operating: Operating, count: int) -> np.ndarray:
    if isinstance(oil, float):
        return np.full(count, oil)
    warm = pick_condition(operating, OIL_TEMPERATURE, count) if oil.law != "constant" else np.zeros(count)
    return viscosity_at(oil, warm)


def _scale(pure: np.ndarray, load: np.ndarray, clearance: float, speeds: np.ndarray) -> np.ndarray:
    """N/m and N s/m of dimensionless coefficients (S, 8)."""
    size = (load / clearance)[:, None]
    return np.concatenate([pure[:, :4] * size, pure[:, 4:] * size / speeds[:, None]], axis=1)


def journal_coefficients(
    bearing: JournalTableConfig, speeds: np.ndarray, operating: Operating | None = None
) -> np.ndarray:
    """(S, 8) coefficients at ``speeds`` (S,) rad/s and ``operating`` conditions (S,), N/m and N s/m.

    Raises ConfigError for a speed whose Sommerfeld number lies outside the table, for a condition that is missing, for
    a table that is none, and for a preload that it has not.
    """
    count, radius, table = len(speeds), bearing.journal_diameter / 2, _read_table(bearing)
    load = find_load(bearing.static_load, operating or {}, count)
    viscosity = _find_viscosity(bearing.oil_viscosity, operating or {}, count)
    per_turn = viscosity * bearing.length * bearing.journal_diameter / load
    sommerfeld = speeds / (2 * np.pi) * per_turn * (radius / bearing.radial_clearance) ** 2
    low, high = (float(np.exp(end)) for end in table.span)
    outside = np.flatnonzero((sommerfeld < low * (1 - _ROOM)) | (sommerfeld > high * (1 + _ROOM)))
    if len(outside):
        i = outside[0]
        span = (30 / np.pi) * speeds[i] / sommerfeld[i] * np.array([low, high])
        raise ConfigError(
            f"a bearing's table must span the Sommerfeld numbers of all speeds, but it has {low:g} to {high:g} and "
            f"{sommerfeld[i]:.3g} is needed: choose speeds from {span[0]:.0f} to {span[1]:.0f} rpm"
        )
    pure = table.tabulate(np.log(sommerfeld), bearing.preload or 0.0)
    return np.asarray(_scale(pure, load, bearing.radial_clearance, speeds) @ turn_axes(bearing.load_angle).T)


def _read_table(bearing: JournalTableConfig) -> FilmTable:
    table = read_film_table(bearing.table) if bearing.table else make_film_table(bearing.rows or (), "rows")
    span = table.preloads[[0, -1]]
    if table.has_preload != (bearing.preload is not None):
        raise ConfigError(
            "a bearing must have a preload where its table has a column preload, and none elsewhere, but it has "
            f"{'none' if bearing.preload is None else bearing.preload}"
        )
    if bearing.preload is not None and not span[0] <= bearing.preload <= span[1]:
        raise ConfigError(f"a bearing's table has preloads {span[0]:g} to {span[1]:g}, but got {bearing.preload:g}")
    return table


def short_bearing_coefficients(
    bearing: CylindricalBearingConfig, share: float, speeds: np.ndarray, operating: Operating
) -> np.ndarray:
    """(S, 8) of a short bearing that follows conditions: the closed form of ROSS's ``CylindricalBearing``.

    ROSS itself takes one viscosity and one load. ``share`` is the load where the bearing gives none. Raises ConfigError
    where a condition is missing.
    """
    load = find_load(share if bearing.static_load is None else bearing.static_load, operating, len(speeds))
    viscosity = _find_viscosity(bearing.oil_viscosity, operating, len(speeds))
    slim = bearing.length**3 * bearing.journal_diameter / (8 * np.pi * bearing.radial_clearance**2)
    pure = short_coefficients(short_eccentricity(viscosity * speeds * slim / load))
    return np.asarray(_scale(pure, load, bearing.radial_clearance, speeds) @ turn_axes(-np.pi / 2).T)


def table_bytes(bearing: Any) -> bytes:
    """What the file of a bearing's table holds; nothing where it has none, or there is no such file."""
    named = [
        bearing_at.table
        for bearing_at in getattr(bearing, "nodes", {0: bearing}).values()
        if getattr(bearing_at, "table", None)
    ]
    paths = [packaged_file(name) or Path(name) for name in named]
    return b"".join(path.read_bytes() for path in paths if path.is_file())


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
