"""The rotor on reference bearings, solved: what :mod:`pipeline.problem.response` starts from, and its derivatives.

With ``D X = right`` on the reference bearings, a parameter of the model moves the solution by
``dX = D^-1 (d right - dD X)``, with the same factors for all of them.

Legend: S speeds, P channels, R runs, B bearings, N balance planes, T model parameters, n lateral DOF. SI units.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from pipeline.data.dataset import VibrationDataset, assemble_forces, group_runs, synchronous
from pipeline.problem.model_parameters import (
    force_change,
    runout,
    sensor_change,
    sensor_matrix,
    turns_with_rotor,
    update_excitations,
)
from pipeline.problem.response import ResponseBlock, ResponseEquations
from pipeline.rotor.dynamic_stiffness import apply, banded, solve
from pipeline.rotor.model import RotorModel, bearing_dof, translation_dof
from pipeline.rotor.parameters import ModelParameter, rotor_change, update_rotor

REFERENCE_LOSS = 1.0
"""Loss factor of the reference bearings, ``H0 = k (1 + j)``: so damped, they have no resonance that costs digits."""


@dataclass(frozen=True, eq=False, kw_only=True)
class _Solved:
    """Runs that share their frequencies, on the reference bearings."""

    runs: np.ndarray  # (R,) indices
    frequencies: np.ndarray  # (S,) rad/s
    planes: int  # N; 0 where the runs are not synchronous
    response: np.ndarray  # (S, n, R + N + 2 B): of the forces, of 1 kg m at each plane, of 1 N at each bearing

    def block(self, at_bearings: np.ndarray, at_sensors: np.ndarray) -> ResponseBlock:
        """The block of these responses, (.., S, 2 B, R + N + 2 B) and (.., S, P, R + N + 2 B)."""
        cuts = [len(self.runs), len(self.runs) + self.planes]
        forced_bearings, unit_bearings, receptance_bearings = np.split(at_bearings, cuts, axis=-1)
        forced_sensors, unit_sensors, receptance_sensors = np.split(at_sensors, cuts, axis=-1)
        return ResponseBlock(
            runs=self.runs,
            frequencies=self.frequencies,
            forced_sensors=forced_sensors,
            forced_bearings=forced_bearings,
            receptance_sensors=receptance_sensors,
            receptance_bearings=receptance_bearings,
            unit_sensors=unit_sensors,
            unit_bearings=unit_bearings,
        )


def _solved(
    rotor: RotorModel, dataset: VibrationDataset, reference: complex, planes: Sequence[int]
) -> Iterator[_Solved]:
    """Every block of runs on reference bearings. Each run's own response is at its own frequencies."""
    speeds, at_bearings = dataset.speeds, bearing_dof(rotor)
    impedance = _impedance(rotor, len(speeds), reference)
    forces = assemble_forces(rotor, dataset.excitations, dataset.runs, dataset.frequencies)
    system = banded(rotor)
    for runs, w in _group_alike(dataset):
        own_planes = list(planes) if synchronous(w, speeds).all() else []
        width = len(runs) + len(own_planes) + at_bearings.size
        right = np.zeros((len(speeds), rotor.n_dof, width), dtype=complex)
        right[..., : len(runs)] = forces[..., runs]
        for n, node in enumerate(own_planes):
            right[:, translation_dof(node, 0), len(runs) + n] = w**2
            right[:, translation_dof(node, 1), len(runs) + n] = -1j * w**2
        right[:, at_bearings.ravel(), len(runs) + len(own_planes) + np.arange(at_bearings.size)] = 1.0
        response = solve(system, w, speeds, right, impedance, at_bearings)
        for i, run in enumerate(runs):
            own = dataset.frequencies[:, run]
            if (own != w).any():
                response[..., [i]] = solve(system, own, speeds, right[..., [i]], impedance, at_bearings)
        yield _Solved(runs=runs, frequencies=w, planes=len(own_planes), response=response)


