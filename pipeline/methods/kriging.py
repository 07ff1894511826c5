"""Kriging surrogate of the response, and differential evolution on it (Han, Guo and Gao 2013).

The model is evaluated at points of a Latin hypercube within bounds that are known beforehand. A Gaussian process
(Kriging) interpolates its response between them, differential evolution finds where the surrogate comes nearest to
the measured response, and a smaller hypercube is drawn about the best point; that is repeated.

What is interpolated is the logarithm of predicted over measured displacement: amplitude and phase, whose noise is
that of the readings, in a few principal components. Coefficients that change with the speed are found at some speeds,
each by itself, and interpolated in between.

Legend: S speeds, P channels, R runs, A unknowns, N points.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from pipeline.coefficients import is_direct, is_stiffness
from pipeline.config.comparison import PriorConfig
from pipeline.methods.method import (
    Estimate,
    MethodOptions,
    Refusal,
    doubt,
    make_estimate,
    require_determined,
)
from pipeline.problem.measurement import Measurement
from pipeline.problem.slopes import ReadingSlopes, stack_rows
from pipeline.rotor.bearing_table import BearingTable


def identify_by_kriging(
    data: Measurement, options: MethodOptions, most_unknowns: int = 6, n_speeds: int = 10, rounds: int = 14
) -> Estimate:
    """Direct coefficients, from any sensors.

    Raises Refusal for more than ``most_unknowns``: beyond, a hypercube of so few points is empty (of eight it was 2 to
    55 % off, on clean data). Coefficients that change with the speed are found at ``n_speeds`` speeds, each by 840
    modelled responses and a surrogate a round; what is in between is interpolated, and the readings there are not used.
    Constant coefficients use every speed.
    """
    unknowns, speeds = data.unknowns, data.dataset.speeds
    if not all(is_direct(name) for name in unknowns.names):
        raise Refusal("either_sign", f"{', '.join(unknowns.names)} are asked for")
    if len(unknowns.active) > most_unknowns:
        raise Refusal("too_many_unknowns", f"there are {len(unknowns.active)}, and {most_unknowns} are its limit")
    require_determined(data, together=options.constant)
    chosen = np.arange(len(speeds)) if options.constant else _choose(speeds, min(n_speeds, len(speeds)))
    groups = [chosen] if options.constant else [np.array([s]) for s in chosen]
    generator = np.random.default_rng(options.seed)
    parts = [data.select(group) for group in groups]
    x = np.stack([_match(group, options.settings.prior, generator, rounds) for group in parts])  # (groups, A)
    off = [(_predict(p, answer) - p.dataset.displacement) / p.deviation for p, answer in zip(parts, x, strict=True)]
    left_over = sum(2 * float((np.abs(part) ** 2).sum()) for part in off)
    readings = 2 * len(chosen) * data.dataset.displacement[0].size - x.size
    deviation = np.stack([_bound_deviation(group, answer) for group, answer in zip(parts, x, strict=True)])
    if options.constant:
        x, deviation = np.repeat(x, len(speeds), axis=0), np.repeat(deviation, len(speeds), axis=0)
    else:
        from scipy.interpolate import PchipInterpolator

        if len(chosen) < len(speeds):  # monotone cubics over the logarithm of the speed
            place = np.log(speeds)
            x, deviation = (PchipInterpolator(place[chosen], values)(place) for values in (x, deviation))
    evaluations = len(groups) * rounds * _count_points(x.shape[1])
    text = f"{evaluations} modelled responses, {len(groups)} surrogate{'s' * (len(groups) > 1)}"
    spread = unknowns.from_active(deviation * np.exp(x))
    estimate = make_estimate(data, unknowns.from_active(np.exp(x)), spread, text, doubt(left_over / readings))
    return replace(estimate, n_speeds=len(chosen))


def _choose(speeds: np.ndarray, count: int) -> np.ndarray:
    """Indices of about ``count`` speeds from the first to the last, even in their logarithm."""
    place = np.log(speeds)
    wanted = np.linspace(place[0], place[-1], count)
    return np.unique(np.abs(place[:, None] - wanted).argmin(axis=0))


def _count_points(active: int, each: int = 15) -> int:
    """Points of a hypercube: so many for each unknown, of which there are at least four."""
    return each * max(active, 4)


def _predict(measurement: Measurement, x: np.ndarray) -> np.ndarray:
    """(S, P, R) m of one point (A,), the logarithms of the unknowns, the same at every speed."""
    return measurement.response.predict(_tabulate(measurement, x))


def _tabulate(measurement: Measurement, x: np.ndarray) -> BearingTable:
    """The coefficients of one point (A,)."""
    return measurement.table(measurement.unknowns.from_active(np.exp(x)[None]))


def _match(measurement: Measurement, prior: PriorConfig, generator: np.random.Generator, rounds: int) -> np.ndarray:
    """(A,) what comes nearest to the readings."""

    def deviations(x: np.ndarray) -> np.ndarray:
        """(2 S P R,) logarithms of predicted over measured displacement, of one point (A,)."""
        return stack_rows(np.log(_predict(measurement, x) / measurement.dataset.displacement)).ravel()

    limits = {
        True: (prior.lowest_stiffness, prior.highest_stiffness),
        False: (prior.lowest_damping, prior.highest_damping),
    }
    low, high = np.log([limits[is_stiffness(measurement.unknowns.names[u])] for _, u in measurement.unknowns.active]).T
    return _find_nearest(deviations, low, high, generator, rounds)


def _find_nearest(
    deviations: Callable[[np.ndarray], np.ndarray],
    low: np.ndarray,
    high: np.ndarray,
    generator: np.random.Generator,
    rounds: int,
    shrink: float = 0.4,
    near: float = 0.3,
) -> np.ndarray:
    """(A,) the point of the smallest deviations within the bounds (A,): surrogate by surrogate, each smaller.

    A side of the hypercube shrinks to the share ``shrink`` where the best point came by less than ``near`` of it.
    """
    from scipy.stats import qmc

    best, least, side = (low + high) / 2, np.inf, high - low
    for _ in range(rounds):
        start = np.clip(best - side / 2, low, np.maximum(high - side, low))
        end = np.minimum(start + side, high)
        cube = qmc.LatinHypercube(len(low), rng=generator).random(_count_points(len(low)))
        points = start + cube * (end - start)
        rows = np.array([deviations(point) for point in points])
        candidate = _evolve(cube, rows, generator)
        points = np.concatenate([points, (start + candidate * (end - start))[None]])
        misfits = np.append((rows**2).sum(axis=1), (deviations(points[-1]) ** 2).sum())
        if misfits.min() < least:
            nearest = points[misfits.argmin()]
            distance, best, least = np.abs(nearest - best), nearest, float(misfits.min())
            side = np.where(distance < near * side, shrink * side, side)
        else:
            side = shrink * side
    return best


def _evolve(
    cube: np.ndarray,
    rows: np.ndarray,
    generator: np.random.Generator,
    most_components: int = 12,
    generations: int = 60,
    population: int = 10,
) -> np.ndarray:
    """(A,) where in the unit cube the surrogate of ``rows`` (N, D) at ``cube`` (N, A) is smallest."""
    from scipy.optimize import differential_evolution
    from sklearn.gaussian_process import GaussianProcessRegressor
    from sklearn.gaussian_process.kernels import RBF, WhiteKernel

    middle = rows.mean(axis=0)
    left, singular, components = np.linalg.svd(rows - middle, full_matrices=False)
    count = min(most_components, int((singular > 1e-10 * singular[0]).sum()))
    scores, components = (left * singular)[:, :count], components[:count]
    size = scores.std(axis=0)
    kernel = RBF(np.ones(cube.shape[1]), (1e-2, 1e3)) + WhiteKernel(1e-8, (1e-12, 1e-1))
    surrogate = GaussianProcessRegressor(kernel, random_state=0)
    with warnings.catch_warnings(action="ignore"):  # a hyperparameter at its bound
        surrogate.fit(cube, scores / size)
    inside = components @ middle  # the part of the mean deviation that the components can take away

    def misfit(x: np.ndarray) -> np.ndarray:
        predicted = surrogate.predict(np.atleast_2d(x.T)).reshape(-1, count) * size + inside
        return np.asarray((predicted**2).sum(axis=1)) if x.ndim > 1 else (predicted**2).sum()

    evolved = differential_evolution(
        misfit,
        [(0.0, 1.0)] * cube.shape[1],
        maxiter=generations,
        popsize=population,
        tol=1e-10,
        rng=generator,
        vectorized=True,
        updating="deferred",
        polish=True,
    )
    return np.asarray(evolved.x)


def _bound_deviation(measurement: Measurement, x: np.ndarray) -> np.ndarray:
    """(A,) the Cramer-Rao bound of the readings that were matched."""
    slopes = ReadingSlopes(measurement, _tabulate(measurement, x))
    rows = np.sqrt(2) * stack_rows(slopes.by_unknown * np.exp(x)).reshape(-1, len(x))
    size = np.maximum(np.linalg.norm(rows, axis=0), 1e-300)
    return np.asarray(np.linalg.norm(np.linalg.pinv(rows / size), axis=1) / size)
