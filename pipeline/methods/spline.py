"""Output error with a cubic spline of the speed in place of the network: the fair competitor of the output error.

Each unknown (its logarithm, where it must be positive) is a spline of the logarithm of the speed. Predicted less
measured displacements over their noise, as :class:`pipeline.identification.problem.OutputError` has them, are minimised
by SciPy's least squares. The number of spline coefficients grows until Akaike's criterion rises (Akaike 1974). A
residual unbalance is fitted with them.

Legend: M members, S speeds, U unknowns, A active unknowns, K spline coefficients of each, N balance planes, Z = A K +
2 N numbers.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.coefficients import is_direct
from pipeline.identification.blocks import Basis
from pipeline.identification.inputs import SPEED
from pipeline.identification.model import CoefficientModel
from pipeline.identification.problem import OutputError, output_error
from pipeline.identification.selection import revive
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
from pipeline.problem.measurement import Measurement
from pipeline.problem.slopes import deviate
from pipeline.unknowns import outputs_of

if TYPE_CHECKING:
    import torch

GROWTH = (1, 2, 4, 6, 9, 13, 19, 28, 41)
"""Spline coefficients an unknown: a constant, a power law, cubic splines; the last size is a value for each speed."""


@dataclass(frozen=True, eq=False)
class _Fit:
    problem: OutputError
    weights: torch.Tensor  # (1, 1, Z)
    chi_square: float

    @property
    def outputs(self) -> np.ndarray:
        """(S, A) what the spline is of each unknown."""
        return self.problem.measurement.unknowns.to_active(self.problem.outputs(self.weights)[0].numpy())

    @property
    def pairs(self) -> np.ndarray:
        """(2 N,) real and imaginary parts of the residual unbalance."""
        return np.asarray(self.weights[0, 0, self.problem.places.planes].numpy())

    @property
    def criterion(self) -> float:
        """Akaike's criterion."""
        return self.chi_square + 2 * self.problem.places.size


def identify_by_spline(task: Measurement, options: MethodOptions, look_ahead: int = 2) -> Estimate:
    """The spline of the size that Akaike's criterion chooses, and its Cramer-Rao deviations.

    So many sizes in a row without a better criterion end the growth. Raises Refusal.
    """
    require_determined(task.subtract_unbalance(), together=True)
    fits = [_choose_start(*_list_starts(task, options), options.constant)]
    n_speeds = len(task.dataset.speeds)
    for count in [] if options.constant else [*(k for k in GROWTH[1:] if k < n_speeds), n_speeds]:
        fits.append(_improve(fits[-1].problem, count, fits[-1].outputs, fits[-1].pairs))
        best = min(fits, key=lambda fit: fit.criterion)
        if len(fits) - 1 - fits.index(best) >= look_ahead:
            break
    best = min(fits, key=lambda fit: fit.criterion)
    # Weights from the predicted readings: the measured ones share their noise, which biases.
    follow = best.problem.readings.follow(best.problem.predicted(best.weights))
    best = _fit(replace(best.problem, readings=follow), best.problem.features.shape[-1], best.outputs, best.pairs)
    problem, weights = best.problem, best.weights
    expected = problem.readings.size - problem.places.size
    text = f"{problem.places.size} numbers, chi-square {best.chi_square:.4g} where {expected} is expected"
    text += describe_unbalance(task.unknowns.planes, problem.unbalance(weights)[0].numpy())
    values, spread = problem.unknowns(weights)[0][0].numpy(), bound_deviation(problem, weights)
    every, deviation = task.unknowns.from_active(values), task.unknowns.from_active(spread)
    return make_estimate(task, every, deviation, text, doubt(best.chi_square / expected))


