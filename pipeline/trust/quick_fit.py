"""A fit in a tenth of a second, to compare explanations of the same readings.

Coefficients are few Chebyshev terms in the logarithm of the speed, direct ones their exponential; the start is linear
least squares, which no wrong guess misleads, and Levenberg and Marquardt do the rest. Extra columns are numbers that an
explanation leaves free, such as the size of one run's weight.

Legend: S speeds, P channels, R runs, A active unknowns, K functions, E extra numbers. SI units.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from pipeline.errors import IdentifiabilityError
from pipeline.identification.linear_start import linear_start
from pipeline.problem.measurement import Measurement

Extra = Callable[[np.ndarray], np.ndarray]
"""Predicted readings (S, P, R) m -> derivative of them (S, P, R, E) by the extra numbers, which are zero as stated."""


@dataclass(frozen=True, eq=False)
class QuickFit:
    """The end of a quick fit."""

    mean_square: float  # of what it leaves over, over the noise
    values: np.ndarray  # (M, S, U) unknowns
    extra: np.ndarray  # (E,)


def quick_fit(
    measurement: Measurement, start: np.ndarray, terms: int, extra: Extra | None = None, rounds: int = 12
) -> QuickFit:
    """Fit the unknowns to the readings, from a linear start where the probes allow one, and from ``start``.

    Args:
        start: (M, S, U) unknowns to begin with as well, N/m and N s/m.
        terms: K; 1 for constants.
    """
    start, scale = _within_reason(measurement, start)
    begins = [start]
    functions = speed_functions(measurement, terms)
    members = np.broadcast_to(functions, (len(start), *functions.shape))
    try:
        linear = linear_start(measurement, members, scale)
    except (np.linalg.LinAlgError, IdentifiabilityError):
        linear = None
    if linear is not None and np.isfinite(linear).all():
        begins.append(linear)
    fits = [_minimise(measurement, begin, scale, functions, extra, rounds) for begin in begins]
    return min(fits, key=lambda fitted: fitted.mean_square)


def _within_reason(measurement: Measurement, start: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The start, and its sizes (M, U); the guess takes the place of what ran away in a fit of wrong readings."""
    guess = measurement.guess.sizes(measurement.unknowns)
    size = np.median(np.abs(start), axis=1)
    fine = (size < _RAN_AWAY * guess) & (size > guess / _RAN_AWAY)
    return np.where(fine[:, None], start, guess[:, None]), np.where(fine, size, guess)


_RAN_AWAY = 1e4


def speed_functions(measurement: Measurement, terms: int) -> np.ndarray:
    """(S, K) Chebyshev polynomials of the logarithm of the speed."""
    place = np.log(measurement.dataset.speeds)
    span = place[-1] - place[0]
    scaled = 2 * (place - place[0]) / span - 1 if span > 0 else np.zeros(len(place))
    return np.asarray(np.polynomial.chebyshev.chebvander(scaled, min(terms, len(place)) - 1))


def _minimise(
    measurement: Measurement,
    start: np.ndarray,
    scale: np.ndarray,
    functions: np.ndarray,
    extra: Extra | None,
    rounds: int,
) -> QuickFit:
    problem = _Problem(measurement, scale, functions, extra)
    weights = problem.weights_of(start)
    damping = 1e-3
    loss, normal, right = problem.normal(weights)
    for _ in range(rounds):
        size = np.maximum(np.diag(normal), 1e-12 * np.diag(normal).max() + 1e-300)
        step = np.linalg.solve(normal + damping * np.diag(size), right)
        tried = weights + np.clip(step, -_LONGEST, _LONGEST)
        new, *rest = problem.normal(tried)
        if np.isfinite(new) and new < loss:
            small = new > (1 - _STILL) * loss
            weights, loss, damping = tried, new, damping / 5
            normal, right = rest
            if small:
                break
        else:
            damping *= 10
            if damping > _GIVE_UP:
                break
    count = measurement.dataset.displacement.size
    n_coefficients = len(weights) - problem.n_extra
    return QuickFit(loss / count, problem.values(weights), weights[n_coefficients:])


_LONGEST, _STILL, _GIVE_UP = 1.0, 1e-3, 1e8


class _Problem:
    """Residuals over the noise, and their normal equations."""

    def __init__(self, measurement: Measurement, scale: np.ndarray, functions: np.ndarray, extra: Extra | None) -> None:
        self.measurement, self.functions, self.extra = measurement, functions, extra
        active = measurement.unknowns.active
        self.scale = np.array([scale[m, u] for m, u in active])
        self.positive = np.array([measurement.unknowns.names[u] in _DIRECT for _, u in active])
        empty = np.zeros_like(measurement.dataset.displacement)
        self.n_extra = 0 if extra is None else extra(empty).shape[-1]

    def weights_of(self, values: np.ndarray) -> np.ndarray:
        """(A K + E,) nearest to unknowns (M, S, U)."""
        relative = np.stack([values[m, :, u] for m, u in self.measurement.unknowns.active], axis=1) / self.scale
        positive = np.log(np.maximum(relative, _LEAST))
        raw = np.where(self.positive, positive, relative)
        solution = np.linalg.lstsq(self.functions, raw, rcond=None)[0].T
        return np.concatenate([solution.ravel(), np.zeros(self.n_extra)])

    def _outputs(self, weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(S, A) unknowns and their slope by the raw outputs."""
        count = len(weights) - self.n_extra
        raw = self.functions @ weights[:count].reshape(len(self.scale), -1).T
        grown = np.exp(np.clip(raw, -_WIDEST, _WIDEST))
        return (
            self.scale * np.where(self.positive, grown, raw),
            self.scale * np.where(self.positive, grown, 1.0),
        )

    def values(self, weights: np.ndarray) -> np.ndarray:
        """(M, S, U)."""
        return self.measurement.unknowns.from_active(self._outputs(weights)[0])

    def normal(self, weights: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
        """Sum of squares over the noise, its normal matrix and right-hand side."""
        measurement, unknowns = self.measurement, self.measurement.unknowns
        coefficients, slope = self._outputs(weights)
        bearings = measurement.table(unknowns.from_active(coefficients))
        with np.errstate(all="ignore"):
            predicted = measurement.response.predict(bearings)
            by_coefficient = measurement.response.sensitivity(bearings)
        by_unknown = (
            np.einsum("sprbc,bca->spra", by_coefficient, unknowns.influence, optimize=True) * slope[:, None, None]
        )
        rows = np.einsum("spra,sk->sprak", by_unknown, self.functions).reshape(*predicted.shape, -1)
        if self.extra is not None:
            more = self.extra(predicted)
            predicted = predicted + more @ weights[len(weights) - self.n_extra :]
            rows = np.concatenate([rows, more], axis=-1)
        left = (measurement.dataset.displacement - predicted) / measurement.deviation
        rows = (rows / measurement.deviation[..., None]).reshape(left.size, -1)
        flat = left.ravel()
        if not (np.isfinite(flat).all() and np.isfinite(rows).all()):
            return np.inf, np.eye(len(weights)), np.zeros(len(weights))
        normal = (rows.conj().T @ rows).real
        return float((np.abs(flat) ** 2).sum()), normal, (rows.conj().T @ flat).real


_DIRECT = ("kxx", "kyy", "cxx", "cyy")
_LEAST, _WIDEST = 1e-3, 12.0
"""What a direct coefficient is held above, as a share of its size, and its logarithm within."""
