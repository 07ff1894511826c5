"""Least squares at each speed by itself, on a flexible shaft: plain, regularised, consistent, smoothed, filtered.

Smoothed is what an engineer would do. The answer of each speed is that of least squares with expansion, and its weight
what the readings' noise leaves of it. Each unknown is divided by the power law of the speed that is nearest to it, and
a natural cubic smoothing spline of the logarithm of the speed (Reinsch 1967) goes through what is left. Generalised
cross-validation chooses how smooth it is (Craven and Wahba 1979), and the deviation is Wahba's (1983), which allows for
what the smoothing hides.

Filtered is Kalman's measurement update at each frequency, then least squares (after Kang, Shi, Zhang, Zhen and Gu
2020). It is no filter that follows a signal in time: the motion is stationary, its state are complex amplitudes, and
each speed is solved by itself, with a prior of the bearing forces (:mod:`pipeline.problem.expansion`).

Legend: M members (bearings, or 1 where they share their coefficients), S speeds, R runs, P channels, U unknowns, A
those of them that members have.
"""

from __future__ import annotations

import numpy as np

from pipeline.methods.method import (
    Estimate,
    MethodOptions,
    Refusal,
    describe_sensors,
    make_estimate,
    refuse_undetermined,
    require_determined,
    require_residual,
)
from pipeline.problem.expansion import expand, filter_bearings, update_unknowns
from pipeline.problem.identifiability import judge_identifiability
from pipeline.problem.measurement import Measurement
from pipeline.problem.noise import (
    bearing_rows,
    least_squares_deviation,
    linear_deviation,
    lower_root,
    member_rows,
    residual_sensitivity,
    whiten,
)
from pipeline.problem.residual import LinearResidual, decompose_columns, linear_residual, per_speed_least_squares


def solve_plain(data: Measurement, options: MethodOptions) -> Estimate:
    """Tiwari, Lees and Friswell (2002): minimise the residual ``|A p + y|`` of each speed.

    Noise in the displacements is in A, too, which biases the answer (errors in variables).
    """
    members = require_residual(data, options).by_member()
    values = per_speed_least_squares(members)
    return make_estimate(
        data, values, _propagate_noise(data, values, _invert(members, np.zeros(members.matrix.shape[:2])))
    )


def solve_tikhonov(data: Measurement, options: MethodOptions, weakest: float = 1e-8, strengths: int = 65) -> Estimate:
    """The same, minimising ``|A p + y|^2 + (strength |p|)^2`` with p in units of A's columns.

    The strength of each speed minimises the generalised cross-validation function (Golub, Heath and Wahba 1979),
    ``|residual|^2 / trace(I - A A_inverse)^2``, among so many ``strengths`` from the ``weakest`` on.
    """
    members = require_residual(data, options).by_member()
    if members.matrix.shape[2] <= members.unknowns.present.sum(axis=1).max():
        raise Refusal(
            "nothing_to_validate",
            f"there are {members.matrix.shape[2]} equations for {members.matrix.shape[3]} unknowns",
        )
    left, singular, _, _ = decompose_columns(members)
    inside = np.einsum("msrk,msr->msk", left, members.offset)
    outside = np.maximum((members.offset**2).sum(axis=-1) - (inside**2).sum(axis=-1), 0.0)
    grid = np.concatenate([[0.0], np.geomspace(weakest, 1.0, strengths)])[:, None, None, None]
    share = np.divide(grid**2, singular**2 + grid**2, out=np.ones((len(grid), *singular.shape)), where=singular > 0)
    left_over = ((share * inside) ** 2).sum(axis=-1) + outside
    value = left_over / (members.matrix.shape[2] - singular.shape[-1] + share.sum(axis=-1)) ** 2
    inverse = _invert(members, np.asarray(grid[value.argmin(axis=0), 0, 0, 0]))
    values = -np.einsum("msur,msr->msu", inverse, members.offset)
    return make_estimate(data, values, _propagate_noise(data, values, inverse))


