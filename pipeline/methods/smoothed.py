"""Least squares at each speed, then a weighted smoothing spline over the speed: what an engineer would do.

The answer of each speed is that of least squares with expansion, and its weight what the readings' noise leaves of it.
Each unknown is divided by the power law of the speed that is nearest to it, and a natural cubic smoothing spline of the
logarithm of the speed (Reinsch 1967) goes through what is left. Generalised cross-validation chooses how smooth it is
(Craven and Wahba 1979), and the deviation is Wahba's (1983), which allows for what the smoothing hides.

Legend: M members, S speeds, U unknowns.
"""

from __future__ import annotations

import numpy as np

from pipeline.methods.least_squares import solve_expanded
from pipeline.methods.method import Estimate, MethodOptions, make_estimate
from pipeline.problem.measurement import Measurement


def solve_smoothed(data: Measurement, options: MethodOptions, fewest: int = 4) -> Estimate:
    """Weighted means where the coefficients are known to be constant, else smoothing splines. Raises Refusal.

    Through fewer than ``fewest`` speeds a spline has nothing to smooth.
    """
    estimate, unknowns = solve_expanded(data, options), data.unknowns
    values = unknowns.leading(estimate.coefficients.values)
    spread = unknowns.leading(estimate.deviation)
    smooth, deviation = np.zeros_like(values), np.zeros_like(values)
    for m, u in unknowns.active:
        answer, deviations = values[m, :, u], spread[m, :, u]
        if options.constant:
            smooth[m, :, u], deviation[m, :, u] = _average(answer, deviations)
        elif len(answer) >= fewest:
            smooth[m, :, u], deviation[m, :, u] = smooth_over_speed(data.dataset.speeds, answer, deviations)
        else:
            smooth[m, :, u], deviation[m, :, u] = answer, deviations
    return make_estimate(data, smooth, deviation)


def _average(values: np.ndarray, deviation: np.ndarray) -> tuple[float, float]:
    weight = 1 / deviation**2
    return float(weight @ values / weight.sum()), float(1 / np.sqrt(weight.sum()))


def smooth_over_speed(
    speeds: np.ndarray, values: np.ndarray, deviation: np.ndarray, least_weight: float = 1e-12
) -> tuple[np.ndarray, np.ndarray]:
    """Smooth values (S,) and their standard deviation (S,), from values of each speed with deviations (S,)."""
    place = np.log(speeds)
    usable = np.isfinite(deviation) & (values != 0)
    weight = np.where(usable, np.abs(values) / np.where(usable, deviation, 1.0), 0.0)
    size = np.abs(np.where(usable, values, 1.0))
    law = np.exp(np.polyval(np.polyfit(place, np.log(size), 1, w=np.minimum(weight, np.median(weight))), place))
    ratio, relative = np.where(usable, values, 0.0) / law, np.where(usable, deviation, np.inf) / law
    weight = 1 / relative**2
    weight = np.maximum(weight, least_weight * weight.max())
    smooth, variance = smooth_by_cross_validation(place, ratio, weight)
    return smooth * law, np.sqrt(variance) * law


def smooth_by_cross_validation(
    place: np.ndarray, values: np.ndarray, weight: np.ndarray, decades: int = 12
) -> tuple[np.ndarray, np.ndarray]:
    """The smoothing spline (S,) of least cross-validation, and its variance (S,); ``weight`` (S,) is 1 over variances.

    It minimises ``sum w (y - f)^2 + strength int f''^2``, a filter in the basis of Demmler and Reinsch. Zero is tried
    for the strength, and up to so many ``decades`` about that of the median curvature.
    """
    root = np.sqrt(weight)
    curvature, modes = np.linalg.eigh(_penalise(place) / root[:, None] / root)
    curvature = np.maximum(curvature, 0.0)
    inside = modes.T @ (root * values)
    tried = np.concatenate([[0.0], np.geomspace(10.0**-decades, 10.0**decades, 20 * decades + 1)])
    strength = tried / np.median(curvature)
    kept = 1 / (1 + strength[:, None] * curvature)  # (strengths, S)
    freedom = (1 - kept).sum(axis=1)
    left_over = (((1 - kept) * inside) ** 2).sum(axis=1)
    score = np.divide(left_over, freedom**2, out=np.full(len(kept), np.inf), where=freedom > 1e-6 * len(values))
    best = kept[score.argmin()]
    return modes @ (best * inside) / root, (modes**2 @ best) / weight


def _penalise(place: np.ndarray) -> np.ndarray:
    """(S, S) of the integral of the squared second derivative of the natural cubic spline through S values."""
    from scipy.interpolate import CubicSpline

    second = CubicSpline(place, np.eye(len(place)), bc_type="natural")(place, 2)  # linear between the places
    low, high, step = second[:-1], second[1:], np.diff(place)[:, None] / 6
    mixed = low.T @ (step * high)
    return np.asarray(2 * (low.T @ (step * low) + high.T @ (step * high)) + mixed + mixed.T)
