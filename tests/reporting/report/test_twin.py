"""The twin's section of a report: the peak of a response, in closed form."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.reporting.report.twin import find_peak


def test_a_peak_is_that_of_the_closed_form() -> None:
    """The response of one mass to unbalance peaks at n0 / sqrt(1 - 2 z^2), with the height 1 / (2 z sqrt(1 - z^2))."""
    damping, rpm = 0.1, np.arange(1000.0, 3000.0, 10.0)
    ratio = rpm / 2000.0
    size = ratio**2 / np.hypot(1 - ratio**2, 2 * damping * ratio)
    assert find_peak(rpm, size) == (
        pytest.approx(2000.0 / np.sqrt(1 - 2 * damping**2), rel=2e-4),
        pytest.approx(1 / (2 * damping * np.sqrt(1 - damping**2)), rel=1e-4),
    )
    assert find_peak(rpm, rpm) is None
    two = size + 2 * np.exp(-(((rpm - 2600) / 50) ** 2)) * size.max()
    assert [round(peak[0], -2) for beside in (None, 2100.0) if (peak := find_peak(rpm, two, beside))] == [2600, 2000]
