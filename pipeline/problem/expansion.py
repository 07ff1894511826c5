"""Expansion: forces and motion at the bearings from whatever sensors there are.

Where the sensors are enough to tell the forces at the bearings, least squares on ``q_s = u0_s + a_sb f``
(:mod:`pipeline.problem.response`) gives f, the motion q_b of the bearings follows, and ``r = f + dH q_b`` is the
residual of the equation of motion.

Legend: S speeds, P channels, R runs, B bearings. SI units.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.problem.noise import UNMEASURED
from pipeline.problem.residual import BearingEquations
from pipeline.problem.response import ResponseEquations
from pipeline.rotor.bearing_table import BearingTable


@dataclass(frozen=True, eq=False)
class Expansion:
    """The residual at the bearings, from whatever sensors there are, and what their noise makes of it."""

    equations: BearingEquations
    receptance: np.ndarray  # a_bb of every run, (S, R, 2 B, 2 B)
    force_covariance: np.ndarray  # of f, (S, R, 2 B, 2 B) N^2

    def residual_covariance(self, equations: ResponseEquations, bearings: BearingTable) -> np.ndarray:
        """(S, R, 2 B, 2 B) complex, N^2: ``dr = (I + dH a_bb) df``, near the ``bearings``."""
        result = np.empty_like(self.force_covariance)
        for block in equations.films:
            change = equations.change(bearings, block)[:, None]
            factor = np.eye(change.shape[-1]) + change @ self.receptance[:, block.runs]
            result[:, block.runs] = factor @ self.force_covariance[:, block.runs] @ factor.conj().swapaxes(-1, -2)
        return result


def expand(
    equations: ResponseEquations, displacement: np.ndarray, deviation: np.ndarray, dependent: float = 1e-6
) -> Expansion | None:
    """Forces and motion at the bearings by least squares, weighted by the noise; None where the sensors are too few.

    Args:
        displacement: (S, P, R) complex, m.
        deviation: (S, P, R) root mean square of its noise, m; infinite where a run was not measured, which then says
            nothing: no force, and a covariance beyond all others.
        dependent: sensors whose smallest singular value is below this share say nothing of some bearing force.
    """
    n_speeds, n_channels, n_runs = displacement.shape
    count = 2 * len(equations.bearing_nodes)
    if n_channels < count:
        return None
    force = np.empty((n_speeds, count, n_runs), dtype=complex)
    displacements, receptance = np.empty_like(force), np.empty((n_speeds, n_runs, count, count), dtype=complex)
    covariance = np.empty_like(receptance)
    for block in equations.films:
        for i, run in enumerate(block.runs):
            here = np.isfinite(deviation[:, :, run]).all(axis=1)
            weight = 1.0 / np.where(here[:, None], deviation[:, :, run], 1.0)
            matrix = block.receptance_sensors * weight[..., None]
            length = np.linalg.norm(matrix, axis=1, keepdims=True)
            if (np.linalg.svd(matrix / length, compute_uv=False)[:, -1] < dependent).any():
                return None
            inverse = np.linalg.pinv(matrix / length) / length.swapaxes(1, 2)
            solved = inverse @ ((displacement[:, :, run] - block.forced_sensors[:, :, i]) * weight)[..., None]
            force[..., run] = solved[..., 0]
            displacements[..., run] = block.forced_bearings[..., i] + (block.receptance_bearings @ solved)[..., 0]
            covariance[:, run] = inverse @ inverse.conj().swapaxes(1, 2)
            receptance[:, run] = block.receptance_bearings
            force[~here, :, run], displacements[~here, :, run] = 0.0, 0.0
            covariance[~here, run] = UNMEASURED * np.eye(count)
    return Expansion(
        bearing_equations_of(equations, force - equations.reference * displacements, displacements),
        receptance,
        covariance,
    )


def bearing_equations_of(
    equations: ResponseEquations, force: np.ndarray, displacements: np.ndarray
) -> BearingEquations:
    """The residual ``r = force + H q`` from forces and displacements at the bearings, (S, 2 B, R) each."""
    shape = (len(force), len(equations.bearing_nodes), 2, force.shape[2])
    return BearingEquations(
        equations.bearing_nodes,
        equations.speeds,
        equations.frequencies,
        force.reshape(shape).swapaxes(0, 1),
        displacements.reshape(shape).swapaxes(0, 1),
    )