def _choose_start(
    problem: OutputError, starts: list[np.ndarray], constant: bool, kept: int = 3, sizes: int = 4
) -> _Fit:
    """Constants; where there are several starts, the one of the best ``kept`` that is best when it has grown to a small
    spline, of as many ``sizes``."""
    balanced = np.zeros(2 * problem.places.n_planes)
    made = sorted((_improve(problem, 1, x, balanced) for x in starts), key=lambda fit: fit.chi_square)
    if len(made) == 1 or constant:
        return made[0]

    def promise(fit: _Fit) -> float:
        for count in GROWTH[1:sizes]:
            fit = _improve(problem, count, fit.outputs, fit.pairs) if count < len(fit.outputs) else fit
        return fit.chi_square

    return min(made[:kept], key=promise)


def _list_starts(
    task: Measurement,
    options: MethodOptions,
    guesses: tuple[float, ...] = (0.03, 0.1, 0.3, 1.0, 3.0, 10.0, 30.0),
) -> tuple[OutputError, list[np.ndarray]]:
    """Constant outputs (S, A) to begin with: medians of a linear answer, or ``guesses`` times the configured guess."""
    positive = np.array([is_direct(name) for name in task.unknowns.names])
    try:
        linear = task.unknowns.leading(solve_total(drop_unbalance(task), options).coefficients.values)
    except (Refusal, np.linalg.LinAlgError):
        sizes = task.guess.sizes(task.unknowns)
        middles = [np.where(positive, guess * sizes, 0.0) for guess in guesses]
    else:
        middles = [np.median(linear, axis=1)]
        sizes = np.where(middles[0] != 0, np.abs(middles[0]), 1.0)
    problem, n_speeds = pose(task, sizes), len(task.dataset.speeds)
    each = (np.repeat(outputs_of(middle, sizes, positive)[:, None], n_speeds, axis=1) for middle in middles)
    return problem, [task.unknowns.to_active(outputs) for outputs in each]


def pose(task: Measurement, sizes: np.ndarray) -> OutputError:
    """The problem of constants: ``size exp(output)`` for a direct coefficient, ``size output`` for a cross-coupled one,
    of ``sizes`` (M, U)."""
    import torch

    scale = tuple(map(tuple, sizes.tolist()))
    model = CoefficientModel(
        unknowns=task.unknowns.names, inputs=(SPEED,), parametrisation="log", scale=scale, hidden=None
    )
    nothing = torch.zeros(sizes.shape, dtype=torch.float64)
    return output_error(task, Basis(model, nothing, torch.ones_like(nothing[:, :1, None]), 1), plane_scale=1e-4)


def enlarge(problem: OutputError, basis: np.ndarray) -> OutputError:
    """The same with functions (S, K) of the speed."""
    import torch

    count, features = basis.shape[1], torch.as_tensor(basis).expand(len(problem.scale), -1, -1)
    kept, precision = torch.ones(len(problem.active), count, dtype=torch.bool), torch.zeros(count, dtype=torch.float64)
    return replace(problem, features=features, kept=kept, precision=precision)


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


def _improve(problem: OutputError, count: int, start: np.ndarray, pairs: np.ndarray, vanished: float = 0.02) -> _Fit:
    """:func:`_fit`, once more where an unknown has all but ``vanished``, over its size: as an exponential, nothing
    draws it back."""
    fit = _fit(problem, count, start, pairs)
    revived = [replace(fit, weights=weights[None]) for weights in revive(fit.problem, fit.weights, vanished)]
    again = [_fit(problem, count, back.outputs, fit.pairs) for back in revived]
    return min([fit, *again], key=lambda tried: tried.chi_square)


