"""Least squares at each speed by itself, on a flexible shaft: plain, regularised, and consistent.

Legend: M members (bearings, or 1 where they are alike), S speeds, R runs, P channels, U unknowns.
"""

from __future__ import annotations

import numpy as np

from pipeline.comparison.method import Estimate, Reason, Refusal, Task
from pipeline.equations.least_squares import per_speed_least_squares
from pipeline.equations.noise import (
    bearing_rows,
    least_squares_deviation,
    linear_deviation,
    member_rows,
    residual_covariance,
    residual_sensitivity,
    whitened,
)
from pipeline.equations.unknown_system import UnknownSystem

_ROUNDS = 4
"""The weights of total least squares depend on its answer: so often they are made again."""


def plain(task: Task) -> Estimate:
    """Tiwari, Lees and Friswell (2002): minimise the residual ``|A p + y|`` of each speed.

    Noise in the displacements is in A, too, which biases the answer (errors in variables).
    """
    task = task.without_unbalance()
    system = _members(task)
    values, _ = per_speed_least_squares(system)
    return task.estimate(values, _deviation(task, values, _inverse(system, np.zeros(system.matrix.shape[:2]))))


def tikhonov(task: Task) -> Estimate:
    """The same, minimising ``|A p + y|^2 + (strength |p|)^2`` with p in units of A's columns.

    The strength of each speed minimises the generalised cross-validation function (Golub, Heath and Wahba 1979).
    """
    task = task.without_unbalance()
    system = _members(task)
    if system.matrix.shape[2] <= system.unknowns.present.sum(axis=1).max():
        raise Refusal(
            Reason.NOTHING_TO_VALIDATE,
            f"there are {system.matrix.shape[2]} equations for {system.matrix.shape[3]} unknowns",
        )
    inverse = _inverse(system, _validated_strength(system))
    values = -np.einsum("msur,msr->msu", inverse, system.offset)
    return task.estimate(values, _deviation(task, values, inverse))


def total(task: Task) -> Estimate:
    """Weighted total least squares (De Troyer et al. 2012): consistent, because it knows the noise of A and y.

    With rows weighted by the covariance of the residual, ``E[M'M] = M0'M0 + C`` for the noisy ``M = [A y]``: the answer
    is the vector ``[p, 1]`` that minimises ``|M v|^2 / (v' C v)``.
    """
    task = task.without_unbalance()
    system = _members(task)
    values, _ = per_speed_least_squares(system)
    derivative = _derivative(task)
    for _ in range(_ROUNDS):
        covariance = residual_covariance(task.rotor, task.dataset, task.table(values), task.deviation)
        white = whitened(task.system, covariance, task.alike)
        values = _consistent(task, white, derivative, covariance)
    covariance = residual_covariance(task.rotor, task.dataset, task.table(values), task.deviation)
    return task.estimate(values, least_squares_deviation(whitened(task.system, covariance, task.alike)))


def _members(task: Task) -> UnknownSystem:
    return task.system.alike() if task.alike else task.system


