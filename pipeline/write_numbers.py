"""The one writer of numbers: an engineer's digits, with the deviation where there is one."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from pipeline.units import RAD_S_PER_RPM

if TYPE_CHECKING:
    import numpy as np


def write_number(value: float | None, deviation: float | None = None, digits: int = 4) -> str:
    """A number to so many ``digits``, or with its standard deviation to two of that; a dash for what is no number.

    Powers of ten stand only below 1e-4 and from 1e6 on: ``6000``, ``12.34``, ``12.346 +- 0.051``, ``2000 +- 11000``,
    ``3.2e-7``.
    """
    if value is None or math.isnan(value):
        return "–"
    if math.isinf(value):
        return f"{value:g} +- {deviation:g}" if deviation else f"{value:g}"
    if deviation is None or not math.isfinite(deviation) or deviation <= 0:
        return _round(value, digits) + (" +- 0" if deviation == 0 else "")
    place = math.floor(math.log10(float(f"{deviation:.1e}"))) - 1  # of the last digit
    if value:
        place = max(place, math.floor(math.log10(abs(value))) - _MOST_DIGITS)
    if place < -_MOST_DECIMALS:
        return f"{value:.{digits}g} +- {deviation:.2g}"
    return " +- ".join(f"{round(number, -place) + 0.0:.{max(-place, 0)}f}" for number in (value, deviation))  # no -0


def write_rough(value: float | None) -> str:
    """:func:`write_number` to two digits: deviations, errors, ratios."""
    return write_number(value, digits=2)


def write_percent(share: float, sign: str = "") -> str:
    """A share in percent, two digits of it behind the ``sign``, such as ``+- 210 %``; ``over 1000 %``, or that it has
    no limit."""
    if not math.isfinite(share):
        return "no limit"
    return f"{sign}{write_rough(100 * share)} %" if share <= 10 else "over 1000 %"


_MOST_DIGITS, _MOST_DECIMALS = 5, 9
"""After the first one, however small the deviation is; and after the point."""


def _round(value: float, digits: int) -> str:
    rounded = float(f"{value:.{digits - 1}e}")
    if rounded and not 1e-4 <= abs(rounded) < 1e6:
        mantissa, _, power = f"{rounded:.{digits - 1}e}".partition("e")
        return f"{float(mantissa):g}e{int(power)}"
    return f"{rounded:.{max(digits, 6)}g}"


def format_engineering(value: float, deviation: float | None = None) -> str:
    """Write a number by powers of 1000, such as ``(12.34 +- 0.05)e6``."""
    size = max(abs(value), deviation or 0.0)
    power = 3 * math.floor(math.log10(size) / 3) if size and math.isfinite(size) else 0
    shown = write_number(value / 10**power, deviation and deviation / 10**power, 5)
    if not power:
        return shown
    return f"({shown})e{power}" if "+-" in shown else f"{shown}e{power}"


def write_value(value: object) -> str:
    """Write a value of the configuration or of a summary: four digits of a number that is not whole."""
    if value is None:
        return "no number"
    return write_number(value) if isinstance(value, float) else str(value)


def count(number: int, name: str) -> str:
    """Such as ``1 run`` and ``2 runs``."""
    return f"{number} {name}{'s' if number != 1 else ''}"


def write_where(speeds: np.ndarray, lost: np.ndarray, most_ranges: int = 2) -> str:
    """The speeds (S,) rad/s at which something is ``lost`` (S,), as ranges; as a share where these are many.

    Nothing where it is lost at no speed; a share, too, where several conditions have the same speed.
    """
    import numpy as np

    rpm = speeds / RAD_S_PER_RPM
    ends = np.flatnonzero(np.diff(lost.astype(int), prepend=0, append=0)).reshape(-1, 2)  # first, and behind the last
    if not len(ends):
        return ""
    if lost.all() or len(ends) > most_ranges or (np.diff(rpm) <= 0).any():
        return f"at {write_percent(float(np.mean(lost)))} of the speeds"
    ranges = []
    for first, behind in ends:
        low, high = (f"{rpm[at]:.4g}" for at in (first - 1, min(behind, len(rpm) - 1)))
        inner = f"between {low} and {high} rpm"
        ranges.append(f"below {high} rpm" if first == 0 else f"above {low} rpm" if behind == len(rpm) else inner)
    return " and ".join(ranges)
