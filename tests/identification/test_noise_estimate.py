"""Whether what a fit leaves over is white: of noise of any size, against the published statistic."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.stats import chi2

from pipeline.identification.noise_estimate import autocorrelation, measure_whiteness
from pipeline.identification.quality import mismatch
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
