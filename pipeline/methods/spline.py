"""Output error with a cubic spline of the speed in place of the network: the fair competitor of the output error.

Each unknown (its logarithm, where it must be positive) is a spline of the logarithm of the speed. Predicted less
measured displacements over their noise are minimised by SciPy's least squares. The number of spline coefficients
grows until Akaike's criterion rises (Akaike 1974).

Legend: M members, S speeds, P channels, R runs, U unknowns, A active unknowns, K spline coefficients of each.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from pipeline.coefficients import is_direct
from pipeline.methods.least_squares import solve_total
from pipeline.methods.method import (
    Estimate,
    MethodOptions,
    Refusal,
    differentiate_response,
    doubt,
    make_estimate,
    require_determined,
    stack_rows,
)
from pipeline.problem.measurement import Measurement

GROWTH = (1, 2, 4, 6, 9, 13, 19, 28, 41)
"""Spline coefficients an unknown: a constant, a power law, cubic splines; the last size is a value for each speed."""
GUESSES = (0.03, 0.1, 0.3, 1.0, 3.0, 10.0, 30.0)
"""Where there is no linear answer to begin with, the configured guess is tried in these sizes."""
_LOOK_AHEAD = 2
"""So many sizes in a row without a better criterion end the growth."""
_MOST_EVALUATIONS = 60
_DENSE = 300
"""Up to so many numbers SciPy factorises the Jacobian; beyond, it is sparse and iterated on."""
_KEPT_STARTS, _SMALL = 3, 4
_VANISHED = 0.02
"""An unknown below this share of its size has vanished."""


@dataclass(frozen=True, eq=False)
class Parameters:
    """x (S, A) stands for ``size exp(x)`` of a direct coefficient, ``size x`` of a cross-coupled one."""

    task: Measurement
    size: np.ndarray  # (A,) N/m and N s/m
    positive: np.ndarray  # (A,)

    def values(self, x: np.ndarray) -> np.ndarray:
        """(M, S, U) unknowns."""
        return self.task.unknowns.from_active(np.where(self.positive, self.slope(x), self.size * x))

    def from_values(self, values: np.ndarray) -> np.ndarray:
        """(S, A) from unknowns (M, S, U); what must be positive is kept above a thousandth of its size."""
        columns = []
        for a, (m, u) in enumerate(self.task.unknowns.active):
            own = values[m, :, u] / self.size[a]
            columns.append(np.log(np.maximum(own, _SMALLEST)) if self.positive[a] else own)
        return np.stack(columns, axis=1)

    def slope(self, x: np.ndarray) -> np.ndarray:
        """(S, A) derivative of the unknowns by x."""
        return np.asarray(self.size * np.where(self.positive, np.exp(np.where(self.positive, x, 0.0)), 1.0))

    def predict(self, x: np.ndarray) -> np.ndarray:
        """(S, P, R) m, the response."""
        return self.task.response.predict(self.task.table(self.values(x)))

    def sensitivity(self, x: np.ndarray) -> np.ndarray:
        """(S, P, R, A) derivative of the response by x."""
        return differentiate_response(self.task, self.values(x)) * self.slope(x)[:, None, None]


_SMALLEST = 1e-3


def make_parameters(task: Measurement, size: np.ndarray | None = None) -> Parameters:
    """The free numbers, with sizes (M, U) of the unknowns or the configured guesses."""
    of = task.guess.sizes(task.unknowns) if size is None else size
    return Parameters(
        task,
        np.array([of[m, u] for m, u in task.unknowns.active]),
        np.array([is_direct(task.unknowns.names[u]) for _, u in task.unknowns.active]),
    )


@dataclass(frozen=True, eq=False)
class _Problem:
    """What does not change with the size of the spline."""

    task: Measurement
    parameters: Parameters
    weight: np.ndarray  # (S, P, R) 1/m: root of 2 over the deviation, so that real and imaginary part count

    def deviations(self, x: np.ndarray) -> np.ndarray:
        """(S, rows) whitened, for x (S, A)."""
        return stack_rows((self.parameters.predict(x) - self.task.dataset.displacement) * self.weight)

    def sensitivity(self, x: np.ndarray) -> np.ndarray:
        """(S, rows, A) derivative of :meth:`deviations` by x."""
        return stack_rows(self.parameters.sensitivity(x) * self.weight[..., None])

    def reweighted(self, x: np.ndarray) -> _Problem:
        """The same with weights from the predicted readings: the measured ones share their noise, which biases."""
        deviation = self.task.deviation_of(self.parameters.predict(x), self.task.dataset.subtracted)
        return replace(self, weight=np.sqrt(2.0) / deviation)


@dataclass(frozen=True, eq=False)
class _Fit:
    basis: np.ndarray  # (S, K)
    z: np.ndarray  # (K, A)
    chi_square: float

    @property
    def x(self) -> np.ndarray:
        """(S, A)."""
        return np.asarray(self.basis @ self.z)

    @property
    def criterion(self) -> float:
        """Akaike's criterion."""
        return self.chi_square + 2 * self.z.size


