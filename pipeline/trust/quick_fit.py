"""A fit in a tenth of a second, to compare explanations of the same readings.

Coefficients are few Chebyshev terms in the logarithm of the speed, direct ones their exponential; the start is linear
least squares, which no wrong guess misleads, and SciPy's least squares does the rest. Beside them are numbers
that an explanation leaves free, such as the size of one run's weight.

Legend: S speeds, P channels, R runs, A active unknowns, K functions, E free numbers. SI units.
"""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pipeline.coefficients import is_direct
from pipeline.errors import IdentifiabilityError
from pipeline.identification.linear_start import linear_start
from pipeline.problem.measurement import Measurement
from pipeline.problem.slopes import ReadingSlopes, stack_rows
from pipeline.unknowns import outputs_of, scale_outputs


@dataclass(frozen=True, eq=False)
class Free:
    """Numbers that an explanation leaves free, zero as stated: each adds to the readings in proportion to itself."""

    shares: np.ndarray  # (S, P, R, E) of the predicted readings
    shown: np.ndarray | float = 0.0  # (S, P, R, E) m, whatever is predicted

    def __len__(self) -> int:
        """E."""
        return int(self.shares.shape[-1])


NOTHING_FREE = Free(np.zeros((1, 1, 1, 0)))
"""What an explanation without free numbers has."""


@dataclass(frozen=True, eq=False)
class QuickFit:
    """The end of a quick fit."""

    mean_square: float  # of what it leaves over, over the noise
    values: np.ndarray  # (M, S, U) unknowns
    free: np.ndarray  # (E,)


def quick_fit(
    measurement: Measurement,
    starts: Sequence[np.ndarray],
    terms: int,
    free: Free = NOTHING_FREE,
    rounds: int = 20,
    still: float = 1e-3,
) -> QuickFit:
    """Fit the unknowns to the readings, from the best of ``starts`` and of a linear one, where the probes allow it.

    The fit ends where a step lowers the squares by a share below ``still``, or after so many ``rounds``.

    Args:
        starts: (M, S, U) unknowns to begin with as well, N/m and N s/m.
        terms: K; 1 for constants.
        free: what else is sought.
    """
    from scipy.optimize import least_squares

    functions = speed_functions(measurement, terms)
    begins, scales = zip(*(_within_reason(measurement, start) for start in starts), strict=True)
    members = np.broadcast_to(functions, (len(begins[0]), *functions.shape))
    with contextlib.suppress(np.linalg.LinAlgError, IdentifiabilityError):
        linear = linear_start(measurement, members, scales[0])
        begins += (linear,) if linear is not None and np.isfinite(linear).all() else ()
    problem = _Problem(measurement, scales[0], functions, free)
    begin = min(
        map(problem.weights_of, begins),
        key=lambda weights: np.nan_to_num((problem.rows(weights) ** 2).sum(), nan=np.inf),
    )
    end = least_squares(problem.rows, begin, problem.jacobian, x_scale="jac", ftol=still, max_nfev=rounds)
    square, count = 2 * end.cost, measurement.dataset.displacement.size
    return QuickFit(square / count, problem.values(end.x), end.x[len(end.x) - len(free) :])


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


class _Problem:
    """Residuals over the noise, and their derivative by the weights: A K, and E free numbers.

    A direct coefficient is held above ``least``, as a share of its size, and its logarithm within ``widest``.
    """

    least, widest = 1e-3, 12.0

    def __init__(self, measurement: Measurement, scale: np.ndarray, functions: np.ndarray, free: Free) -> None:
        self.measurement, self.functions, self.free = measurement, functions, free
        active = measurement.unknowns.active
        self.scale = np.array([scale[m, u] for m, u in active])
        self.positive = np.array([is_direct(measurement.unknowns.names[u]) for _, u in active])

    def weights_of(self, values: np.ndarray) -> np.ndarray:
        """(A K + E,) nearest to unknowns (M, S, U)."""
        raw = outputs_of(self.measurement.unknowns.to_active(values), self.scale, self.positive, self.least)
        solution = np.linalg.lstsq(self.functions, raw, rcond=None)[0].T
        return np.concatenate([solution.ravel(), np.zeros(len(self.free))])

    def _outputs(self, weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(S, A) unknowns and their slope by the raw outputs."""
        count = len(weights) - len(self.free)
        raw = self.functions @ weights[:count].reshape(len(self.scale), -1).T
        held = np.where(self.positive, np.clip(raw, -self.widest, self.widest), raw)
        return scale_outputs(held, self.scale, self.positive)

    def values(self, weights: np.ndarray) -> np.ndarray:
        """(M, S, U)."""
        return self.measurement.unknowns.from_active(self._outputs(weights)[0])

    def rows(self, weights: np.ndarray) -> np.ndarray:
        """(2 S P R,) predicted less measured readings."""
        data, numbers = self.measurement, weights[len(weights) - len(self.free) :]
        predicted = data.response.predict(data.table(self.values(weights)))
        expected = predicted + (predicted[..., None] * self.free.shares + self.free.shown) @ numbers
        return stack_rows((expected - data.dataset.displacement) / data.deviation).ravel()

    def jacobian(self, weights: np.ndarray) -> np.ndarray:
        """(2 S P R, A K + E)."""
        data, numbers = self.measurement, weights[len(weights) - len(self.free) :]
        bearings, slope = data.table(self.values(weights)), self._outputs(weights)[1]
        gain = 1 + self.free.shares @ numbers
        by_unknown = ReadingSlopes(data, bearings).by_unknown * slope[:, None, None] * gain[..., None]
        by_weight = np.einsum("spra,sk->sprak", by_unknown, self.functions).reshape(*by_unknown.shape[:3], -1)
        by_number = data.response.predict(bearings)[..., None] * self.free.shares + self.free.shown
        columns = np.concatenate([by_weight, by_number / data.deviation[..., None]], axis=-1)
        return stack_rows(columns).reshape(-1, len(weights))
