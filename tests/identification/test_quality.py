"""What a fit leaves over: whether it is white, of noise whose size changes with the speed; what was held out."""

from __future__ import annotations

import json
import math
from dataclasses import make_dataclass
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.stats import chi2

from pipeline.identification.noise_estimate import autocorrelation, measure_whiteness
from pipeline.identification.quality import _held_out, mismatch
from pipeline.trust.misfit import measure_misfit


def draw(size: np.ndarray, seed: int) -> np.ndarray:
    """(S, 4, 2) complex white noise of the ``size`` (S,) at each speed."""
    generator = np.random.default_rng(seed)
    shape = (len(size), 4, 2)
    return size[:, None, None] * (generator.standard_normal(shape) + 1j * generator.standard_normal(shape))


SPEEDS = np.linspace(0.0, 1.0, 60)
SHAPES = {
    "equal": np.ones(60),
    "a resonance": 1.0 + 20.0 / (1.0 + ((SPEEDS - 0.4) / 0.03) ** 2),
    "growing": np.exp(4.0 * SPEEDS),
}


@pytest.mark.parametrize("shape", SHAPES)
def test_white_noise_of_any_shape_is_called_white(shape: str) -> None:
    """At most 5 % of 200 data sets of estimated noise; Ljung and Box's statistic calls 10, 99 and 100 % coloured."""
    alarms = 0
    for seed in range(200):
        noise = [draw(SHAPES[shape], seed)]
        fit = {
            "chi_square": {"value": 1.0, "expected": 1.0},
            "whiteness": {"autocorrelation": 0.0, "probability": measure_whiteness(noise)},
            "mismatch": mismatch(None, 0, autocorrelation(noise)[1]),
            "noise_factor": {"node 1 x": 5.0},  # of the small one that is stated beforehand
        }
        alarms += not measure_misfit(fit).explained()
    assert alarms <= 10


def test_what_wanders_is_not_white() -> None:
    for size in SHAPES.values():
        wanders = draw(size, 1) + 1.5 * size[:, None, None] * np.sin(np.arange(60) / 10)[:, None, None]
        assert measure_whiteness([wanders]) < 1e-4


def test_what_a_fit_takes_away_raises_no_alarm() -> None:
    """A fit of two smooth functions to each series: Ljung and Box's statistic calls 87 % of such residuals coloured."""
    functions = np.linalg.qr(np.polynomial.chebyshev.chebvander(np.linspace(-1.0, 1.0, 27), 2))[0]
    alarms = 0
    for seed in range(200):
        noise = draw(np.ones(27), seed)
        alarms += measure_whiteness([noise - np.einsum("sk,tk,tpr->spr", functions, functions, noise)]) < 0.05
    assert alarms <= 10


def bar(statistic: float, lags: int) -> float:
    """Probability of a chi-bar-square value, written out."""
    return sum(math.comb(lags, k) / 2**lags * chi2.sf(statistic, k) for k in range(1, lags + 1))


def test_it_is_the_published_statistic() -> None:
    """Dalla, Giraitis and Phillips (2022), one series, five lags, of the positive ones; written out."""
    series = np.random.default_rng(3).standard_normal(25).cumsum()
    products = [series[lag:] * series[:-lag] for lag in range(1, 6)]
    statistic = sum(max(np.sum(product), 0.0) ** 2 / np.sum(product**2) for product in products)
    assert measure_whiteness([series[:, None, None].astype(complex)]) == pytest.approx(bar(statistic, 5))


def test_with_equal_variances_it_is_box_and_pierce() -> None:
    """``n sum r_k^2`` of the positive ones, to the accuracy of the estimated variances."""
    series = np.random.default_rng(7).standard_normal(20_000)
    shares = [np.sum(series[lag:] * series[:-lag]) / np.sum(series**2) for lag in range(1, 11)]
    expected = bar(len(series) * np.sum(np.square(np.maximum(shares, 0.0))), 10)
    assert measure_whiteness([series[:, None, None].astype(complex)]) == pytest.approx(expected, abs=0.02)


def test_the_probabilities_of_white_noise_are_even() -> None:
    """The quartiles of 400 data sets, to three deviations."""
    found = np.array([measure_whiteness([draw(np.ones(60), seed)]) for seed in range(400)])
    for share in (0.25, 0.5, 0.75):
        assert np.mean(found < share) == pytest.approx(share, abs=0.075)


def test_what_was_not_measured_is_left_out() -> None:
    noise = draw(np.ones(40), 4)
    absent = np.concatenate([noise, np.zeros((20, 4, 2))])
    assert measure_whiteness([absent]) == pytest.approx(measure_whiteness([noise]), abs=1e-12)
    assert measure_whiteness([np.zeros((60, 4, 2), dtype=complex)]) is None


def test_repeats_judge_the_size_of_what_is_left_over() -> None:
    """Noise from n repeats is itself uncertain: the same excess says less, and much says the same."""
    stated, repeated = mismatch(1300.0, 1000, 0.0), mismatch(1300.0, 1000, 0.0, repeated=200)
    assert stated["chi_square"] < repeated["chi_square"] < 0.05
    assert mismatch(1050.0, 1000, 0.0, repeated=200)["chi_square"] > 0.05


def held_out(predicted: complex) -> Any:
    """Two readings of 1 that were not fitted, with a noise of a tenth of what is predicted."""
    data = SimpleNamespace(n_readings=2, displacement=np.ones((2, 1, 1)), present=np.ones((2, 1)))
    measurement = make_dataclass("Read", ["dataset", "noise", "baseline", "deviation_of"])(
        data, None, 0.0, lambda read, baseline, factor: 0.1 * np.abs(read)
    )
    problem = SimpleNamespace(displacement=lambda weights: np.full((2, 1, 1), predicted), measurement=measurement)
    problem.update = lambda weights: problem
    return problem


@pytest.mark.parametrize("far", [complex("inf"), complex("nan"), 1e200 + 0j])
def test_a_prediction_beyond_all_bounds_is_null_in_json(far: complex) -> None:
    """A range that was held out, where coefficients are exponentials of functions that nothing holds there."""
    fit: Any = SimpleNamespace(weights=None, factor=np.ones(1), problem=held_out(far))
    assert json.loads(json.dumps(_held_out(fit, held_out(far)), allow_nan=False))["error_percent"] is None
    assert _held_out(fit, held_out(1.1 + 0j))["error_percent"] == pytest.approx(10.0)