def solve_expanded(data: Measurement, options: MethodOptions) -> Estimate:
    """Least squares of each speed on the motion of the bearings that all sensors together tell of, at any nodes.

    Forces and motion at the bearings are the weighted least squares answer to the readings
    (:func:`pipeline.problem.expansion.expand`); the rows of the residual are weighted by the noise that is left in
    them.
    """
    expansion = expand(data.response, data.dataset.displacement, data.deviation)
    if expansion is None:
        raise Refusal("forces_not_seen", f"they are at {describe_sensors(data)}")
    residual = linear_residual(expansion.equations, data.unknowns, data.known)
    refuse_undetermined(judge_identifiability(expansion.equations, residual, options.constant))
    values = per_speed_least_squares(residual)
    for _ in range(2):
        white = whiten(residual, expansion.residual_root(data.response, data.table(values)))
        values = per_speed_least_squares(white)
    return make_estimate(data, values, least_squares_deviation(white))


def solve_total(data: Measurement, options: MethodOptions, rounds: int = 4) -> Estimate:
    """Weighted total least squares (De Troyer et al. 2012): consistent, because it knows the noise of A and y.

    With rows weighted by the covariance of the residual, ``E[M'M] = M0'M0 + C`` for the noisy ``M = [A y]``: the answer
    is the vector ``[p, 1]`` that minimises ``|M v|^2 / (v' C v)``. The weights
    depend on the answer: they are made again in each of the ``rounds``.
    """
    residual = require_residual(data, options)
    values = per_speed_least_squares(residual)
    # (S, R, 2 B, U + 1, P) of [A y] by the displacements: unknowns first, then the offset.
    offset = residual_sensitivity(data.rotor, data.dataset, data.table(np.zeros_like(values)))  # (S, R, 2 B, P)
    columns = bearing_rows(data.rotor, data.dataset, data.unknowns)  # (S, R, 2 B, U, P)
    derivative = np.concatenate([columns, offset[:, :, :, None]], axis=3)
    for _ in range(rounds):
        root = data.residual_root(data.table(values))
        values = _solve(data, whiten(residual, root), derivative, root)
    return make_estimate(
        data, values, least_squares_deviation(whiten(residual, data.residual_root(data.table(values))))
    )


def _invert(members: LinearResidual, strength: np.ndarray) -> np.ndarray:
    """(M, S, U, rows) regularised inverse of A; ``strength`` (M, S) is relative to A with columns of unit length."""
    left, singular, right, length = decompose_columns(members)
    floor = singular[..., :1] * np.finfo(float).eps * members.matrix.shape[2]
    filtered = np.where(singular > floor, singular / (singular**2 + strength[..., None] ** 2 + floor**2), 0.0)
    return np.einsum("mskv,msk,msrk->msvr", right, filtered, left) / length[..., None]


def _propagate_noise(data: Measurement, values: np.ndarray, inverse: np.ndarray) -> np.ndarray:
    """(M, S, U) standard deviation that the stated noise implies for ``p = -inverse y``; (M, S, U, rows) inverse."""
    root = data.residual_root(data.table(values))
    return np.array(
        [
            linear_deviation(weights, root[:, :, rows])
            for weights, rows in zip(inverse, member_rows(data.unknowns), strict=True)
        ]
    )


def _solve(data: Measurement, white: LinearResidual, derivative: np.ndarray, root: np.ndarray) -> np.ndarray:
    """(M, S, U) from whitened rows: the smallest generalised singular vector of ``[A y]`` and its noise."""
    members = member_rows(data.unknowns)
    values = np.zeros((len(members), *white.matrix.shape[1::2]))
    noise = data.deviation.swapaxes(1, 2)[:, :, None, None]  # (S, R, 1, 1, P)
    for m, member in enumerate(members):
        present = np.append(white.unknowns.present[m], True)
        factor = lower_root(root[:, :, member])
        errors = (derivative[:, :, member][:, :, :, present] * noise).reshape(*factor.shape[:3], -1)
        errors = np.linalg.solve(factor, errors).reshape(*factor.shape[:3], int(present.sum()), -1)
        spread = np.einsum("sriup,srivp->suv", errors.conj(), errors, optimize=True).real
        matrix = np.concatenate([white.matrix[m], white.offset[m][..., None]], axis=-1)[..., present]
        size = np.sqrt(np.einsum("suu->su", spread))
        upper = np.linalg.cholesky(spread / size[:, :, None] / size[:, None, :]).swapaxes(1, 2)
        scaled = np.linalg.solve(upper.swapaxes(1, 2), (matrix / size[:, None]).swapaxes(1, 2)).swapaxes(1, 2)
        vector = np.linalg.svd(scaled, full_matrices=False)[2][:, -1]
        vector = np.linalg.solve(upper, vector[..., None])[..., 0] / size
        values[m][:, present[:-1]] = vector[:, :-1] / vector[:, -1:]
    return values


