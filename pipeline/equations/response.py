"""What the sensors would measure, as a function of the bearings: a small system, whatever the number of nodes.

On reference bearings H0 the rotor has the forced response u0 and the receptance a (displacements of a unit force at the
bearings). Bearings H = H0 + dH change the force on the shaft by ``-dH q_b``, so that

    q_b = (I + a_bb dH)^-1 u0_b                        at the bearings
    q_s = u0_s - a_sb dH q_b                           at the sensors

and a derivative needs no further solution: with ``T = a_sb - a_sb dH (I + a_bb dH)^-1 a_bb``, the receptance of the
rotor on the bearings H, ``dq_s / dH_ij = -T_i q_bj``.

Where the sensors are enough to tell the forces at the bearings, least squares on ``q_s = u0_s + a_sb f`` gives f, the
motion q_b of the bearings follows, and ``r = f + dH q_b`` is the residual of the equation of motion (expansion).

Legend: S speeds, P channels, R runs, B bearings, N balance planes. SI units.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pipeline.data.dataset import VibrationDataset, force_vectors, runs_by_frequency
from pipeline.equations.bearing_equations import BearingEquations
from pipeline.rotor.bearing_table import BearingTable
from pipeline.rotor.dynamic_stiffness import banded, solve
from pipeline.rotor.model import RotorModel, bearing_dof, translation_dof

REFERENCE_LOSS = 1.0
"""Loss factor of the reference bearings, ``H0 = k (1 + j)``: so damped, they have no resonance that costs digits."""


@dataclass(frozen=True, eq=False)
class ResponseBlock:
    """Runs that share their frequencies, on the reference bearings."""

    runs: np.ndarray  # (R,) indices among the runs of the data
    frequencies: np.ndarray  # (S,) rad/s
    forced_sensors: np.ndarray  # u0_s, (S, P, R) complex, m
    forced_bearings: np.ndarray  # u0_b, (S, 2 B, R)
    receptance_sensors: np.ndarray  # a_sb, (S, P, 2 B) m/N
    receptance_bearings: np.ndarray  # a_bb, (S, 2 B, 2 B)
    unit_sensors: np.ndarray  # (S, P, N) of 1 kg m at each balance plane; N = 0 where the runs are not synchronous
    unit_bearings: np.ndarray  # (S, 2 B, N)

    def at(self, keep: np.ndarray, runs: np.ndarray) -> ResponseBlock:
        """The same at the speeds ``keep`` and for those of the ``runs`` that it has."""
        mine = np.isin(self.runs, runs)
        return ResponseBlock(
            self.runs[mine],
            self.frequencies[keep],
            self.forced_sensors[keep][..., mine],
            self.forced_bearings[keep][..., mine],
            self.receptance_sensors[keep],
            self.receptance_bearings[keep],
            self.unit_sensors[keep],
            self.unit_bearings[keep],
        )


@dataclass(frozen=True, eq=False)
class ResponseEquations:
    """The response at the sensors of every run and speed."""

    bearing_nodes: tuple[int, ...]  # B
    speeds: np.ndarray  # (S,) rad/s
    reference: complex  # H0 in x and y of every bearing, N/m
    planes: tuple[int, ...]  # N nodes of the residual unbalance
    blocks: tuple[ResponseBlock, ...]

    @property
    def n_runs(self) -> int:
        """R, of all blocks."""
        return sum(len(block.runs) for block in self.blocks)

    def predict(self, bearings: BearingTable, residual_unbalance: np.ndarray | None = None) -> np.ndarray:
        """(S, P, R) m, of the bearings at the same speeds; ``residual_unbalance`` (N,) complex, kg m."""
        first = self.blocks[0]
        result = np.empty((*first.forced_sensors.shape[:2], self.n_runs), dtype=complex)
        for block in self.blocks:
            change = self.change(bearings, block)
            forced_b, forced_s = block.forced_bearings, block.forced_sensors
            if residual_unbalance is not None and block.unit_sensors.shape[-1]:
                forced_b = forced_b + (block.unit_bearings @ residual_unbalance)[..., None]
                forced_s = forced_s + (block.unit_sensors @ residual_unbalance)[..., None]
            identity = np.eye(change.shape[-1])
            moved = np.linalg.solve(identity + block.receptance_bearings @ change, forced_b)
            result[..., block.runs] = forced_s - block.receptance_sensors @ (change @ moved)
        return result

    def sensitivity(self, bearings: BearingTable) -> np.ndarray:
        """(S, P, R, B, 8) derivative of :meth:`predict` by the coefficients, without residual unbalance."""
        first, n_bearings = self.blocks[0], len(self.bearing_nodes)
        result = np.empty((*first.forced_sensors.shape[:2], self.n_runs, n_bearings, 8), dtype=complex)
        for block in self.blocks:
            change, n_runs = self.change(bearings, block), len(block.runs)
            right = np.concatenate([block.forced_bearings, block.receptance_bearings], axis=-1)
            moved = np.linalg.solve(np.eye(change.shape[-1]) + block.receptance_bearings @ change, right)
            through = block.receptance_sensors @ (np.eye(change.shape[-1]) - change @ moved[..., n_runs:])
            through = through.reshape(*through.shape[:2], n_bearings, 2)
            orbits = moved[..., :n_runs].reshape(len(moved), n_bearings, 2, n_runs)
            by_stiffness = -np.einsum("spbi,sbjr->sprbij", through, orbits).reshape(
                *result.shape[:2], n_runs, n_bearings, 4
            )
            by_damping = 1j * block.frequencies[:, None, None, None, None] * by_stiffness
            result[:, :, block.runs] = np.concatenate([by_stiffness, by_damping], axis=-1)
        return result

    def change(self, bearings: BearingTable, block: ResponseBlock) -> np.ndarray:
        """dH, (S, 2 B, 2 B) N/m."""
        count = 2 * len(bearings.nodes)
        change = np.zeros((len(self.speeds), count, count), dtype=complex)
        for b, impedance in enumerate(bearings.impedance(block.frequencies)):
            change[:, 2 * b : 2 * b + 2, 2 * b : 2 * b + 2] = impedance
        change[:, np.arange(count), np.arange(count)] -= self.reference
        return change


def response_equations(
    rotor: RotorModel, dataset: VibrationDataset, stiffness: float, planes: Sequence[int] = ()
) -> ResponseEquations:
    """Solve the rotor on reference bearings of about the ``stiffness`` (N/m), any value of the bearings' order."""
    speeds, at_bearings = dataset.speeds, bearing_dof(rotor)
    rows, sensors = at_bearings.ravel(), dataset.sensor_matrix(rotor.n_dof)
    reference = stiffness * (1 + 1j * REFERENCE_LOSS)
    n_bearings, n_runs = len(at_bearings), len(dataset.runs)
    impedance = np.broadcast_to(reference * np.eye(2), (n_bearings, len(speeds), 2, 2))
    forces = force_vectors(rotor, dataset.excitations, dataset.runs, dataset.frequencies)
    system, blocks = banded(rotor), []
    for alike, w in runs_by_frequency(dataset.frequencies):
        own_planes = list(planes) if np.allclose(w, speeds, rtol=1e-9) else []
        right = np.zeros((len(speeds), rotor.n_dof, len(alike) + len(own_planes) + 2 * n_bearings), dtype=complex)
        right[..., : len(alike)] = forces[..., alike]
        for n, node in enumerate(own_planes):
            right[:, translation_dof(node, 0), len(alike) + n] = w**2
            right[:, translation_dof(node, 1), len(alike) + n] = -1j * w**2
        right[:, rows, len(alike) + len(own_planes) + np.arange(2 * n_bearings)] = 1.0
        response = solve(system, w, speeds, right, impedance, at_bearings)
        cuts = [len(alike), len(alike) + len(own_planes)]
        at_rows = np.split(response[:, rows], cuts, axis=2)
        at_sensors = np.split(sensors @ response, cuts, axis=2)
        blocks.append(
            ResponseBlock(alike, w, at_sensors[0], at_rows[0], at_sensors[2], at_rows[2], at_sensors[1], at_rows[1])
        )
    assert sum(len(block.runs) for block in blocks) == n_runs
    return ResponseEquations(rotor.bearing_nodes, speeds, reference, tuple(planes), tuple(blocks))


