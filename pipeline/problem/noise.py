"""What the sensors' noise does to the residual, and to the coefficients of least squares at each speed.

A displacement enters the residual through the rotor's dynamic stiffness: noise of a thousandth in Q can be as large as
the bearing force itself. To first order, with the bearings' impedance H and the rows b of the bearings,

    dr_b = (D_bm - D_bu D_uu^-1 D_um + H) dQ_m

for measured DOF m and others u, which follow from their own rows of the equation of motion.

Legend: S speeds, P channels, R runs, B bearings, U unknowns, M members (see :mod:`pipeline.problem.residual`).
"""

from __future__ import annotations

import itertools

import numpy as np

from pipeline.coefficients import COEFFICIENTS, column, is_stiffness, row
from pipeline.data.dataset import VibrationDataset, group_runs
from pipeline.problem.residual import LinearResidual
from pipeline.rotor.bearing_table import BearingTable
from pipeline.rotor.dynamic_stiffness import apply, banded, solve
from pipeline.rotor.model import RotorModel, bearing_dof
from pipeline.unknowns import UnknownSet

DEPENDENT = 1e-10
"""Ratio of singular values below which data in double precision can't tell equations apart."""
UNMEASURED = 1e20
"""N: the deviation of the forces of a run that was not measured. Whitened by it, a row of any force vanishes."""


def residual_root(
    rotor: RotorModel, dataset: VibrationDataset, bearings: BearingTable, deviation: np.ndarray
) -> np.ndarray:
    """(S, R, 2 B, P) complex, N: root L of the covariance L L^H of the residual at the bearings, the runs being
    independent.

    ``bearings`` are the best at hand (identified, or a prior); ``deviation`` (S, P, R) m is circular noise. A product
    with itself would lose half of the digits, and be no covariance where bearings are far off.
    """
    here = np.isfinite(deviation).all(axis=1)  # (S, R) of runs that were measured
    known = np.where(here[:, None], deviation, 0.0)
    root = residual_sensitivity(rotor, dataset, bearings) * known.swapaxes(1, 2)[:, :, None]
    root[~here] = UNMEASURED * np.eye(*root.shape[2:])
    return np.asarray(root)


def lower_root(root: np.ndarray) -> np.ndarray:
    """Cholesky's factor (.., n, n) of ``root root^H``, of a root (.., n, P)."""
    lower = np.asarray(np.linalg.qr(root.conj().swapaxes(-1, -2), mode="r")).conj().swapaxes(-1, -2)
    diagonal = np.einsum("...ii->...i", lower).conj()
    return np.asarray(lower * (diagonal / np.abs(diagonal))[..., None, :])


def residual_sensitivity(
    rotor: RotorModel, dataset: VibrationDataset, bearings: BearingTable, at_once: int = 64
) -> np.ndarray:
    """(S, R, 2 B, P) derivative of the residual by the measured displacements, N/m, of so many speeds ``at_once``."""
    (measured, resolution), rows = dataset.resolution(), bearing_dof(rotor)
    unmeasured, place = np.setdiff1d(np.arange(rotor.n_dof), measured), {dof: p for p, dof in enumerate(measured)}
    shape = (len(dataset.speeds), len(dataset.runs), 2 * len(bearings.nodes), len(dataset.channels))
    result = np.empty(shape, dtype=complex)
    for runs, every in group_runs(dataset.frequencies):
        for start in range(0, len(every), at_once):
            few = np.arange(start, min(start + at_once, len(every)))
            w, near = every[few], bearings.at(few)
            unit = np.broadcast_to(np.eye(len(measured)), (len(w), len(measured), len(measured))).astype(complex)
            slope = apply(rotor, rows.ravel(), measured, w, near.speeds, unit)
            if len(unmeasured):
                carried = apply(rotor, unmeasured, measured, w, near.speeds, unit)
                followed = solve(banded(rotor, unmeasured), w, near.speeds, carried)
                slope -= apply(rotor, rows.ravel(), unmeasured, w, near.speeds, followed)
            for (b, impedance), i, j in itertools.product(enumerate(near.impedance(w)), range(2), range(2)):
                slope[:, 2 * b + i, place[rows[b, j]]] += impedance[:, i, j]
            result[np.ix_(few, runs)] = (slope @ resolution)[:, None]
    return result


