"""Kriging surrogate of the response, and differential evolution on it (Han, Guo and Gao 2013).

The model is evaluated at points of a Latin hypercube within bounds that are known beforehand. A Gaussian process
(Kriging) interpolates its response between them, differential evolution finds where the surrogate comes nearest to
the measured response, and the hypercube is drawn anew, smaller, about the best point; that is repeated.

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
from pipeline.comparison.method import Estimate, Reason, Refusal, Task, doubt_of
from pipeline.comparison.parameters import Parameters, parameters_of, real_rows, require_determined

MOST_UNKNOWNS = 6
"""Beyond, a hypercube of so few points is empty: of eight it was 2 to 55 % off, on clean data."""
SPEEDS = 10
"""Speeds at which coefficients that change with the speed are found."""
_CONSTANT_SPEEDS = 60
"""Speeds whose responses are matched together where the coefficients are constant."""
_POINTS = 15
"""Points a hypercube for each unknown, of which there are at least four."""
_ROUNDS = 14
_SHRINK = 0.4
"""A side of the hypercube shrinks to this share where the best point moved by less than ``_NEAR`` of it."""
_NEAR = 0.3
_COMPONENTS = 12
_GENERATIONS = 60
_POPULATION = 10


def kriging(task: Task) -> Estimate:
    """Direct coefficients, from any sensors; raises Refusal for more than a few unknowns."""
    task = task.without_unbalance()
    if not all(is_direct(name) for name in task.unknowns.names):
        raise Refusal(Reason.EITHER_SIGN, f"{', '.join(task.unknowns.names)} are asked for")
    if len(task.active) > MOST_UNKNOWNS:
        raise Refusal(Reason.TOO_MANY_UNKNOWNS, f"there are {len(task.active)}, and {MOST_UNKNOWNS} are its limit")
    require_determined(task, together=task.constant)
    parameters = parameters_of(task)
    n_speeds = len(task.dataset.speeds)
    count = min(_CONSTANT_SPEEDS if task.constant else SPEEDS, n_speeds)
    chosen = _chosen(task.dataset.speeds, count, even_in_logarithm=not task.constant)
    groups = [chosen] if task.constant else [np.array([s]) for s in chosen]
    generator = np.random.default_rng(task.seed)
    x = np.stack([_found(task, parameters, group, generator) for group in groups])  # (groups, A)
    left_over = sum(_chi_square(task, parameters, group, own) for group, own in zip(groups, x, strict=True))
    readings = 2 * len(chosen) * task.dataset.displacement[0].size - x.size
    deviation = np.stack([_deviation(task, parameters, group, own) for group, own in zip(groups, x, strict=True)])
    if task.constant:
        x, deviation = np.repeat(x, n_speeds, axis=0), np.repeat(deviation, n_speeds, axis=0)
    else:
        x, deviation = (_between(task.dataset.speeds, chosen, values) for values in (x, deviation))
    evaluations = len(groups) * _ROUNDS * _points(x.shape[1])
    words = f"{evaluations} modelled responses, {len(groups)} surrogate{'s' * (len(groups) > 1)}"
    spread = task.active_values(deviation * parameters.slope(x))
    return task.estimate(parameters.values(x), spread, words, doubt_of(left_over, readings))


def _chosen(speeds: np.ndarray, count: int, even_in_logarithm: bool) -> np.ndarray:
    """Indices of about ``count`` speeds from the first to the last."""
    place = np.log(speeds) if even_in_logarithm else speeds
    wanted = np.linspace(place[0], place[-1], count)
    return np.unique(np.abs(place[:, None] - wanted).argmin(axis=0))


def _points(active: int) -> int:
    return _POINTS * max(active, 4)


def _at(task: Task, speeds: np.ndarray) -> Task:
    """The task at some of its speeds (indices)."""
    return replace(task, dataset=task.dataset.at(speeds), known=task.known.at(speeds))


def _between(speeds: np.ndarray, chosen: np.ndarray, values: np.ndarray) -> np.ndarray:
    """(S, A) monotone cubic interpolation over the logarithm of the speed."""
    from scipy.interpolate import PchipInterpolator

    if len(chosen) == len(speeds):
        return values
    return np.asarray(PchipInterpolator(np.log(speeds[chosen]), values)(np.log(speeds)))


def _found(task: Task, parameters: Parameters, speeds: np.ndarray, generator: np.random.Generator) -> np.ndarray:
    """(A,) what comes nearest to the readings at ``speeds`` (indices)."""
    part = _at(task, speeds)
    own, equations = replace(parameters, task=part), part.response()

    def deviations(x: np.ndarray) -> np.ndarray:
        """(2 S P R,) logarithms of predicted over measured displacement, of one point (A,)."""
        predicted = equations.predict(part.table(own.values(np.repeat(x[None], len(speeds), axis=0))))
        return real_rows(np.log(predicted / part.dataset.displacement)).ravel()

    return _nearest(deviations, *_bounds(task, parameters), generator)


def _chi_square(task: Task, parameters: Parameters, speeds: np.ndarray, x: np.ndarray) -> float:
    """Chi-square of the readings at ``speeds`` (indices), for one point (A,)."""
    part = _at(task, speeds)
    own = replace(parameters, task=part)
    predicted = part.response().predict(part.table(own.values(np.repeat(x[None], len(speeds), axis=0))))
    return 2 * float((np.abs(predicted - part.dataset.displacement) ** 2 / part.deviation**2).sum())


def _bounds(task: Task, parameters: Parameters) -> tuple[np.ndarray, np.ndarray]:
    prior = task.settings.prior
    limits = {
        True: (prior.lowest_stiffness, prior.highest_stiffness),
        False: (prior.lowest_damping, prior.highest_damping),
    }
    of = np.array([limits[is_stiffness(task.unknowns.names[u])] for _, u in task.active])
    low, high = np.log(of / parameters.size[:, None]).T
    return low, high


def _nearest(
    deviations: Callable[[np.ndarray], np.ndarray], low: np.ndarray, high: np.ndarray, generator: np.random.Generator
) -> np.ndarray:
    """(A,) the point of the smallest deviations within the bounds (A,): surrogate by surrogate, each smaller."""
    from scipy.stats import qmc

    best, least, side = (low + high) / 2, np.inf, high - low
    for _ in range(_ROUNDS):
        start = np.clip(best - side / 2, low, np.maximum(high - side, low))
        end = np.minimum(start + side, high)
        cube = qmc.LatinHypercube(len(low), rng=generator).random(_points(len(low)))
        points = start + cube * (end - start)
        rows = np.array([deviations(point) for point in points])
        candidate = _evolved(cube, rows, generator)
        points = np.concatenate([points, (start + candidate * (end - start))[None]])
        misfits = np.append((rows**2).sum(axis=1), (deviations(points[-1]) ** 2).sum())
        if misfits.min() < least:
            moved, best, least = np.abs(points[misfits.argmin()] - best), points[misfits.argmin()], float(misfits.min())
            side = np.where(moved < _NEAR * side, _SHRINK * side, side)
        else:
            side = _SHRINK * side
    return best


def _evolved(cube: np.ndarray, rows: np.ndarray, generator: np.random.Generator) -> np.ndarray:
    """(A,) where in the unit cube the surrogate of ``rows`` (N, D) at ``cube`` (N, A) is smallest."""
    from scipy.optimize import differential_evolution
    from sklearn.gaussian_process import GaussianProcessRegressor
    from sklearn.gaussian_process.kernels import RBF, WhiteKernel

    middle = rows.mean(axis=0)
    left, singular, components = np.linalg.svd(rows - middle, full_matrices=False)
    count = min(_COMPONENTS, int((singular > 1e-10 * singular[0]).sum()))
    scores, components = (left * singular)[:, :count], components[:count]
    size = scores.std(axis=0)
    kernel = RBF(np.ones(cube.shape[1]), (1e-2, 1e3)) + WhiteKernel(1e-8, (1e-12, 1e-1))
    surrogate = GaussianProcessRegressor(kernel, random_state=0)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # a hyperparameter at its bound
        surrogate.fit(cube, scores / size)
    inside = components @ middle  # the part of the mean deviation that the components can take away

    def misfit(x: np.ndarray) -> np.ndarray:
        predicted = surrogate.predict(np.atleast_2d(x.T)).reshape(-1, count) * size + inside
        return np.asarray((predicted**2).sum(axis=1)) if x.ndim > 1 else (predicted**2).sum()

    found = differential_evolution(
        misfit,
        [(0.0, 1.0)] * cube.shape[1],
        maxiter=_GENERATIONS,
        popsize=_POPULATION,
        tol=1e-10,
        rng=generator,
        vectorized=True,
        updating="deferred",
        polish=True,
    )
    return np.asarray(found.x)


def _deviation(task: Task, parameters: Parameters, speeds: np.ndarray, x: np.ndarray) -> np.ndarray:
    """(A,) the Cramer-Rao bound of the readings that were matched."""
    part = _at(task, speeds)
    own = replace(parameters, task=part)
    by = own.sensitivity(part.response(), np.repeat(x[None], len(speeds), axis=0))
    rows = real_rows(by * (np.sqrt(2) / part.deviation)[..., None]).reshape(-1, len(x))
    size = np.maximum(np.linalg.norm(rows, axis=0), 1e-300)
    singular, right = np.linalg.svd(rows / size, full_matrices=False)[1:]
    return np.sqrt(((right / singular[:, None]) ** 2).sum(axis=0)) / size