def identify_by_spline(task: Measurement, options: MethodOptions) -> Estimate:
    """The spline of the size that Akaike's criterion chooses, and its Cramer-Rao deviations."""
    require_determined(task, together=True)
    parameters, starts = _list_starts(task, options)
    problem = _Problem(task, parameters, np.sqrt(2.0) / task.deviation)
    fits = [_choose_start(problem, starts, options.constant)]
    n_speeds = len(task.dataset.speeds)
    for count in [] if options.constant else [*(k for k in GROWTH[1:] if k < n_speeds), n_speeds]:
        fits.append(_improve(problem, count, fits[-1].x))
        best = min(fits, key=lambda fit: fit.criterion)
        if len(fits) - 1 - fits.index(best) >= _LOOK_AHEAD:
            break
    best = min(fits, key=lambda fit: fit.criterion)
    problem = problem.reweighted(best.x)
    best = _fit(problem, best.basis.shape[1], best.x)
    deviation = _bound_deviation(problem, best) * parameters.slope(best.x)
    expected = 2 * task.dataset.displacement.size - best.z.size
    words = f"{best.z.size} numbers, chi-square {best.chi_square:.4g} where {expected} is expected"
    spread = task.unknowns.from_active(deviation)
    return make_estimate(task, parameters.values(best.x), spread, words, doubt(best.chi_square / expected))


def _choose_start(problem: _Problem, starts: list[np.ndarray], constant: bool) -> _Fit:
    """Constants; where there are several starts, the one that is best when it has become a small spline."""
    made = sorted((_improve(problem, 1, x) for x in starts), key=lambda fit: fit.chi_square)
    if len(made) == 1 or constant:
        return made[0]

    def promise(fit: _Fit) -> float:
        x = fit.x
        for count in GROWTH[1:_SMALL]:
            x = _improve(problem, count, x).x if count < len(x) else x
        return float((problem.deviations(x) ** 2).sum())

    return min(made[:_KEPT_STARTS], key=promise)


def _list_starts(task: Measurement, options: MethodOptions) -> tuple[Parameters, list[np.ndarray]]:
    """Constants (S, A) to begin with: the medians of a linear answer, or the guess in several sizes."""
    n_speeds = len(task.dataset.speeds)
    try:
        found = task.unknowns.leading(solve_total(task, options).coefficients.values)
    except (Refusal, np.linalg.LinAlgError):
        parameters = make_parameters(task)
        guess = np.repeat(task.guess.sizes(task.unknowns)[:, None], n_speeds, axis=1)
        return parameters, [
            np.where(parameters.positive, parameters.from_values(size * guess), 0.0) for size in GUESSES
        ]
    middle = np.median(found, axis=1)
    parameters = make_parameters(task, np.where(middle != 0, np.abs(middle), 1.0))
    return parameters, [np.repeat(parameters.from_values(middle[:, None]), n_speeds, axis=0)]


def make_basis(speeds: np.ndarray, count: int) -> np.ndarray:
    """(S, K) cubic splines of the logarithm of the speed; as many as speeds are a value for each."""
    from scipy.interpolate import BSpline

    if count == len(speeds):
        return np.eye(count)
    place = np.log(speeds)
    if count <= 2:
        return np.stack([np.ones(len(speeds)), place - place.mean()], axis=1)[:, :count]
    # Half way between knots even in the logarithm, as fluid films are, and even in the speeds, as the data are.
    share = np.linspace(0, 1, count - 2)
    even = place[0] + share * (place[-1] - place[0])
    inner = (0.5 * (even + np.quantile(place, share)))[1:-1]
    knots = np.concatenate([[place[0]] * 4, inner, [place[-1]] * 4])
    return np.asarray(BSpline.design_matrix(place, knots, 3).toarray())