@dataclass(frozen=True, eq=False)
class Expansion:
    """The residual at the bearings, from whatever sensors there are, and what their noise makes of it."""

    equations: BearingEquations
    receptance: np.ndarray  # a_bb of every run, (S, R, 2 B, 2 B)
    force_covariance: np.ndarray  # of f, (S, R, 2 B, 2 B) N^2

    def residual_covariance(self, equations: ResponseEquations, bearings: BearingTable) -> np.ndarray:
        """(S, R, 2 B, 2 B) complex, N^2: ``dr = (I + dH a_bb) df``, near the ``bearings``."""
        result = np.empty_like(self.force_covariance)
        for block in equations.blocks:
            change = equations.change(bearings, block)[:, None]
            factor = np.eye(change.shape[-1]) + change @ self.receptance[:, block.runs]
            result[:, block.runs] = factor @ self.force_covariance[:, block.runs] @ factor.conj().swapaxes(-1, -2)
        return result


def expansion(equations: ResponseEquations, displacement: np.ndarray, deviation: np.ndarray) -> Expansion | None:
    """Forces and motion at the bearings by least squares, weighted by the noise; None where the sensors are too few.

    Args:
        displacement: (S, P, R) complex, m.
        deviation: (S, P, R) root mean square of its noise, m.
    """
    n_speeds, n_channels, n_runs = displacement.shape
    count = 2 * len(equations.bearing_nodes)
    if n_channels < count:
        return None
    force = np.empty((n_speeds, count, n_runs), dtype=complex)
    moved, receptance = np.empty_like(force), np.empty((n_speeds, n_runs, count, count), dtype=complex)
    covariance = np.empty_like(receptance)
    for block in equations.blocks:
        for i, run in enumerate(block.runs):
            weight = 1.0 / deviation[:, :, run]
            matrix = block.receptance_sensors * weight[..., None]
            length = np.linalg.norm(matrix, axis=1, keepdims=True)
            if (np.linalg.svd(matrix / length, compute_uv=False)[:, -1] < _DEPENDENT).any():
                return None
            inverse = np.linalg.pinv(matrix / length) / length.swapaxes(1, 2)
            found = inverse @ ((displacement[:, :, run] - block.forced_sensors[:, :, i]) * weight)[..., None]
            force[..., run] = found[..., 0]
            moved[..., run] = block.forced_bearings[..., i] + (block.receptance_bearings @ found)[..., 0]
            covariance[:, run] = inverse @ inverse.conj().swapaxes(1, 2)
            receptance[:, run] = block.receptance_bearings
    frequencies = np.empty((n_speeds, n_runs))
    for block in equations.blocks:
        frequencies[:, block.runs] = block.frequencies[:, None]
    shape = (n_speeds, len(equations.bearing_nodes), 2, n_runs)
    free = (force - equations.reference * moved).reshape(shape).swapaxes(0, 1)
    made = BearingEquations(
        equations.bearing_nodes, equations.speeds, frequencies, free, moved.reshape(shape).swapaxes(0, 1)
    )
    return Expansion(made, receptance, covariance)


_DEPENDENT = 1e-6
"""Sensors whose smallest singular value is below this share say nothing of some bearing force."""
