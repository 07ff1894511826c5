"""Numbers as an engineer writes them."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.reporting.blocks import typeset
from pipeline.units import RAD_S_PER_RPM
from pipeline.write_numbers import format_engineering, write_number, write_where


@pytest.mark.parametrize(
    ("value", "deviation", "text"),
    [
        (12.3456, 0.0512, "12.346 +- 0.051"),
        (12.3456, None, "12.35"),
        (None, None, "–"),
        (float("nan"), 1.0, "–"),
        (6000.0, None, "6000"),
        (123456.0, None, "123500"),
        (1894.0, 10900.0, "2000 +- 11000"),
        (110.0, 1e-12, "110.000 +- 0.000"),
        (2.34e-6, None, "2.34e-6"),
        (1.2e7, float("nan"), "1.2e7"),
        (0.02, 0.0, "0.02 +- 0"),
    ],
)
def test_a_number_has_the_digits_of_an_engineer(value: float | None, deviation: float | None, text: str) -> None:
    """Two digits of its deviation, four without; no powers of ten where a person writes none."""
    assert write_number(value, deviation) == text
    assert typeset(text) == text.replace("+-", "±")


@pytest.mark.parametrize(
    ("value", "deviation", "text"),
    [
        (23994100.0, 7100.0, "(23.9941 +- 0.0071)e6"),
        (-553.2, 9.7, "-553.2 +- 9.7"),
        (12.5e3, 20e3, "(12 +- 20)e3"),
        (20.468e6, None, "20.468e6"),
        (-1.25e-7, None, "-125e-9"),
        (5.0, 1e-12, "5.00000 +- 0.00000"),
        (0.0, None, "0"),
        (float("inf"), 1.0, "inf +- 1"),
    ],
)
def test_engineering_notation(value: float, deviation: float | None, text: str) -> None:
    """Powers of 1000, and as many digits as are known."""
    assert format_engineering(value, deviation) == text


@pytest.mark.parametrize(
    ("lost", "where"),
    [
        ("000000", ""),
        ("110000", "below 300 rpm"),
        ("000011", "above 400 rpm"),
        ("001100", "between 200 and 500 rpm"),
        ("100011", "below 200 rpm and above 400 rpm"),
        ("101010", "at 50 % of the speeds"),
        ("111111", "at 100 % of the speeds"),
    ],
)
def test_where_a_coefficient_is_not_determined(lost: str, where: str) -> None:
    """The ends are the next speeds at which it is; several conditions at a speed are no ranges."""
    mask = np.array([letter == "1" for letter in lost])
    assert write_where(np.arange(100.0, 700.0, 100.0) * RAD_S_PER_RPM, mask) == where
    share = f"at {100 * mask.mean():.0f} % of the speeds" if mask.any() else ""
    assert write_where(np.full(6, 100.0), mask) == share