def _improve(problem: _Problem, count: int, start: np.ndarray) -> _Fit:
    """:func:`_fit`, once more where an unknown has all but vanished: as an exponential, nothing draws it back."""
    fit = _fit(problem, count, start)
    x = fit.x
    gone = problem.parameters.positive & (np.median(x, axis=0) < np.log(_VANISHED))
    if not gone.any():
        return fit
    return min(fit, _fit(problem, count, np.where(gone, 0.0, x)), key=lambda one: one.chi_square)


def _fit(problem: _Problem, count: int, start: np.ndarray) -> _Fit:
    """SciPy's trust-region least squares from the spline nearest to ``start`` (S, A)."""
    from scipy.optimize import least_squares

    own = make_basis(problem.task.dataset.speeds, count)
    first = np.linalg.lstsq(own, start, rcond=None)[0]
    large = first.size > _DENSE

    def residual(z: np.ndarray) -> np.ndarray:
        return problem.deviations(own @ z.reshape(first.shape)).ravel()

    def jacobian(z: np.ndarray) -> Any:
        by_speed = problem.sensitivity(own @ z.reshape(first.shape))
        return _make_sparse(by_speed, own) if large else _make_dense(by_speed, own)

    with np.errstate(over="ignore", invalid="ignore"):  # a step too far is taken back
        found = least_squares(
            residual,
            first.ravel(),
            jacobian,
            x_scale="jac",
            ftol=1e-12,
            xtol=1e-12,
            gtol=None,
            max_nfev=_MOST_EVALUATIONS,
            tr_solver="lsmr" if large else "exact",
        )
    return _Fit(own, found.x.reshape(first.shape), 2 * float(found.cost))


def _make_dense(by_speed: np.ndarray, own: np.ndarray) -> np.ndarray:
    """(S rows, K A) derivative by the spline's coefficients."""
    return np.einsum("sra,sk->srka", by_speed, own).reshape(by_speed.shape[0] * by_speed.shape[1], -1)


def _make_sparse(by_speed: np.ndarray, own: np.ndarray) -> Any:
    """:func:`_make_dense`, without its zeros."""
    from scipy.sparse import csr_array

    n_speeds, n_rows, n_active = by_speed.shape
    speed, place = np.nonzero(own)
    data = by_speed[speed] * own[speed, place][:, None, None]
    row = np.broadcast_to((speed[:, None] * n_rows + np.arange(n_rows))[..., None], data.shape)
    column = np.broadcast_to((place[:, None] * n_active + np.arange(n_active))[:, None], data.shape)
    shape = (n_speeds * n_rows, own.shape[1] * n_active)
    return csr_array((data.ravel(), (row.ravel(), column.ravel())), shape=shape)


def _sum_information(problem: _Problem, fit: _Fit) -> np.ndarray:
    """(K A, K A) information of the spline coefficients."""
    local = problem.sensitivity(fit.x)
    local = local.swapaxes(1, 2) @ local
    own = fit.basis
    return np.einsum("sk,sab,sl->kalb", own, local, own, optimize=True).reshape(fit.z.size, fit.z.size)


def _bound_deviation(problem: _Problem, fit: _Fit) -> np.ndarray:
    """(S, A) standard deviation of x."""
    count, active = fit.z.shape
    if count == len(fit.basis):  # every speed for itself
        rows = problem.sensitivity(fit.x)
        spread = np.linalg.pinv(rows.swapaxes(1, 2) @ rows, hermitian=True)
        return np.sqrt(np.maximum(np.einsum("saa->sa", spread), 0.0))
    covariance = np.linalg.pinv(_sum_information(problem, fit), hermitian=True).reshape(count, active, count, active)
    spread = np.einsum("sk,kala,sl->sa", fit.basis, covariance, fit.basis, optimize=True)
    return np.sqrt(np.maximum(spread, 0.0))
