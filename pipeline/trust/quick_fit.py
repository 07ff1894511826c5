"""A fit in a tenth of a second, to compare explanations of the same readings.

Coefficients are few Chebyshev terms in the logarithm of the speed, direct ones their exponential; the start is linear
least squares, which no wrong guess misleads, and Levenberg and Marquardt do the rest. Extra columns are numbers that an
explanation leaves free, such as the size of one run's weight.

Legend: S speeds, P channels, R runs, A active unknowns, K functions, E extra numbers. SI units.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from pipeline.coefficients import is_direct
from pipeline.errors import IdentifiabilityError
from pipeline.identification.linear_start import linear_start
from pipeline.problem.measurement import Measurement
from pipeline.problem.slopes import ReadingSlopes
from pipeline.unknowns import outputs_of, scale_outputs

Extra = Callable[[np.ndarray], np.ndarray]
"""Predicted readings (S, P, R) m -> derivative of them (S, P, R, E) by the extra numbers, which are zero as stated."""


def nothing_free(predicted: np.ndarray) -> np.ndarray:
    """No extra number."""
    return np.zeros((*predicted.shape, 0))


@dataclass(frozen=True, eq=False)
class QuickFit:
    """The end of a quick fit."""

    mean_square: float  # of what it leaves over, over the noise
    values: np.ndarray  # (M, S, U) unknowns
    extra: np.ndarray  # (E,)


def quick_fit(
    measurement: Measurement, start: np.ndarray, terms: int, extra: Extra = nothing_free, rounds: int = 12
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
    with contextlib.suppress(np.linalg.LinAlgError, IdentifiabilityError):
        linear = linear_start(measurement, members, scale)
        begins += [linear] if linear is not None and np.isfinite(linear).all() else []
    fits = [_minimise(measurement, begin, scale, functions, extra, rounds) for begin in begins]
    return min(fits, key=lambda fitted: fitted.mean_square)


def _within_reason(measurement: Measurement, start: np.ndarray, ran_away: float = 1e4) -> tuple[np.ndarray, np.ndarray]:
    """The start, and its sizes (M, U); the guess takes the place of what ran away in a fit of wrong readings."""
    guess = measurement.guess.sizes(measurement.unknowns)
    size = np.median(np.abs(start), axis=1)
    fine = (size < ran_away * guess) & (size > guess / ran_away)
    return np.where(fine[:, None], start, guess[:, None]), np.where(fine, size, guess)


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
    extra: Extra,
    rounds: int,
    longest: float = 1.0,
    still: float = 1e-3,
    most_damping: float = 1e8,
) -> QuickFit:
    """Levenberg and Marquardt: steps of a weight are ``longest`` at most; it ends where the loss falls by a share
    below ``still``, or where nothing but ``most_damping`` lowers it."""
    problem = _Problem(measurement, scale, functions, extra)
    weights = problem.weights_of(start)
    damping = 1e-3
    loss, normal, right = problem.normal(weights)
    for _ in range(rounds):
        size = np.maximum(np.diag(normal), 1e-12 * np.diag(normal).max() + 1e-300)
        step = np.linalg.solve(normal + damping * np.diag(size), right)
        tried = weights + np.clip(step, -longest, longest)
        new, *rest = problem.normal(tried)
        if np.isfinite(new) and new < loss:
            small = new > (1 - still) * loss
            weights, loss, damping = tried, new, damping / 5
            normal, right = rest
            if small:
                break
        else:
            damping *= 10
            if damping > most_damping:
                break
    count = measurement.dataset.displacement.size
    n_coefficients = len(weights) - problem.n_extra
    return QuickFit(loss / count, problem.values(weights), weights[n_coefficients:])


class _Problem:
    """Residuals over the noise, and their normal equations.

    A direct coefficient is held above ``least``, as a share of its size, and its logarithm within ``widest``.
    """

    least, widest = 1e-3, 12.0

    def __init__(self, measurement: Measurement, scale: np.ndarray, functions: np.ndarray, extra: Extra) -> None:
        self.measurement, self.functions, self.extra = measurement, functions, extra
        active = measurement.unknowns.active
        self.scale = np.array([scale[m, u] for m, u in active])
        self.positive = np.array([is_direct(measurement.unknowns.names[u]) for _, u in active])
        self.n_extra = extra(np.zeros_like(measurement.dataset.displacement)).shape[-1]

    def weights_of(self, values: np.ndarray) -> np.ndarray:
        """(A K + E,) nearest to unknowns (M, S, U)."""
        every = np.stack([values[m, :, u] for m, u in self.measurement.unknowns.active], axis=1)
        raw = outputs_of(every, self.scale, self.positive, self.least)
        solution = np.linalg.lstsq(self.functions, raw, rcond=None)[0].T
        return np.concatenate([solution.ravel(), np.zeros(self.n_extra)])

    def _outputs(self, weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(S, A) unknowns and their slope by the raw outputs."""
        count = len(weights) - self.n_extra
        raw = self.functions @ weights[:count].reshape(len(self.scale), -1).T
        held = np.where(self.positive, np.clip(raw, -self.widest, self.widest), raw)
        return scale_outputs(held, self.scale, self.positive)

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
            by_unknown = ReadingSlopes(measurement, bearings).by_unknown * slope[:, None, None]
        rows, more = np.einsum("spra,sk->sprak", by_unknown, self.functions), self.extra(predicted)
        predicted = predicted + more @ weights[len(weights) - self.n_extra :]
        left = (measurement.dataset.displacement - predicted) / measurement.deviation
        more = (more / measurement.deviation[..., None]).reshape(left.size, -1)
        rows = np.concatenate([rows.reshape(left.size, -1), more], axis=-1)
        flat = left.ravel()
        if not (np.isfinite(flat).all() and np.isfinite(rows).all()):
            return np.inf, np.eye(len(weights)), np.zeros(len(weights))
        normal = (rows.conj().T @ rows).real
        return float((np.abs(flat) ** 2).sum()), normal, (rows.conj().T @ flat).real
