"""Output error with a cubic spline of the speed in place of the network: the fair competitor of the output error.

Each unknown (its logarithm, where it must be positive) is a spline of the logarithm of the speed. Predicted less
measured displacements over their noise are minimised by SciPy's least squares. The number of spline coefficients
grows until Akaike's criterion rises (Akaike 1974). A residual unbalance is fitted with them.

Legend: M members, S speeds, P channels, R runs, U unknowns, A active unknowns, K spline coefficients of each, N balance
planes.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from pipeline.methods.least_squares import solve_total
from pipeline.methods.method import (
    Estimate,
    MethodOptions,
    Refusal,
    describe_unbalance,
    doubt,
    drop_unbalance,
    make_estimate,
    require_determined,
)
from pipeline.methods.spline_problem import Parameters, SplineProblem, make_parameters
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
class _Fit:
    basis: np.ndarray  # (S, K)
    z: np.ndarray  # (K, A)
    pairs: np.ndarray  # (2 N,) real and imaginary parts of the residual unbalance
    chi_square: float

    @property
    def x(self) -> np.ndarray:
        """(S, A)."""
        return np.asarray(self.basis @ self.z)

    @property
    def criterion(self) -> float:
        """Akaike's criterion."""
        return self.chi_square + 2 * self.n_numbers

    @property
    def n_numbers(self) -> int:
        """K A + 2 N."""
        return self.z.size + self.pairs.size


def identify_by_spline(task: Measurement, options: MethodOptions) -> Estimate:
    """The spline of the size that Akaike's criterion chooses, and its Cramer-Rao deviations."""
    require_determined(task.subtract_unbalance(), together=True)
    parameters, starts = _list_starts(task, options)
    problem = SplineProblem(task, parameters, np.sqrt(2.0) / task.deviation)
    fits = [_choose_start(problem, starts, options.constant)]
    n_speeds = len(task.dataset.speeds)
    for count in [] if options.constant else [*(k for k in GROWTH[1:] if k < n_speeds), n_speeds]:
        fits.append(_improve(problem, count, fits[-1].x, fits[-1].pairs))
        best = min(fits, key=lambda fit: fit.criterion)
        if len(fits) - 1 - fits.index(best) >= _LOOK_AHEAD:
            break
    best = min(fits, key=lambda fit: fit.criterion)
    problem = problem.reweighted(best.x, best.pairs)
    best = _fit(problem, best.basis.shape[1], best.x, best.pairs)
    deviation = _bound_deviation(problem, best) * parameters.slope(best.x)
    expected = 2 * task.dataset.displacement.size - best.n_numbers
    text = f"{best.n_numbers} numbers, chi-square {best.chi_square:.4g} where {expected} is expected"
    text += describe_unbalance(task.unknowns.planes, parameters.unbalance(best.pairs))
    spread = task.unknowns.from_active(deviation)
    return make_estimate(task, parameters.values(best.x), spread, text, doubt(best.chi_square / expected))


def _choose_start(problem: SplineProblem, starts: list[np.ndarray], constant: bool) -> _Fit:
    """Constants; where there are several starts, the one that is best when it has become a small spline."""
    balanced = np.zeros(problem.n_pairs)
    made = sorted((_improve(problem, 1, x, balanced) for x in starts), key=lambda fit: fit.chi_square)
    if len(made) == 1 or constant:
        return made[0]

    def promise(fit: _Fit) -> float:
        for count in GROWTH[1:_SMALL]:
            fit = _improve(problem, count, fit.x, fit.pairs) if count < len(fit.x) else fit
        return fit.chi_square

    return min(made[:_KEPT_STARTS], key=promise)


def _list_starts(task: Measurement, options: MethodOptions) -> tuple[Parameters, list[np.ndarray]]:
    """Constants (S, A) to begin with: the medians of a linear answer, or the guess in several sizes."""
    n_speeds = len(task.dataset.speeds)
    try:
        linear = task.unknowns.leading(solve_total(drop_unbalance(task), options).coefficients.values)
    except (Refusal, np.linalg.LinAlgError):
        parameters = make_parameters(task)
        guess = np.repeat(task.guess.sizes(task.unknowns)[:, None], n_speeds, axis=1)
        return parameters, [
            np.where(parameters.positive, parameters.from_values(size * guess), 0.0) for size in GUESSES
        ]
    middle = np.median(linear, axis=1)
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


def _improve(problem: SplineProblem, count: int, start: np.ndarray, pairs: np.ndarray) -> _Fit:
    """:func:`_fit`, once more where an unknown has all but vanished: as an exponential, nothing draws it back."""
    fit = _fit(problem, count, start, pairs)
    x = fit.x
    gone = problem.parameters.positive & (np.median(x, axis=0) < np.log(_VANISHED))
    if not gone.any():
        return fit
    return min(fit, _fit(problem, count, np.where(gone, 0.0, x), fit.pairs), key=lambda tried: tried.chi_square)


