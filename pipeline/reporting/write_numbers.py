"""Numbers with their deviations, in words."""

from __future__ import annotations

import math


def format_engineering(value: float, deviation: float | None = None) -> str:
    """Write a number by powers of 1000, such as ``(12.34 +- 0.05)e6``."""
    size = max(abs(value), deviation or 0.0)
    if not math.isfinite(size) or size == 0:
        return format_deviation(value, deviation)
    power = 3 * math.floor(math.log10(size) / 3)
    shown = format_deviation(value / 10**power, None if deviation is None else deviation / 10**power)
    if power == 0:
        return shown
    return f"{shown}e{power}" if deviation is None else f"({shown})e{power}"


def format_deviation(value: float, deviation: float | None) -> str:
    """Write two digits of the deviation, or five of a value without one."""
    size = max(abs(value), deviation or 0.0)
    if not math.isfinite(size) or size == 0:
        return f"{value:g}" if deviation is None else f"{value:g} +- {deviation:g}"
    whole = math.floor(math.log10(size))
    if not deviation:
        return f"{value:.{max(4 - whole, 0)}f}" + ("" if deviation is None else " +- 0")
    decimals = min(max(1 - math.floor(math.log10(deviation)), 0), max(_MOST_DIGITS - whole, 0))
    return f"{value:.{decimals}f} +- {deviation:.{decimals}f}"


_MOST_DIGITS = 5
"""After the first one, however small the deviation is."""


def write_value(value: object) -> str:
    """Write a value of the configuration: four digits of a number that is not whole."""
    if value is None:
        return "no number"
    return f"{value:.4g}" if isinstance(value, float) else str(value)