def _fit(
    problem: OutputError, count: int, start: np.ndarray, pairs: np.ndarray, dense: int = 300, most: int = 60
) -> _Fit:
    """SciPy's trust-region least squares from the spline nearest to ``start`` (S, A), and the unbalance ``pairs``.

    Up to ``dense`` numbers SciPy factorises the Jacobian; beyond, it is sparse and iterated on. ``most`` evaluations.
    """
    import torch
    from scipy.optimize import least_squares

    basis = make_basis(problem.measurement.dataset.speeds, count)
    problem = enlarge(problem, basis)
    first = np.linalg.lstsq(basis, start, rcond=None)[0].T.ravel()
    large = first.size > dense

    @lru_cache(maxsize=1)  # the Jacobian is asked for where the residual was
    def differentiate_at(z: bytes) -> np.ndarray:
        # The triangle has the squares and products of each speed's rows, and as few of them as columns.
        return np.asarray(
            np.linalg.qr(differentiate(problem, torch.as_tensor(np.frombuffer(z).copy())[None, None]), mode="r")
        )

    def residual(z: np.ndarray) -> np.ndarray:
        return differentiate_at(z.tobytes())[..., -1].ravel()

    def jacobian(z: np.ndarray) -> Any:
        rows = _spread(differentiate_at(z.tobytes())[..., :-1], basis, len(pairs))
        return rows if large else rows.toarray()

    with np.errstate(over="ignore", invalid="ignore"):  # a step too far is taken back
        solution = least_squares(
            residual,
            np.concatenate([first, pairs]),
            jacobian,
            x_scale="jac",
            ftol=1e-12,
            xtol=1e-12,
            gtol=None,
            max_nfev=most,
            tr_solver="lsmr" if large else "exact",
        )
    return _Fit(problem, torch.as_tensor(solution.x)[None, None], 2 * float(solution.cost))


def differentiate(problem: OutputError, weights: torch.Tensor) -> np.ndarray:
    """(S, rows, A + 2 N + 1) derivative of each speed's rows by its outputs and by the unbalance, and the rows last."""
    import torch

    blocks = [torch.view_as_real(rows[0]).movedim(-1, 3).flatten(1, 3) for rows in problem._local(weights)]
    return np.asarray(torch.cat(blocks, dim=1).numpy())


def _spread(local: np.ndarray, basis: np.ndarray, n_pairs: int) -> Any:
    """(S rows, Z) sparse derivative by the weights, from that of each speed; a dense one would fill the memory."""
    from scipy.sparse import csr_array, hstack

    by_output, by_pairs = np.split(local, [local.shape[2] - n_pairs], axis=2)
    (n_speeds, n_rows, n_active), (speed, place) = by_output.shape, np.nonzero(basis)
    data = by_output[speed] * basis[speed, place][:, None, None]
    row = np.broadcast_to((speed[:, None] * n_rows + np.arange(n_rows))[..., None], data.shape)
    column = np.broadcast_to((place[:, None] + basis.shape[1] * np.arange(n_active))[:, None], data.shape)
    shape = (n_speeds * n_rows, n_active * basis.shape[1])
    spread = csr_array((data.ravel(), (row.ravel(), column.ravel())), shape=shape)
    return hstack([spread, csr_array(by_pairs.reshape(n_speeds * n_rows, n_pairs))], format="csr")


def bound_deviation(problem: OutputError, weights: torch.Tensor) -> np.ndarray:
    """(S, A) standard deviation of the active unknowns, N/m and N s/m, that of the unbalance allowed for."""
    n_active, features = len(problem.active), problem.features
    if features.shape[-1] < features.shape[-2]:
        return np.asarray(problem.unknown_deviation(weights)[0])
    # Every speed for itself: the covariance of all weights would fill the memory.
    local, slope = differentiate(problem, weights)[..., :-1], problem.unknowns(weights)[1][0].numpy()
    information = local.swapaxes(1, 2) @ local
    across, by_pairs = information[:, :n_active, n_active:], information[:, n_active:, n_active:].sum(axis=0)
    inverse = np.linalg.pinv(information[:, :n_active, :n_active], hermitian=True)
    carried = inverse @ across
    rest = np.linalg.pinv(by_pairs - (across.swapaxes(1, 2) @ carried).sum(axis=0), hermitian=True)
    return deviate(slope, inverse + carried @ rest @ carried.swapaxes(1, 2))
