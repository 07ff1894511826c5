"""The blocks of a report: axes that few outliers do not rule."""

from __future__ import annotations

import numpy as np

from pipeline.reporting.blocks import Curve, mark_beyond, reach
from reporting.report.test_files import RPM, SIZE


def test_few_outliers_do_not_rule_an_axis() -> None:
    """It ends where the others are, with a cross for what lies beyond; without outliers it holds every point."""
    usual = np.linspace(0.1, 0.5, 99)
    assert reach(usual) == (0.1, 0.5)
    values = np.r_[usual, -15.0]
    low, high = reach(np.r_[values, np.nan])
    assert -0.5 < low < 0.1
    assert high == 0.5
    (cross,) = mark_beyond([Curve(np.arange(100.0), values), Curve(RPM, SIZE)], low, high)
    assert (cross.x.tolist(), cross.y.tolist(), cross.marker) == ([99.0], [low], "x")