# --- smoothed over the speed ----------------------------------------------------------------------


def solve_smoothed(data: Measurement, options: MethodOptions, fewest: int = 4) -> Estimate:
    """Weighted means where the coefficients are known to be constant, else smoothing splines. Raises Refusal.

    Through fewer than ``fewest`` speeds a spline has nothing to smooth.
    """
    estimate, unknowns = solve_expanded(data, options), data.unknowns
    values = unknowns.leading(estimate.coefficients.values)
    spread = unknowns.leading(estimate.coefficients.spread)
    smooth, deviation = values.copy(), spread.copy()
    for m, u in unknowns.active:
        answer, deviations = values[m, :, u], spread[m, :, u]
        if options.constant:
            weight = 1 / deviations**2
            smooth[m, :, u], deviation[m, :, u] = weight @ answer / weight.sum(), 1 / np.sqrt(weight.sum())
        elif len(answer) >= fewest:
            smooth[m, :, u], deviation[m, :, u] = smooth_over_speed(data.dataset.speeds, answer, deviations)
    return make_estimate(data, smooth, deviation)


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
    kept = 1 / (1 + (tried / np.median(curvature))[:, None] * curvature)  # (strengths, S)
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


# --- after Kalman's update ------------------------------------------------------------------------


def identify_by_filter(data: Measurement, options: MethodOptions, least_settled: float = 0.5) -> Estimate:
    """Coefficients of each speed by itself, from any sensors whose runs are enough.

    Raises Refusal where it settles at fewer than the share ``least_settled`` of the speeds.
    """
    require_determined(data, together=False)
    values, settled = filter_bearings(data)
    if settled.mean() < least_settled:
        raise Refusal("not_settled", f"it does at {int(settled.sum())} of {len(settled)} speeds")
    text = f"{int(settled.sum())} of {len(settled)} speeds settled"
    return make_estimate(data, values, _propagate_through(data, values), text)


def _propagate_through(data: Measurement, values: np.ndarray, difference: float = 1e-6) -> np.ndarray:
    """(M, S, U): a fixed point ``p = T(p, z)`` moves with the readings by ``(I - T_p)^-1 T_z``."""
    active, measured = data.unknowns.active, data.dataset.displacement

    def updated(state: np.ndarray, readings: np.ndarray) -> np.ndarray:
        """(S, A) after one more update."""
        return data.unknowns.to_active(update_unknowns(data, state, readings))

    base, by_value = updated(values, measured), []
    for m, u in active:
        step = np.zeros_like(values)
        step[m, :, u] = difference * np.maximum(np.abs(values[m, :, u]), 1.0)
        by_value.append((updated(values + step, measured) - base) / step[m, :, u, None])
    inverse = np.linalg.pinv(np.eye(len(active)) - np.stack(by_value, axis=2))
    variance = np.zeros_like(base)
    for p, r in np.ndindex(measured.shape[1:]):
        size = difference * np.abs(measured[:, p, r])
        for unit in (1.0, 1j):
            other = measured.copy()
            other[:, p, r] += unit * size
            change = (inverse @ ((updated(values, other) - base) / size[:, None])[..., None])[..., 0]
            variance += (change * data.deviation[:, p, r, None]) ** 2 / 2
    return data.unknowns.from_active(np.sqrt(variance))
