"""Output error with a cubic spline of the speed in place of the network: the fair competitor of the output error.

Each unknown (its logarithm, where it must be positive) is a spline of the logarithm of the speed. Predicted less
measured displacements over their noise are minimised by SciPy's least squares. The number of spline coefficients
grows until Akaike's criterion rises (Akaike 1974). A residual unbalance is fitted with them.

Legend: M members, S speeds, P channels, R runs, U unknowns, A active unknowns, K spline coefficients of each, N balance
planes.
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
    describe_unbalance,
    differentiate_response,
    doubt,
    drop_unbalance,
    make_estimate,
    require_determined,
    stack_rows,
)
from pipeline.problem.measurement import Measurement
from pipeline.unknowns import outputs_of, scale_outputs

GROWTH = (1, 2, 4, 6, 9, 13, 19, 28, 41)
"""Spline coefficients an unknown: a constant, a power law, cubic splines; the last size is a value for each speed."""


@dataclass(frozen=True, eq=False)
class SplineProblem:
    """What is fitted, whatever the size of the spline: free numbers of each speed, and how far the readings are off.

    x (S, A) stands for ``size exp(x)`` of a direct coefficient, ``size x`` of a cross-coupled one; pairs (2 N,) for the
    real and imaginary parts of the residual unbalance.
    """

    task: Measurement
    size: np.ndarray  # (A,) N/m and N s/m
    positive: np.ndarray  # (A,)
    weight: np.ndarray  # (S, P, R) 1/m: root of 2 over the deviation, so that real and imaginary part count
    unit: float = 1e-4  # kg m, in which a residual unbalance is sought

    def values(self, x: np.ndarray) -> np.ndarray:
        """(M, S, U) unknowns."""
        return self.task.unknowns.from_active(scale_outputs(x, self.size, self.positive)[0])

    def from_values(self, values: np.ndarray, least: float = 1e-3) -> np.ndarray:
        """(S, A) from unknowns (M, S, U); what must be positive is kept above the share ``least`` of its size."""
        every = np.stack([values[m, :, u] for m, u in self.task.unknowns.active], axis=1)
        return np.asarray(outputs_of(every, self.size, self.positive, least))

    def slope(self, x: np.ndarray) -> np.ndarray:
        """(S, A) derivative of the unknowns by x."""
        return np.asarray(np.broadcast_to(scale_outputs(x, self.size, self.positive)[1], x.shape))

    def unbalance(self, pairs: np.ndarray) -> np.ndarray:
        """(N,) complex kg m, from real and imaginary parts (2 N,)."""
        return np.asarray(self.unit * (pairs[::2] + 1j * pairs[1::2]))

    def predict(self, x: np.ndarray, pairs: np.ndarray) -> np.ndarray:
        """(S, P, R) m, the response."""
        return self.task.response.predict(self.task.table(self.values(x)), self.unbalance(pairs))

    def deviations(self, x: np.ndarray, pairs: np.ndarray) -> np.ndarray:
        """(S, rows) whitened, for x (S, A) and the residual unbalance (2 N,)."""
        return stack_rows((self.predict(x, pairs) - self.task.dataset.displacement) * self.weight)

    def sensitivity(self, x: np.ndarray, pairs: np.ndarray) -> np.ndarray:
        """(S, rows, A + 2 N) derivative of :meth:`deviations` by x and by the unbalance."""
        values = self.values(x)
        by_x = differentiate_response(self.task, values, self.unbalance(pairs)) * self.slope(x)[:, None, None]
        unit = self.unit * self.task.response.derive_by_unbalance(self.task.table(values))
        by_pairs = np.stack([unit, 1j * unit], axis=-1).reshape(*unit.shape[:-1], -1)
        return stack_rows(np.concatenate([by_x, by_pairs], axis=-1) * self.weight[..., None])

    def reweighted(self, x: np.ndarray, pairs: np.ndarray) -> SplineProblem:
        """The same with weights from the predicted readings: the measured ones share their noise, which biases."""
        deviation = self.task.deviation_of(self.predict(x, pairs), self.task.baseline)
        return replace(self, weight=np.sqrt(2.0) / deviation)


def pose(task: Measurement, sizes: np.ndarray) -> SplineProblem:
    """The problem with unknowns of these ``sizes`` (M, U)."""
    active = task.unknowns.active
    size = np.array([sizes[m, u] for m, u in active])
    positive = np.array([is_direct(task.unknowns.names[u]) for _, u in active])
    return SplineProblem(task, size, positive, np.sqrt(2.0) / task.deviation)


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


def identify_by_spline(task: Measurement, options: MethodOptions, look_ahead: int = 2) -> Estimate:
    """The spline of the size that Akaike's criterion chooses, and its Cramer-Rao deviations.

    So many sizes in a row without a better criterion end the growth. Raises Refusal.
    """
    require_determined(task.subtract_unbalance(), together=True)
    problem, starts = _list_starts(task, options)
    fits = [_choose_start(problem, starts, options.constant)]
    n_speeds = len(task.dataset.speeds)
    for count in [] if options.constant else [*(k for k in GROWTH[1:] if k < n_speeds), n_speeds]:
        fits.append(_improve(problem, count, fits[-1].x, fits[-1].pairs))
        best = min(fits, key=lambda fit: fit.criterion)
        if len(fits) - 1 - fits.index(best) >= look_ahead:
            break
    best = min(fits, key=lambda fit: fit.criterion)
    problem = problem.reweighted(best.x, best.pairs)
    best = _fit(problem, best.basis.shape[1], best.x, best.pairs)
    deviation = _bound_deviation(problem, best) * problem.slope(best.x)
    expected = 2 * task.dataset.displacement.size - best.n_numbers
    text = f"{best.n_numbers} numbers, chi-square {best.chi_square:.4g} where {expected} is expected"
    text += describe_unbalance(task.unknowns.planes, problem.unbalance(best.pairs))
    spread = task.unknowns.from_active(deviation)
    return make_estimate(task, problem.values(best.x), spread, text, doubt(best.chi_square / expected))


def _choose_start(
    problem: SplineProblem, starts: list[np.ndarray], constant: bool, kept: int = 3, sizes: int = 4
) -> _Fit:
    """Constants; where there are several starts, the one of the best ``kept`` that is best when it has grown to a small
    spline, of as many ``sizes``."""
    balanced = np.zeros(2 * len(problem.task.unknowns.planes))
    made = sorted((_improve(problem, 1, x, balanced) for x in starts), key=lambda fit: fit.chi_square)
    if len(made) == 1 or constant:
        return made[0]

    def promise(fit: _Fit) -> float:
        for count in GROWTH[1:sizes]:
            fit = _improve(problem, count, fit.x, fit.pairs) if count < len(fit.x) else fit
        return fit.chi_square

    return min(made[:kept], key=promise)


def _list_starts(
    task: Measurement,
    options: MethodOptions,
    guesses: tuple[float, ...] = (0.03, 0.1, 0.3, 1.0, 3.0, 10.0, 30.0),
) -> tuple[SplineProblem, list[np.ndarray]]:
    """Constants (S, A) to begin with: the medians of a linear answer, or ``guesses`` times the configured guess."""
    n_speeds = len(task.dataset.speeds)
    try:
        linear = task.unknowns.leading(solve_total(drop_unbalance(task), options).coefficients.values)
    except (Refusal, np.linalg.LinAlgError):
        sizes = task.guess.sizes(task.unknowns)
        problem, guess = pose(task, sizes), np.repeat(sizes[:, None], n_speeds, axis=1)
        return problem, [np.where(problem.positive, problem.from_values(size * guess), 0.0) for size in guesses]
    middle = np.median(linear, axis=1)
    problem = pose(task, np.where(middle != 0, np.abs(middle), 1.0))
    return problem, [np.repeat(problem.from_values(middle[:, None]), n_speeds, axis=0)]


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


def _improve(problem: SplineProblem, count: int, start: np.ndarray, pairs: np.ndarray, vanished: float = 0.02) -> _Fit:
    """:func:`_fit`, once more where an unknown has all but ``vanished``, over its size: as an exponential, nothing
    draws it back."""
    fit = _fit(problem, count, start, pairs)
    x = fit.x
    gone = problem.positive & (np.median(x, axis=0) < np.log(vanished))
    if not gone.any():
        return fit
    return min(fit, _fit(problem, count, np.where(gone, 0.0, x), fit.pairs), key=lambda tried: tried.chi_square)


def _fit(
    problem: SplineProblem, count: int, start: np.ndarray, pairs: np.ndarray, dense: int = 300, most: int = 60
) -> _Fit:
    """SciPy's trust-region least squares from the spline nearest to ``start`` (S, A), and the unbalance ``pairs``.

    Up to ``dense`` numbers SciPy factorises the Jacobian; beyond, it is sparse and iterated on. ``most`` evaluations.
    """
    from scipy.optimize import least_squares

    basis = make_basis(problem.task.dataset.speeds, count)
    first = np.linalg.lstsq(basis, start, rcond=None)[0]
    large = first.size > dense

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
            max_nfev=most,
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
