"""Smoothed least squares: the smoother against SciPy's, its interval, and what it makes of noise."""

from __future__ import annotations

import numpy as np
from scipy.interpolate import make_smoothing_spline

from pipeline.methods.least_squares import _penalise, smooth_by_cross_validation, smooth_over_speed


def test_the_penalty_is_that_of_scipys_smoothing_spline() -> None:
    """The same minimiser at the same strength, for uneven places and weights."""
    generator = np.random.default_rng(0)
    place = np.sort(generator.uniform(0, 4, 25))
    values, weight = np.sin(place) + 0.1 * generator.standard_normal(25), generator.uniform(0.2, 5, 25)
    for strength in (1e-3, 0.1, 10.0):
        ours = np.linalg.solve(np.diag(weight) + strength * _penalise(place), weight * values)
        theirs = make_smoothing_spline(place, values, weight, strength)(place)
        np.testing.assert_allclose(ours, theirs, rtol=1e-6, atol=1e-8)


def test_cross_validation_smooths_as_scipys_does() -> None:
    """Both choose the strength by generalised cross-validation, by their own search."""
    generator = np.random.default_rng(1)
    place = np.linspace(0, 4, 80)
    values = np.sin(2 * place) + 0.2 * generator.standard_normal(80)
    ours, _ = smooth_by_cross_validation(place, values, np.full(80, 1 / 0.2**2))
    assert np.abs(ours - make_smoothing_spline(place, values)(place)).max() < 0.02


def test_the_stated_deviation_holds_over_many_data_sets() -> None:
    """A power law with a bend, and noise of very different size at each speed: nominal 95 % intervals."""
    generator = np.random.default_rng(2)
    speeds = np.linspace(10, 600, 120)
    truth = 1e9 / speeds * (1 + 0.3 * np.tanh((speeds - 300) / 100))
    deviation = truth * np.geomspace(0.3, 0.01, 120)
    inside, size = [], []
    for _ in range(40):
        found, stated = smooth_over_speed(speeds, truth + deviation * generator.standard_normal(120), deviation)
        inside.append((np.abs(found - truth) <= 1.96 * stated).mean())
        size.append(np.sqrt(np.mean(((found - truth) / deviation) ** 2)))
    assert 0.9 < np.mean(inside) < 0.99
    assert np.mean(size) < 0.5  # of the deviation of the single speeds
