"""From measurement and known rotor to the equations that the bearings must satisfy.

The residual of the equation of motion (paper, eq. 6) holds the unknown in the rows of the bearing
displacements only:

    r_b = g_b + H_b(w) q_b,     g_b = [D_rotor(w) Q - F]_b

g_b needs all of Q. DOF that are not measured (rotations, unmeasured translations) follow from their own rows
of the equation of motion, in which no bearing appears: ``D_uu q_u = F_u - D_um q_m``.

Legend: S speeds, R runs, B bearings; 2 for (x, y). SI units.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.data.dataset import DIRECTIONS, VibrationDataset, force_vectors, runs_by_frequency
from pipeline.errors import DataError
from pipeline.rotor.dynamic_stiffness import apply, banded, solve
from pipeline.rotor.model import RotorModel, bearing_dof


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
            return self.free_residual + impedance @ self.displacement
        return self.free_residual + np.einsum("bsrij,bsjr->bsir", impedance, self.displacement)

    def subset(self, keep: np.ndarray) -> BearingEquations:
        """The same at the speeds that the mask or index ``keep`` selects."""
        return BearingEquations(
            self.bearing_nodes,
            self.speeds[keep],
            self.frequencies[keep],
            self.free_residual[:, keep],
            self.displacement[:, keep],
        )


def bearing_equations(rotor: RotorModel, dataset: VibrationDataset) -> BearingEquations:
    """Reduce the equation of motion to the bearings' rows.

    Raises DataError where x or y is not measured at a bearing.
    """
    measured, resolution = dataset.resolution()
    at_bearings = bearing_dof(rotor)
    for node, pair in zip(rotor.bearing_nodes, at_bearings, strict=True):
        for direction, dof in zip(DIRECTIONS, pair, strict=True):
            if dof not in measured:
                raise DataError(
                    "The residual needs x and y measured at every bearing, but "
                    f"{direction} of node {node} is missing in the vibration data: loss=response takes any sensors"
                )
    displacement = resolution @ dataset.displacement
    speeds = dataset.speeds
    forces = force_vectors(rotor, dataset.excitations, dataset.runs, dataset.frequencies)
    everything = np.arange(rotor.n_dof)
    unmeasured = np.setdiff1d(everything, measured)
    response = np.zeros((len(speeds), rotor.n_dof, len(dataset.runs)), dtype=complex)
    response[:, measured] = displacement
    rows = at_bearings.ravel()
    free = -forces[:, rows]
    for alike, w in runs_by_frequency(dataset.frequencies):
        if len(unmeasured):
            known = apply(rotor, unmeasured, measured, w, speeds, displacement[..., alike])
            right = forces[:, unmeasured][..., alike] - known
            response[np.ix_(np.arange(len(speeds)), unmeasured, alike)] = solve(
                banded(rotor, unmeasured), w, speeds, right
            )
        free[..., alike] += apply(rotor, rows, everything, w, speeds, response[..., alike])
    shape = (len(speeds), len(rotor.bearing_nodes), 2, len(dataset.runs))
    return BearingEquations(
        rotor.bearing_nodes,
        speeds,
        dataset.frequencies,
        free.reshape(shape).swapaxes(0, 1),
        response[:, rows].reshape(shape).swapaxes(0, 1),
    )
