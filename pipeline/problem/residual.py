"""The residual at the bearings, and that it is linear in the coefficients.

The residual of the equation of motion (paper, eq. 6) holds the unknown in the rows of the bearing
displacements only:

    r_b = g_b + H_b(w) q_b,     g_b = [D_rotor(w) Q - F]_b

g_b needs all of Q. DOF that are not measured (rotations, unmeasured translations) follow from their own rows
of the equation of motion, in which no bearing appears: ``D_uu q_u = F_u - D_um q_m``.

At one speed ``H_b q_b`` is linear in the real coefficients, so r is ``A p + y`` with the unknowns p of that speed.

Legend: S speeds, R runs, B bearings, U unknowns, M members (B, or 1 where all bearings share their coefficients); 2 for
(x, y). SI units.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from pipeline.coefficients import COEFFICIENTS, column, is_stiffness, row
from pipeline.data.dataset import DIRECTIONS, VibrationDataset, assemble_forces, group_runs
from pipeline.errors import DataError, IdentifiabilityError
from pipeline.rotor.bearing_table import BearingTable
from pipeline.rotor.dynamic_stiffness import apply, banded, multiply, solve
from pipeline.rotor.model import RotorModel, bearing_dof
from pipeline.unknowns import UnknownSet


@dataclass(frozen=True, eq=False)
class BearingEquations:
    """``r = g + H q`` for every bearing, speed and run."""

    bearing_nodes: tuple[int, ...]  # B
    speeds: np.ndarray  # (S,) rotor speeds, rad/s
    frequencies: np.ndarray  # (S, R) excitation frequencies, rad/s
    free_residual: np.ndarray  # g, (B, S, 2, R) complex, N
    displacement: np.ndarray  # q, (B, S, 2, R) complex, m

    def residual(self, impedance: np.ndarray) -> np.ndarray:
        """(B, S, 2, R) complex residual in N.

        ``impedance`` H is (B, S, R, 2, 2), or (B, S, 2, 2) where all runs are synchronous.
        """
        if impedance.ndim == 4:
            return np.asarray(self.free_residual + impedance @ self.displacement)
        return np.asarray(self.free_residual + np.einsum("bsrij,bsjr->bsir", impedance, self.displacement))


def bearing_equations(rotor: RotorModel, dataset: VibrationDataset) -> BearingEquations:
    """Reduce the equation of motion to the bearings' rows.

    Raises DataError where x or y is not measured at a bearing, or one stands on soft ground.
    """
    measured, resolution = dataset.resolution()
    at_bearings = bearing_dof(rotor)
    if rotor.casings:
        raise DataError(
            "The residual needs bearings that stand on the ground, but that of node "
            f"{rotor.casings[0]} has a support (machine.rotor.supports): loss=response takes any"
        )
    for node, pair in zip(rotor.bearing_nodes, at_bearings, strict=True):
        for direction, dof in zip(DIRECTIONS, pair, strict=True):
            if dof not in measured:
                raise DataError(
                    "The residual needs x and y measured at every bearing, but "
                    f"{direction} of node {node} is missing in the vibration data: loss=response takes any sensors"
                )
    displacement = multiply(resolution, dataset.displacement)
    speeds = dataset.speeds
    forces = assemble_forces(rotor, dataset.excitations, dataset.runs, dataset.frequencies)
    forces = forces * dataset.present[:, None]  # where a run was not measured, its equations say nothing: 0 = 0
    everything = np.arange(rotor.n_dof)
    unmeasured = np.setdiff1d(everything, measured)
    response = np.zeros((len(speeds), rotor.n_dof, len(dataset.runs)), dtype=complex)
    response[:, measured] = displacement
    rows = at_bearings.ravel()
    free = -forces[:, rows]
    for runs, w in group_runs(dataset.frequencies):
        if len(unmeasured):
            known = apply(rotor, unmeasured, measured, w, speeds, displacement[..., runs])
            right = forces[:, unmeasured][..., runs] - known
            response[np.ix_(np.arange(len(speeds)), unmeasured, runs)] = solve(
                banded(rotor, unmeasured), w, speeds, right
            )
        free[..., runs] += apply(rotor, rows, everything, w, speeds, response[..., runs])
    shape = (len(speeds), len(rotor.bearing_nodes), 2, len(dataset.runs))
    return BearingEquations(
        rotor.bearing_nodes,
        speeds,
        dataset.frequencies,
        free.reshape(shape).swapaxes(0, 1),
        response[:, rows].reshape(shape).swapaxes(0, 1),
    )


@dataclass(frozen=True, eq=False)
class LinearResidual:
    """``A p + y``. Rows are Re, then Im, of the force in x and y of every run."""

    unknowns: UnknownSet
    matrix: np.ndarray  # A, (B, S, 4 R, U); a column of zeros where a bearing does not have an unknown
    offset: np.ndarray  # y, (B, S, 4 R) N: g and what the known coefficients add to it

    def by_member(self) -> LinearResidual:
        """(M, S, rows, ..): bearings that share their coefficients joined, so that each member is solved by itself."""
        if not self.unknowns.shared:
            return self
        n_bearings, n_speeds, n_rows, n_unknowns = self.matrix.shape
        return replace(
            self,
            matrix=self.matrix.swapaxes(0, 1).reshape(1, n_speeds, n_bearings * n_rows, n_unknowns),
            offset=self.offset.swapaxes(0, 1).reshape(1, n_speeds, n_bearings * n_rows),
        )

    def at(self, keep: np.ndarray) -> LinearResidual:
        """The same at the speeds that the mask or index ``keep`` selects."""
        return replace(self, matrix=self.matrix[:, keep], offset=self.offset[:, keep])


def linear_residual(equations: BearingEquations, unknowns: UnknownSet, known: BearingTable) -> LinearResidual:
    """Write the residual in the ``unknowns``; the other coefficients come from ``known``.

    Raises IdentifiabilityError where a bearing does not move.
    """
    columns = np.zeros((*equations.free_residual.shape, len(COEFFICIENTS)), dtype=complex)  # (B, S, 2, R, 8)
    for c, name in enumerate(COEFFICIENTS):  # the derivative of the residual by each coefficient
        factor = 1.0 if is_stiffness(name) else 1j * equations.frequencies
        columns[:, :, row(name), :, c] = factor * equations.displacement[:, :, column(name)]
    matrix = np.einsum("bsirc,bcu->bsiru", columns, unknowns.expansion)
    kept = np.where(unknowns.identified[:, None], 0.0, known.values)
    offset = equations.free_residual + np.einsum("bsirc,bsc->bsir", columns, kept)
    n_bearings, n_speeds = offset.shape[:2]
    matrix = matrix.reshape(n_bearings, n_speeds, -1, len(unknowns.names))
    offset = offset.reshape(n_bearings, n_speeds, -1)
    residual = LinearResidual(
        unknowns,
        np.concatenate([matrix.real, matrix.imag], axis=2),
        np.concatenate([offset.real, offset.imag], axis=2),
    )
    force = np.abs(equations.free_residual).max(axis=(2, 3))[..., None]  # (B, S, 1)
    still = (np.abs(residual.matrix).max(axis=2) == 0) | (force == 0)
    points = np.argwhere(still & (unknowns.expansion != 0).any(axis=1)[:, None])
    if len(points):
        b, s, u = points[0]
        raise IdentifiabilityError(
            f"The bearing at node {equations.bearing_nodes[b]} must move to show its {unknowns.names[u]}, but "
            f"the data have no motion of it at {equations.speeds[s]:.6g} rad/s ({len(points)} such points): "
            "check the sensors"
        )
    return residual


def decompose_columns(members: LinearResidual) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Singular value decomposition of A, (M, S, rows, U), with columns of unit length, and these lengths (M, S, U).

    Stiffness and damping differ by orders of magnitude: so scaled, a condition number speaks of the orbits rather than
    of the units.
    """
    length = np.linalg.norm(members.matrix, axis=2)
    length = np.where(length > 0, length, 1.0)
    return *np.linalg.svd(members.matrix / length[:, :, None], full_matrices=False), length


def per_speed_least_squares(residual: LinearResidual) -> np.ndarray:
    """The conventional answer (Tiwari, Lees, Friswell 2002), each speed by itself: unknowns (M, S, U) that minimise
    ``|A p + y|``, N/m and N s/m, zero where a member lacks one.
    """
    residual = residual.by_member()
    left, singular, right, length = decompose_columns(residual)
    usable = singular > singular[..., :1] * np.finfo(float).eps * residual.matrix.shape[2]
    inverse = np.where(usable, 1.0 / np.where(usable, singular, 1.0), 0.0)
    projected = np.einsum("bsru,bsr->bsu", left, residual.offset) * inverse
    return np.asarray(-np.einsum("bsuv,bsu->bsv", right, projected) / length)