def _fit(problem: SplineProblem, count: int, start: np.ndarray, pairs: np.ndarray) -> _Fit:
    """SciPy's trust-region least squares from the spline nearest to ``start`` (S, A), and the unbalance ``pairs``."""
    from scipy.optimize import least_squares

    basis = make_basis(problem.task.dataset.speeds, count)
    first = np.linalg.lstsq(basis, start, rcond=None)[0]
    large = first.size > _DENSE

    def split(z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return basis @ z[: first.size].reshape(first.shape), z[first.size :]

    def residual(z: np.ndarray) -> np.ndarray:
        return problem.deviations(*split(z)).ravel()

    def jacobian(z: np.ndarray) -> Any:
        by_speed = problem.sensitivity(*split(z))
        by_x, by_pairs = np.split(by_speed, [first.shape[1]], axis=2)
        return _make_sparse(by_x, basis, by_pairs) if large else _make_dense(by_x, basis, by_pairs)

    with np.errstate(over="ignore", invalid="ignore"):  # a step too far is taken back
        solution = least_squares(
            residual,
            np.concatenate([first.ravel(), pairs]),
            jacobian,
            x_scale="jac",
            ftol=1e-12,
            xtol=1e-12,
            gtol=None,
            max_nfev=_MOST_EVALUATIONS,
            tr_solver="lsmr" if large else "exact",
        )
    z, rest = np.split(solution.x, [first.size])
    return _Fit(basis, z.reshape(first.shape), rest, 2 * float(solution.cost))


def _make_dense(by_x: np.ndarray, basis: np.ndarray, by_pairs: np.ndarray) -> np.ndarray:
    """(S rows, K A + 2 N) derivative by the spline's coefficients and the unbalance."""
    n_rows = by_x.shape[0] * by_x.shape[1]
    spread = np.einsum("sra,sk->srka", by_x, basis).reshape(n_rows, -1)
    return np.concatenate([spread, by_pairs.reshape(n_rows, -1)], axis=1)


def _make_sparse(by_x: np.ndarray, basis: np.ndarray, by_pairs: np.ndarray) -> Any:
    """:func:`_make_dense`, without its zeros."""
    from scipy.sparse import csr_array, hstack

    n_speeds, n_rows, n_active = by_x.shape
    speed, place = np.nonzero(basis)
    data = by_x[speed] * basis[speed, place][:, None, None]
    row = np.broadcast_to((speed[:, None] * n_rows + np.arange(n_rows))[..., None], data.shape)
    column = np.broadcast_to((place[:, None] * n_active + np.arange(n_active))[:, None], data.shape)
    shape = (n_speeds * n_rows, basis.shape[1] * n_active)
    spread = csr_array((data.ravel(), (row.ravel(), column.ravel())), shape=shape)
    if not by_pairs.shape[2]:
        return spread
    return hstack([spread, csr_array(by_pairs.reshape(n_speeds * n_rows, -1))], format="csr")


def _bound_deviation(problem: SplineProblem, fit: _Fit) -> np.ndarray:
    """(S, A) standard deviation of x, that of the unbalance allowed for."""
    count, active = fit.z.shape
    rows = problem.sensitivity(fit.x, fit.pairs)
    local = rows.swapaxes(1, 2) @ rows  # (S, A + 2 N, A + 2 N)
    by_x, across = local[:, :active, :active], local[:, :active, active:]
    by_pairs = local[:, active:, active:].sum(axis=0)
    if count == len(fit.basis):  # every speed for itself
        inverse = np.linalg.pinv(by_x, hermitian=True)
        carried = inverse @ across
        rest = np.linalg.pinv(by_pairs - (across.swapaxes(1, 2) @ carried).sum(axis=0), hermitian=True)
        spread = inverse + carried @ rest @ carried.swapaxes(1, 2)
        return np.sqrt(np.maximum(np.einsum("saa->sa", spread), 0.0))
    basis = fit.basis
    outer = np.einsum("sk,sab,sl->kalb", basis, by_x, basis, optimize=True).reshape(fit.z.size, fit.z.size)
    border = np.einsum("sk,san->kan", basis, across).reshape(fit.z.size, -1)
    whole = np.linalg.pinv(np.block([[outer, border], [border.T, by_pairs]]), hermitian=True)
    covariance = whole[: fit.z.size, : fit.z.size].reshape(count, active, count, active)
    spread = np.einsum("sk,kala,sl->sa", basis, covariance, basis, optimize=True)
    return np.sqrt(np.maximum(spread, 0.0))
