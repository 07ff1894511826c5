"""From measurement and known rotor to the equations that the bearings must satisfy.

The residual of the equation of motion (paper, eq. 6) holds the unknown in the rows of the bearing
displacements only:

    r_b = g_b + H_b(w) q_b,     g_b = [D_rotor(w) Q - F]_b

g_b needs all of Q. DOF that are not measured (rotations, unmeasured translations) follow from their own rows
of the equation of motion, in which no bearing appears: ``D_uu q_u = F_u - D_um q_m``.

Legend: S speeds, R runs, B bearings, U unknowns; 2 for (x, y). SI units.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pipeline.coefficients import COEFFICIENTS, column, is_stiffness, row
from pipeline.data.dataset import DIRECTIONS, VibrationDataset, force_vectors
from pipeline.errors import DataError, IdentifiabilityError
from pipeline.rotor.bearing_table import BearingTable
from pipeline.rotor.dynamic_stiffness import apply, banded, solve
from pipeline.rotor.model import RotorModel, bearing_dof


@dataclass(frozen=True, eq=False)
class BearingEquations:
    """``r = g + H q`` for every bearing, speed and run."""

    bearing_nodes: tuple[int, ...]  # B
    speeds: np.ndarray  # (S,) rotor speeds, rad/s
    frequencies: np.ndarray  # (S,) excitation frequencies, rad/s
    free_residual: np.ndarray  # g, (B, S, 2, R) complex, N
    displacement: np.ndarray  # q, (B, S, 2, R) complex, m

    def residual(self, impedance: np.ndarray) -> np.ndarray:
        """(B, S, 2, R) complex residual in N for ``impedance`` H (B, S, 2, 2)."""
        return self.free_residual + impedance @ self.displacement

    def subset(self, keep: np.ndarray) -> BearingEquations:
        """The same at the speeds that the mask or index ``keep`` selects."""
        return BearingEquations(
            self.bearing_nodes,
            self.speeds[keep],
            self.frequencies[keep],
            self.free_residual[:, keep],
            self.displacement[:, keep],
        )


@dataclass(frozen=True, eq=False)
class UnknownSystem:
    """The residual as a real linear function ``A p + y`` of the unknown coefficients p of each speed."""

    unknowns: tuple[str, ...]  # U
    matrix: np.ndarray  # A, (B, S, 4 R, U)
    offset: np.ndarray  # y, (B, S, 4 R) N: g and what the known coefficients add to it


def bearing_equations(rotor: RotorModel, dataset: VibrationDataset) -> BearingEquations:
    """Reduce the equation of motion to the bearings' rows.

    Raises DataError where x or y is not measured at a bearing.
    """
    measured = dataset.measured_dof()
    at_bearings = bearing_dof(rotor)
    for node, pair in zip(rotor.bearing_nodes, at_bearings, strict=True):
        for direction, dof in enumerate(pair):
            if dof not in measured:
                raise DataError(
                    "The residual needs x and y measured at every bearing, but "
                    f"{DIRECTIONS[direction]} of node {node} is missing in the vibration data"
                )
    w = dataset.speeds
    forces = force_vectors(rotor, dataset.excitations, dataset.runs, w)
    everything = np.arange(rotor.n_dof)
    unmeasured = np.setdiff1d(everything, measured)
    response = np.zeros((len(w), rotor.n_dof, len(dataset.runs)), dtype=complex)
    response[:, measured] = dataset.displacement
    if len(unmeasured):
        right = forces[:, unmeasured] - apply(rotor, unmeasured, measured, w, w, dataset.displacement)
        response[:, unmeasured] = solve(banded(rotor, unmeasured), w, w, right)
    rows = at_bearings.ravel()
    free = apply(rotor, rows, everything, w, w, response) - forces[:, rows]
    shape = (len(w), len(rotor.bearing_nodes), 2, len(dataset.runs))
    return BearingEquations(
        rotor.bearing_nodes,
        w,
        w,
        free.reshape(shape).swapaxes(0, 1),
        response[:, rows].reshape(shape).swapaxes(0, 1),
    )


def unknown_system(equations: BearingEquations, unknowns: Sequence[str], known: BearingTable) -> UnknownSystem:
    """Write the residual in the ``unknowns``; the other coefficients come from ``known``.

    Raises IdentifiabilityError where there are fewer equations than unknowns.
    """
    _check_enough_runs(unknowns, equations.displacement.shape[-1])
    matrix = np.stack([_column(equations, name) for name in unknowns], axis=-1)
    kept = [name for name in COEFFICIENTS if name not in unknowns]
    offset = equations.free_residual.copy()
    for name in kept:
        offset += _column(equations, name) * known.coefficient(name)[:, :, None, None]
    n_bearings, n_speeds = offset.shape[:2]
    matrix = matrix.reshape(n_bearings, n_speeds, -1, len(unknowns))
    offset = offset.reshape(n_bearings, n_speeds, -1)
    system = UnknownSystem(
        tuple(unknowns),
        np.concatenate([matrix.real, matrix.imag], axis=2),
        np.concatenate([offset.real, offset.imag], axis=2),
    )
    _check_motion(equations, system)
    return system


def _column(equations: BearingEquations, name: str) -> np.ndarray:
    """(B, S, 2, R) derivative of the residual with respect to one coefficient."""
    derivative = np.zeros_like(equations.free_residual)
    factor = 1.0 if is_stiffness(name) else 1j * equations.frequencies[:, None]
    derivative[:, :, row(name)] = factor * equations.displacement[:, :, column(name)]
    return derivative


def _check_enough_runs(unknowns: Sequence[str], n_runs: int) -> None:
    for direction, letter in enumerate(DIRECTIONS):
        wanted = [name for name in unknowns if row(name) == direction]
        if len(wanted) > 2 * n_runs:
            raise IdentifiabilityError(
                f"Each run gives 2 real equations for the force in {letter}, so {len(wanted)} unknowns "
                f"({', '.join(wanted)}) need "
                f"{-(-len(wanted) // 2)} runs with independent orbits, but got {n_runs}: add a run or name fewer "
                "unknowns"
            )


_DEPENDENT = 1e-12
"""Ratio of singular values below which double precision can't tell orbits apart."""


def _check_motion(equations: BearingEquations, system: UnknownSystem) -> None:
    force = np.abs(equations.free_residual).max(axis=(2, 3))[..., None]  # (B, S, 1)
    still = np.argwhere((np.abs(system.matrix).max(axis=2) == 0) | (force == 0))
    if len(still):
        b, s, u = still[0]
        raise IdentifiabilityError(
            f"The bearing at node {equations.bearing_nodes[b]} must move to show its {system.unknowns[u]}, but the "
            f"data have no motion of it at {equations.speeds[s]:.6g} rad/s ({len(still)} such points): "
            "check the sensors"
        )


def require_independent_orbits(equations: BearingEquations, system: UnknownSystem) -> None:
    """Raise IdentifiabilityError for a bearing whose unknowns the runs do not determine at any speed."""
    columns = system.matrix / np.linalg.norm(system.matrix, axis=2, keepdims=True)
    singular = np.linalg.svd(columns, compute_uv=False)
    for b, node in enumerate(equations.bearing_nodes):
        if (singular[b, :, -1] < _DEPENDENT * singular[b, :, 0]).all():
            raise IdentifiabilityError(
                f"The runs must give the bearing at node {node} independent orbits to determine "
                f"{', '.join(system.unknowns)}, but at every speed they are multiples of each other: add a run with "
                "another excitation or name fewer unknowns"
            )
