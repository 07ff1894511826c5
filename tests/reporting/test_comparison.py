"""Tables of a comparison: clean data have one best answer, or rounding, which is not printed."""

from __future__ import annotations

import pytest
from comparison.test_runner import row

from pipeline.comparison.cases import Case
from pipeline.reporting.comparison import Comparison


@pytest.mark.parametrize(("error", "text"), [(4.2e-12, "< 1e-8"), (0.0, "< 1e-8"), (1.234e-7, "1.2e-7"), (26.1, "26")])
def test_digits_of_rounding_are_not_printed(error: float, text: str) -> None:
    from pipeline.reporting.comparison import format_error

    assert format_error(error) == text


def test_clean_data_have_one_best_answer_or_rounding() -> None:
    case = Case(0.0, "bearings", 10)
    rows = (row("response", 0.0, 1e-4), row("spline", 0.0, 1e-12), row("kalman", 0.0, 1e-9), row("residual", 0.0, 2e-4))
    assert Comparison(rows, case, ("kxx",)).level_with_best(case) == {"spline", "kalman"}
