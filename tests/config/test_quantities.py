"""Quantities with units: temperatures have a zero of their own, their differences have none."""

from __future__ import annotations

import pytest

from pipeline.config.quantities import to_si


@pytest.mark.parametrize(
    ("text", "unit", "si"),
    [
        ("45 degC", "K", 318.15),
        ("-40 °C", "K", 233.15),
        ("113 degF", "K", 318.15),
        ("318 K", "K", 318.0),
        ("0.034 1/degC", "1 / K", 0.034),
        ("0.034 / K", "1 / K", 0.034),
        ("27.7 mPa s", "Pa * s", 0.0277),
    ],
)
def test_temperatures_have_a_zero_of_their_own_and_differences_none(text: str, unit: str, si: float) -> None:
    assert to_si(text, unit, "45 degC") == pytest.approx(si, rel=1e-12)
