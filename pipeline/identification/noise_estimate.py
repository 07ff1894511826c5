"""What the readings' noise is like, by what a fit leaves over: its floor beside its share of the reading, and how it
correlates with that at the next speed.

A fit follows noise that wanders slowly, so what it leaves over wanders less than the noise itself. The restricted
likelihood (Patterson and Thompson 1971) counts what the fit took: its Laplace form is of first order about an answer.

Legend: Z weights, S speeds, P channels, R runs.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from pipeline.identification.problem import OutputError

if TYPE_CHECKING:
    import torch


def reshape_noise(
    problem: OutputError,
    weights: torch.Tensor,
    factor: np.ndarray | float = 1.0,
    *,
    tried: Sequence[float] = (1.0, 0.01, 0.03, 0.1, 0.3, 3.0, 10.0, 30.0, 100.0),
    sure: float = 6.0,
    small: float = 0.25,
    large: float = 100.0,
) -> OutputError:
    """The problem with the noise whose floor beside its share is likeliest, about the weights (1, 1, Z): so many times
    as large as stated (``tried``, what is stated first).

    ``factor`` (P,) is each channel's noise over the stated one. The noise stays as it is where twice the logarithm of
    the likelihood gains less than ``sure``, where what is left over is ``small`` beside it, or so ``large`` beside the
    stated one (mean squares) that it is no noise but a mistake, and where floor or share is none.
    """
    measurement, predicted = problem.measurement, problem.predicted(weights)
    noise, data = measurement.noise, measurement.dataset
    told = noise.floored and noise.multiplicative and not measurement.drift and not data.noise.any()
    if not told or _leave_over(problem, weights)[1] < small:
        return problem
    stated = replace(problem, readings=problem.readings.follow(predicted))
    if not _leave_over(stated, weights)[1] < large:
        return problem
    both = np.broadcast_arrays(data.displacement + measurement.baseline, noise.floor_at(data.frequencies))
    read, floors = (every.swapaxes(1, 2)[data.present] for every in both)
    others = [problem.with_noise(noise.reshaped(ratio, read, floors), predicted, factor) for ratio in tried]
    criteria = []
    for other in others:
        columns = other.correlated(0.0).columns_of_blocks(weights)
        criteria.append(_measure(other, weights, columns, other.fitted())[0])
    best = int(np.argmin(criteria))
    return others[best] if criteria[0] - criteria[best] >= sure else problem


def estimate_correlation(
    problem: OutputError,
    weights: torch.Tensor,
    *,
    tried: Sequence[float] = (0.0, 0.3, 0.5, 0.6, 0.7, 0.8, 0.85, 0.9, 0.93, 0.95, 0.97, 0.98, 0.99),
    seen: float = 3.0,
    sure: float = 6.0,
    small: float = 0.25,
) -> tuple[float, float]:
    """The likeliest of the correlations ``tried`` (zero first) from speed to speed, about the weights (1, 1, Z), and
    the noise over that of the readings.

    It is zero, and the noise as it was, where neighbouring deviations correlate by less than ``seen`` standard
    deviations, or twice the logarithm of the likelihood gains less than ``sure``; and where what is left over is
    ``small`` beside the noise (mean square), as in data without any, whose rest is what functions can't follow.
    """
    plain = problem.correlated(0.0)
    off, square = _leave_over(plain, weights)
    if autocorrelation(off)[1] < seen or square < small:
        return 0.0, 1.0
    blocks, fitted = plain.columns_of_blocks(weights), plain.fitted()
    measured = [_measure(plain.correlated(r), weights, blocks, fitted) for r in tried]
    best = int(np.argmin([criterion for criterion, _ in measured]))
    if measured[0][0] - measured[best][0] < sure:
        return 0.0, 1.0
    return tried[best], measured[best][1]


def _leave_over(problem: OutputError, weights: torch.Tensor) -> tuple[list[np.ndarray], float]:
    """Complex deviations (S, P, R) of each block over the noise, and their mean square."""
    off = [block[0].numpy() for block in problem.deviations(weights)]
    return off, sum(float((np.abs(block) ** 2).sum()) for block in off) / problem.readings.size


def _measure(
    problem: OutputError, weights: torch.Tensor, blocks: Sequence[torch.Tensor], fitted: torch.Tensor, turns: int = 12
) -> tuple[float, float]:
    """Minus twice the logarithm of the restricted likelihood at the likeliest size of the noise, and that size: what is
    left over by the numbers that the fit did not take, a fixed point in so many ``turns``.
    """
    import torch

    mixed = [problem.readings.mix(b, block)[0].flatten(0, 2) for b, block in enumerate(blocks)]
    rows = torch.cat([part for block in mixed for part in (block.real, block.imag)])
    rows = rows[:, torch.cat([fitted, torch.ones(1, dtype=torch.bool)])]
    products, count, square = rows.mT @ rows, problem.readings.size, 1.0
    known = problem.prior.information[fitted][:, fitted]
    pull = problem.prior.gradient(weights[:, 0])[0, fitted]
    for _ in range(turns):
        told = products[:-1, :-1] / square
        information = told + known
        step = -torch.linalg.solve(information, products[:-1, -1] / square + pull)
        left = float(products[-1, -1] + 2 * step @ products[:-1, -1] + step @ products[:-1, :-1] @ step)
        used = float(torch.linalg.solve(information, told).diagonal().sum())
        square = left / max(count - used, 1.0)
    # What priors deviate by before the step is alike for all that is tried.
    prior = float(2 * step @ pull + step @ known @ step) + float(torch.linalg.slogdet(information)[1])
    return count * np.log(square) + left / square + prior + problem.readings.log_determinant(), float(np.sqrt(square))


def autocorrelation(deviations: Sequence[np.ndarray]) -> tuple[float, float]:
    """Correlation of complex deviations (S, P, R) at neighbouring speeds, and that over its standard deviation.

    The deviation is that of independent values of any variances (see :func:`measure_whiteness`).
    """
    products = np.concatenate([_multiply_neighbours(d, 1).ravel() for d in deviations])
    power = sum(float((np.abs(d) ** 2).sum()) for d in deviations)
    spread = float(np.sqrt((products**2).sum()))  # zero where nothing was measured
    if power == 0 or spread == 0:
        return 0.0, 0.0
    return float(products.sum()) / power, float(products.sum()) / spread


def _multiply_neighbours(deviations: np.ndarray, lag: int) -> np.ndarray:
    """(S - lag, P, R) products of complex deviations that are ``lag`` speeds apart."""
    return np.asarray((deviations[lag:] * deviations[:-lag].conj()).real)


def measure_whiteness(deviations: Sequence[np.ndarray], most_lags: int = 10) -> float | None:
    """Probability of such correlations over the speed, or of larger ones, if complex deviations (S, P, R) are white.

    Each lag k gives ``t = sum w / sqrt(sum w^2)`` with the products w of deviations k speeds apart, of all series:
    whatever their variances, t has mean 0 and variance 1 (Dalla, Giraitis and Phillips 2022, Econometric Theory 38).
    A fit leaves its residuals negative correlations, and what a model misses is smooth: the positive t alone count,
    and the sum of their squares is chi-bar-square (half of the lags have one, binomially). Lags go up to a fifth of
    the speeds (Ljung and Box 1978). What was not measured is zero. None where there are too few speeds.
    """
    from scipy.special import binom, chdtrc

    speeds = max((int((block != 0).any(axis=(1, 2)).sum()) for block in deviations), default=0)
    lags, total = min(most_lags, speeds // 5), 0.0
    for lag in range(1, lags + 1):
        products = np.concatenate([_multiply_neighbours(block, lag).ravel() for block in deviations])
        spread = float((products**2).sum())
        total += max(float(products.sum()), 0.0) ** 2 / spread if spread > 0 else 0.0
    if lags < 1 or not np.isfinite(total):
        return None
    counts = np.arange(1, lags + 1)
    return float(0.5**lags * binom(lags, counts) @ chdtrc(counts, total)) if total > 0 else 1.0
