"""The residual at the bearings as a real linear function ``A p + y`` of the unknowns p of each speed.

Legend: S speeds, R runs, B bearings, U unknowns; M members that are solved by themselves (the bearings, or 1 where
they are alike and all of them share one p). SI units.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.coefficients import COEFFICIENTS, column, is_stiffness, row
from pipeline.equations.bearing_equations import BearingEquations
from pipeline.errors import IdentifiabilityError
from pipeline.rotor.bearing_table import BearingTable
from pipeline.unknowns import UnknownSet


@dataclass(frozen=True, eq=False)
class UnknownSystem:
    """``A p + y``. Rows are Re, then Im, of the force in x and y of every run."""

    unknowns: UnknownSet
    matrix: np.ndarray  # A, (B, S, 4 R, U); a column of zeros where a bearing does not have an unknown
    offset: np.ndarray  # y, (B, S, 4 R) N: g and what the known coefficients add to it

    def alike(self) -> UnknownSystem:
        """One member, (1, S, 4 R B, ..), for bearings that share their coefficients."""
        n_bearings, n_speeds, n_rows, n_unknowns = self.matrix.shape
        return UnknownSystem(
            UnknownSet(self.unknowns.names, self.unknowns.expansion[:1]),
            self.matrix.swapaxes(0, 1).reshape(1, n_speeds, n_bearings * n_rows, n_unknowns),
            self.offset.swapaxes(0, 1).reshape(1, n_speeds, n_bearings * n_rows),
        )


def unknown_system(equations: BearingEquations, unknowns: UnknownSet, known: BearingTable) -> UnknownSystem:
    """Write the residual in the ``unknowns``; the other coefficients come from ``known``.

    Raises IdentifiabilityError where a bearing does not move.
    """
    columns = np.stack([_column(equations, name) for name in COEFFICIENTS], axis=-1)  # (B, S, 2, R, 8)
    matrix = np.einsum("bsirc,bcu->bsiru", columns, unknowns.expansion)
    kept = np.where(unknowns.identified[:, None], 0.0, known.values)
    offset = equations.free_residual + np.einsum("bsirc,bsc->bsir", columns, kept)
    n_bearings, n_speeds = offset.shape[:2]
    matrix = matrix.reshape(n_bearings, n_speeds, -1, len(unknowns.names))
    offset = offset.reshape(n_bearings, n_speeds, -1)
    system = UnknownSystem(
        unknowns,
        np.concatenate([matrix.real, matrix.imag], axis=2),
        np.concatenate([offset.real, offset.imag], axis=2),
    )
    _check_motion(equations, system)
    return system


def _column(equations: BearingEquations, name: str) -> np.ndarray:
    """(B, S, 2, R) derivative of the residual with respect to one coefficient."""
    derivative = np.zeros_like(equations.free_residual)
    factor = 1.0 if is_stiffness(name) else 1j * equations.frequencies
    derivative[:, :, row(name)] = factor * equations.displacement[:, :, column(name)]
    return derivative


def _check_motion(equations: BearingEquations, system: UnknownSystem) -> None:
    force = np.abs(equations.free_residual).max(axis=(2, 3))[..., None]  # (B, S, 1)
    still = (np.abs(system.matrix).max(axis=2) == 0) | (force == 0)
    points = np.argwhere(still & system.unknowns.present[:, None])
    if len(points):
        b, s, u = points[0]
        raise IdentifiabilityError(
            f"The bearing at node {equations.bearing_nodes[b]} must move to show its {system.unknowns.names[u]}, but "
            f"the data have no motion of it at {equations.speeds[s]:.6g} rad/s ({len(points)} such points): "
            "check the sensors"
        )