def _scaled(system: UnknownSystem) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Singular value decomposition of A with columns of unit length, and these lengths (M, S, U)."""
    length = np.linalg.norm(system.matrix, axis=2)
    length = np.where(length > 0, length, 1.0)
    return *np.linalg.svd(system.matrix / length[:, :, None], full_matrices=False), length


def _inverse(system: UnknownSystem, strength: np.ndarray) -> np.ndarray:
    """(M, S, U, rows) regularised inverse of A; ``strength`` (M, S) is relative to A with columns of unit length."""
    left, singular, right, length = _scaled(system)
    floor = singular[..., :1] * np.finfo(float).eps * system.matrix.shape[2]
    filtered = np.where(singular > floor, singular / (singular**2 + strength[..., None] ** 2 + floor**2), 0.0)
    return np.einsum("mskv,msk,msrk->msvr", right, filtered, left) / length[..., None]


def _validated_strength(system: UnknownSystem) -> np.ndarray:
    """(M, S) strengths that minimise ``|residual|^2 / trace(I - A A_inverse)^2``."""
    left, singular, _, _ = _scaled(system)
    n_rows = system.matrix.shape[2]
    inside = np.einsum("msrk,msr->msk", left, system.offset)
    outside = np.maximum((system.offset**2).sum(axis=-1) - (inside**2).sum(axis=-1), 0.0)
    grid = np.concatenate([[0.0], np.geomspace(_WEAKEST, 1.0, _STRENGTHS)])[:, None, None, None]
    share = np.divide(grid**2, singular**2 + grid**2, out=np.ones((len(grid), *singular.shape)), where=singular > 0)
    left_over = ((share * inside) ** 2).sum(axis=-1) + outside
    value = left_over / (n_rows - singular.shape[-1] + share.sum(axis=-1)) ** 2
    return np.asarray(grid[value.argmin(axis=0), 0, 0, 0])


_WEAKEST = 1e-8
_STRENGTHS = 65


def _deviation(task: Task, values: np.ndarray, inverse: np.ndarray) -> np.ndarray:
    """(M, S, U) standard deviation that the stated noise implies for ``p = -inverse y``; (M, S, U, rows) inverse."""
    covariance = residual_covariance(task.rotor, task.dataset, task.table(values), task.deviation)
    members = member_rows(len(task.rotor.bearing_nodes), task.alike)
    return np.array(
        [
            linear_deviation(own, covariance[:, :, rows[:, None], rows])
            for own, rows in zip(inverse, members, strict=True)
        ]
    )


def _derivative(task: Task) -> np.ndarray:
    """(S, R, 2 B, U + 1, P) derivative of ``[A y]`` by the displacements: unknowns first, then the offset."""
    dataset, unknowns = task.dataset, task.unknowns
    none = task.table(np.zeros((task.members, len(dataset.speeds), len(unknowns.names))))
    offset = residual_sensitivity(task.rotor, dataset, none)  # (S, R, 2 B, P)
    columns = bearing_rows(task.rotor, dataset, unknowns)  # (S, R, 2 B, U, P)
    return np.concatenate([columns, offset[:, :, :, None]], axis=3)


def _consistent(task: Task, white: UnknownSystem, derivative: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """(M, S, U) from whitened rows: the smallest generalised singular vector of ``[A y]`` and its noise."""
    members = member_rows(len(task.rotor.bearing_nodes), task.alike)
    values = np.zeros((len(members), *white.matrix.shape[1::2]))
    noise = task.deviation.swapaxes(1, 2)[:, :, None, None]  # (S, R, 1, 1, P)
    for m, own in enumerate(members):
        present = np.append(white.unknowns.present[m], True)
        factor = np.linalg.cholesky(covariance[:, :, own[:, None], own])
        moved = (derivative[:, :, own][:, :, :, present] * noise).reshape(*factor.shape[:3], -1)
        moved = np.linalg.solve(factor, moved).reshape(*factor.shape[:3], int(present.sum()), -1)
        spread = np.einsum("sriup,srivp->suv", moved.conj(), moved, optimize=True).real
        matrix = np.concatenate([white.matrix[m], white.offset[m][..., None]], axis=-1)[..., present]
        size = np.sqrt(np.einsum("suu->su", spread))
        upper = np.linalg.cholesky(spread / size[:, :, None] / size[:, None, :]).swapaxes(1, 2)
        scaled = np.linalg.solve(upper.swapaxes(1, 2), (matrix / size[:, None]).swapaxes(1, 2)).swapaxes(1, 2)
        vector = np.linalg.svd(scaled, full_matrices=False)[2][:, -1]
        vector = np.linalg.solve(upper, vector[..., None])[..., 0] / size
        values[m][:, present[:-1]] = vector[:, :-1] / vector[:, -1:]
    return values
