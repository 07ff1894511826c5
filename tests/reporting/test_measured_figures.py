"""Figures of measured data: a lag is the opposite of the angle."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.reporting.measured_figures import find_lag


def test_a_lag_is_the_opposite_of_the_angle() -> None:
    lag = np.linspace(30, 500, 50)
    assert find_lag(2.0 * np.exp(-1j * np.radians(lag))) == pytest.approx(lag)
    assert find_lag(np.exp(1j * np.radians([90.0]))) == pytest.approx([270.0])
