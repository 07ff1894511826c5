"""Bounds of sizes and chances of distances, against drawn numbers."""

from __future__ import annotations

import numpy as np
import pytest
from balancing import circular

from pipeline.balance.linear_vibration import bound_size, circle_radius, judge_distance


@pytest.mark.slow
def test_bounds_and_chances_of_drawn_numbers() -> None:
    rng = np.random.default_rng(6)
    noise = circular(rng, 40_000)
    assert np.mean(np.abs(noise) <= circle_radius(np.ones(1), np.inf)) == pytest.approx(0.95, abs=0.005)
    for true in (0.0, 0.7, 3.0, 300.0):
        bound = bound_size(np.array([true]), circle_radius(np.ones(1), np.inf))
        assert np.mean(np.abs(true + noise) <= bound) == pytest.approx(0.95, abs=0.005)
    drawn = circular(rng, 4000, 3)
    for values, freedom in ((drawn, np.inf), (drawn / np.sqrt(rng.chisquare(10, (4000, 1)) / 10), 5.0)):
        chances = [judge_distance(float((np.abs(v) ** 2).sum()), 3, freedom) for v in values]
        assert np.mean(np.array(chances) < 0.1) == pytest.approx(0.1, abs=0.02)
    assert np.isnan(judge_distance(1.0, 0, np.inf))
    assert np.isinf(circle_radius(np.ones(2), 0.0)).all()
