"""The table of a short journal bearing (Ocvirk), from its closed form: Friswell et al. 2010, page 177."""

from __future__ import annotations

import math
from functools import cache

import numpy as np

from pipeline.laws.numbers import turn_axes
from pipeline.laws.table import Curve, FilmTable

_LEAST, _MOST, _ROWS = 1e-6, 0.9999, 1500
"""Eccentricities of the ends, and the rows between them: the splines are then off by 1e-9."""


def short_sommerfeld(eccentricity: np.ndarray) -> np.ndarray:
    """``S (L / D)^2`` of the static position, of eccentricities between 0 and 1."""
    e2 = np.asarray(eccentricity) ** 2
    return np.asarray((1 - e2) ** 2 / np.sqrt(e2 * (np.pi**2 + (16 - np.pi**2) * e2)) / np.pi)


def short_coefficients(eccentricity: np.ndarray) -> np.ndarray:
    """(.., 8) Kbar and Bbar of eccentricities (..), the first axis along the load.

    The book has u across and v against the load; the shaft turns from u towards v.
    """
    e = np.asarray(eccentricity)
    root, pi2 = np.sqrt(1 - e**2), np.pi**2
    h = (pi2 * (1 - e**2) + 16 * e**2) ** -1.5
    uu = 4 * (pi2 * (2 - e**2) + 16 * e**2)
    uv = np.pi * (pi2 * (1 - e**2) ** 2 - 16 * e**4) / (e * root)
    vu = -np.pi * (pi2 * (1 - e**2) * (1 + 2 * e**2) + 32 * e**2 * (1 + e**2)) / (e * root)
    vv = 4 * (pi2 * (1 + 2 * e**2) + 32 * e**2 * (1 + e**2) / (1 - e**2))
    damping = pi2 * (1 + 2 * e**2) - 16 * e**2
    cuv = -8 * damping
    cuu, cvv = 2 * np.pi * root * damping / e, 2 * np.pi * (pi2 * (1 - e**2) ** 2 + 48 * e**2) / (e * root)
    return np.asarray(np.stack([uu, uv, vu, vv, cuu, cuv, cuv, cvv], axis=-1) * h[..., None] @ turn_axes(np.pi / 2).T)


def _odds(log_odds: float) -> np.ndarray:
    return np.asarray(1 / (1 + np.exp(-log_odds)))


def short_eccentricity(sommerfeld: np.ndarray) -> np.ndarray:
    """The eccentricities (S,) of static positions at ``S (L / D)^2`` (S,)."""
    from scipy.optimize import brentq

    def miss(log_odds: float, s: float) -> float:
        return math.log(float(short_sommerfeld(_odds(log_odds)) / s))

    roots = [brentq(miss, -30.0, 30.0, args=(s,), xtol=1e-14, rtol=1e-14) for s in sommerfeld]
    return np.array([float(_odds(root)) for root in roots])


@cache
def short_table() -> FilmTable:
    """The closed form as a table over ``S (L / D)^2``."""
    from scipy.interpolate import PchipInterpolator

    fine = np.concatenate([np.geomspace(_LEAST, 0.5, 4000), 1 - np.geomspace(0.5, 1 - _MOST, 4000)[1:]])
    log_s = np.log(short_sommerfeld(fine))
    # Rows about evenly spaced over the logarithm of S; each is exact whichever eccentricity it has.
    even = PchipInterpolator(log_s[::-1], fine[::-1])(np.linspace(log_s[-1], log_s[0], _ROWS))
    return FilmTable(np.zeros(1), (Curve(np.log(short_sommerfeld(even)), short_coefficients(even)),))