def _group_alike(dataset: VibrationDataset) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Runs (indices) in blocks, and the frequencies (S,) rad/s at which the receptance of the block is taken.

    Runs that turn with the rotor are one block, though each has a speed of its own: the receptance of the reference
    bearings changes little within :data:`pipeline.data.dataset.SYNCHRONOUS`.
    """
    frequencies = dataset.frequencies
    turning = np.flatnonzero(turns_with_rotor(dataset))
    unlike = len(turning) > 0 and (frequencies[:, turning] != frequencies[:, turning[:1]]).any()
    if not unlike:
        yield from group_runs(frequencies)
        return
    yield turning, frequencies[:, turning].mean(axis=1)
    rest = np.setdiff1d(np.arange(len(dataset.runs)), turning)
    if len(rest):
        yield from ((rest[runs], w) for runs, w in group_runs(frequencies[:, rest]))


def _impedance(rotor: RotorModel, n_speeds: int, reference: complex) -> np.ndarray:
    return np.broadcast_to(reference * np.eye(2), (len(rotor.bearing_nodes), n_speeds, 2, 2))


def response_equations(
    rotor: RotorModel,
    dataset: VibrationDataset,
    stiffness: float,
    planes: Sequence[int] = (),
    sensors: np.ndarray | None = None,
) -> ResponseEquations:
    """Solve the rotor on reference bearings of about the ``stiffness`` (N/m), any value of the bearings' order.

    ``sensors`` (P, n) is what the channels show; None for what the data set says of them.
    """
    rows, reference = bearing_dof(rotor).ravel(), stiffness * (1 + 1j * REFERENCE_LOSS)
    seen = dataset.sensor_matrix(rotor.n_dof) if sensors is None else sensors
    solved = _solved(rotor, dataset, reference, planes)
    blocks = tuple(one.block(one.response[:, rows], seen @ one.response) for one in solved)
    return ResponseEquations(rotor.bearing_nodes, dataset.speeds, reference, tuple(planes), blocks)


def response_variations(
    rotor: RotorModel,
    dataset: VibrationDataset,
    stiffness: float,
    planes: Sequence[int],
    parameters: Sequence[ModelParameter],
    values: np.ndarray,
) -> tuple[ResponseBlock, ...]:
    """The derivatives of every block by the parameters, leading with T, at their ``values`` (T,).

    ``rotor`` and ``dataset`` are the stated ones. Bearings are not varied here: they follow from their coefficients.
    """
    moved, data = update_rotor(rotor, parameters, values), update_excitations(dataset, parameters, values)
    sensors = sensor_matrix(dataset, rotor.n_dof, parameters, values)
    rows, everything, system = bearing_dof(rotor), np.arange(rotor.n_dof), banded(moved)
    reference, speeds = stiffness * (1 + 1j * REFERENCE_LOSS), dataset.speeds
    impedance, blocks = _impedance(rotor, len(speeds), reference), []
    for one in _solved(moved, data, reference, planes):
        at_bearings, at_sensors = [], []
        for parameter, value in zip(parameters, values, strict=True):
            right = np.zeros_like(one.response)
            if (change := rotor_change(parameter, rotor)) is not None:
                right -= apply(change, everything, everything, one.frequencies, speeds, one.response)
            if (force := force_change(parameter, rotor, data, float(value))) is not None:
                right[..., : len(one.runs)] += force[..., one.runs]
            response = right
            if right.any():  # the probes and the known coefficients move nothing on the reference bearings
                response = solve(system, one.frequencies, speeds, right, impedance, rows)
            shown = sensors @ response
            if (seen := sensor_change(parameter, dataset, rotor.n_dof, parameters, values)) is not None:
                shown = shown + seen @ one.response
            if parameter.kind == "runout":  # what the sensors show besides is none of the rotor's
                vector = runout([parameter], np.ones(1), len(dataset.channels))
                shown[..., : len(one.runs)] += vector[:, None] * turns_with_rotor(dataset)[one.runs]
            at_bearings.append(response[:, rows.ravel()])
            at_sensors.append(shown)
        blocks.append(one.block(np.stack(at_bearings), np.stack(at_sensors)))
    return tuple(blocks)