def bearing_rows(rotor: RotorModel, dataset: VibrationDataset, unknowns: UnknownSet) -> np.ndarray:
    """(S, R, 2 B, U, P) derivative of the residual's derivative by each unknown by the measured displacements."""
    (measured, resolution), rows = dataset.resolution(), bearing_dof(rotor)
    result = np.zeros((*dataset.frequencies.shape, rows.size, len(unknowns.names), len(dataset.channels)), complex)
    for b, u, name in ((b, u, COEFFICIENTS[c]) for b, c, u in np.argwhere(unknowns.expansion)):
        sign = unknowns.expansion[b, COEFFICIENTS.index(name), u]
        seen = resolution[np.flatnonzero(measured == rows[b, column(name)])[0]]
        factor = np.ones(dataset.frequencies.shape) if is_stiffness(name) else 1j * dataset.frequencies
        result[:, :, 2 * b + row(name), u] += sign * factor[..., None] * seen
    return result


def whiten(residual: LinearResidual, root: np.ndarray) -> LinearResidual:
    """The residual, (M, S, rows, ..), with rows of independent noise of unit deviation: its least squares is weighted.

    ``root`` (S, R, 2 B, P) N is that of the residual's covariance.
    """
    n_bearings, n_speeds, n_rows, n_unknowns = residual.matrix.shape
    n_runs = n_rows // 4
    both = np.concatenate([residual.matrix, residual.offset[..., None]], axis=-1)
    rows = (both[:, :, : n_rows // 2] + 1j * both[:, :, n_rows // 2 :]).reshape(n_bearings, n_speeds, 2, n_runs, -1)
    rows = rows.transpose(1, 3, 0, 2, 4)  # (S, R, B, 2, U + 1)
    flat = rows.reshape(n_speeds, n_runs, 2 * n_bearings, -1)
    white = []
    for member in member_rows(residual.unknowns):
        # Half of the power is in the real part.
        unit = np.sqrt(2.0) * np.linalg.solve(lower_root(root[:, :, member]), flat[:, :, member])
        unit = unit.reshape(n_speeds, -1, n_unknowns + 1)
        white.append(np.concatenate([unit.real, unit.imag], axis=1))
    stacked = np.stack(white)
    return LinearResidual(residual.unknowns, stacked[..., :-1], stacked[..., -1])


def member_rows(unknowns: UnknownSet) -> np.ndarray:
    """(M, 2 B / M) which of the 2 B rows of the residual belong to each member."""
    return np.arange(2 * len(unknowns.expansion)).reshape(unknowns.n_members, -1)


def linear_deviation(inverse: np.ndarray, root: np.ndarray) -> np.ndarray:
    """(S, V) standard deviation of ``v = -inverse y`` for a residual with this ``root`` (S, R, 2 B, P) of covariance.

    ``inverse`` is (S, V, rows) with the rows of :class:`LinearResidual`: bearing, real or imaginary, direction, run.
    """
    n_speeds, n_runs, n_forces, _ = root.shape
    half = inverse.reshape(n_speeds, inverse.shape[1], n_forces // 2, 2, 2, n_runs)
    joined = (half[:, :, :, 0] - 1j * half[:, :, :, 1]).reshape(n_speeds, inverse.shape[1], n_forces, n_runs)
    # v moves by the real part of -joined * residual, which has half of the power.
    moved = np.einsum("svir,srip->svrp", joined, root)
    return np.asarray(np.linalg.norm(moved, axis=(2, 3)) / np.sqrt(2.0))


def least_squares_deviation(white: LinearResidual) -> np.ndarray:
    """(M, S, U) standard deviation of weighted least squares at each speed; infinite where the data say nothing.

    ``white`` is a residual of :func:`whiten`. An unknown that a bearing does not have has none (NaN).
    """
    result = np.full((*white.matrix.shape[:2], white.matrix.shape[-1]), np.nan)
    for m, present in enumerate(white.unknowns.present):
        matrix = white.matrix[m][..., present]
        length = np.linalg.norm(matrix, axis=1, keepdims=True)
        _, singular, right = np.linalg.svd(matrix / np.where(length > 0, length, 1.0), full_matrices=True)
        inverse = np.full((len(matrix), right.shape[1]), np.inf)
        determined = singular > DEPENDENT * singular[:, :1]
        inverse[:, : singular.shape[1]][determined] = 1.0 / singular[determined]
        with np.errstate(invalid="ignore"):  # no share of an infinite deviation is none
            shares = np.where(np.abs(right) > DEPENDENT, np.abs(right) * inverse[..., None], 0.0)
        result[m][:, present] = np.sqrt((shares**2).sum(axis=1)) / length[:, 0]
    return result
