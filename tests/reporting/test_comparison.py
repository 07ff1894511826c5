"""Tables of a comparison: means over data sets, wins beyond the spread, and errors of rounding."""

from __future__ import annotations

import pytest


@pytest.mark.parametrize(("error", "text"), [(4.2e-12, "< 1e-8"), (0.0, "< 1e-8"), (1.234e-7, "1.2e-7"), (26.1, "26")])
def test_digits_of_rounding_are_not_printed(error: float, text: str) -> None:
    from pipeline.reporting.comparison import format_error

    assert format_error(error) == text
