"""The unbalance that a vibration means: exact without noise, and intervals that hold what they say with it."""

from __future__ import annotations

import numpy as np
import pytest
from balancing import GRAM, SIZE, TAILS, truth

from pipeline.balance.influence import fit_influence
from pipeline.balance.unbalance import Unbalance, estimate_unbalance
from pipeline.errors import DataError


def test_what_the_model_predicts_is_read_back() -> None:
    """With a law of the weights, from all entries and from one speed alone."""
    rng = np.random.default_rng(0)
    model = fit_influence(truth(rng, 0.2 / (60 * GRAM)).draw(rng, 40), law=True)
    weights = np.array([36, -24j]) * GRAM
    vector = model.predict(weights[None])[0][0]
    assert estimate_unbalance(model, vector).value == pytest.approx(weights, rel=1e-6)
    vector[SIZE // 2 :] = np.nan
    assert estimate_unbalance(model, vector).value == pytest.approx(weights, rel=1e-6)
    with pytest.raises(DataError, match="at least 2 vectors"):
        estimate_unbalance(model, np.full(SIZE, np.nan))


def test_intervals_of_magnitude_and_angle() -> None:
    """Far from zero those of the part along and across; at zero the magnitude may be zero and the angle anything."""
    one = Unbalance(np.array([50.0, 0.5]), 2 * np.eye(2) + 0j, float("inf"), 0.0)
    assert one.half_width() == pytest.approx([1.96, 1.96], abs=1e-3)
    assert one.magnitude_interval()[0] == pytest.approx([50 - 1.96, 50 + 1.96], abs=0.05)
    assert one.angle_half_width() == pytest.approx([np.arcsin(1.96 / 50), np.pi], abs=1e-4)
    assert one.magnitude_interval()[1, 0] == 0
    assert Unbalance(np.array([1.0 + 0j]), np.eye(1) + 0j, 0.0, 0.0).magnitude_interval()[0].tolist() == [0.0, np.inf]


@pytest.mark.slow
@pytest.mark.parametrize("tail", TAILS)
def test_intervals_of_weights_hold_what_they_say(tail: float | None) -> None:
    rng = np.random.default_rng(1)
    parts, magnitudes, angles = [], [], []
    for _ in range(30):
        conditions = truth(rng).draw(rng, 60, tail)
        model = fit_influence(conditions.of(range(40)), law=False)
        for c in range(40, 60):
            found, true = estimate_unbalance(model, conditions.vectors[c], 3), conditions.unbalance[c]
            width, error = found.half_width(), found.value - true
            parts += [abs(error.real) <= width, abs(error.imag) <= width]
            magnitude = found.magnitude_interval()
            magnitudes.append((magnitude[:, 0] <= abs(true)) & (abs(true) <= magnitude[:, 1]))
            loaded = abs(true) > 0
            angles += (abs(np.angle(found.value / np.where(loaded, true, 1))) <= found.angle_half_width())[
                loaded
            ].tolist()
    assert 0.93 < np.mean(parts) < 0.97
    assert 0.93 < np.mean(magnitudes) < 0.985
    assert 0.92 < np.mean(angles) < 0.98
