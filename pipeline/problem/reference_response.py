"""The rotor on reference bearings, solved: what :mod:`pipeline.problem.response` starts from, and its derivatives.

Casings are places besides the bearings, where nothing changes until a support does.

With ``D X = right`` on the reference bearings, a parameter of the model moves what rows c show of the solution by
``c dX = (D'^-1 c')' (d right - dD X)``: one adjoint solution serves all parameters.

Legend: S speeds, P channels, R runs, B bearings and casings, N balance planes, T model parameters, n lateral DOF. SI
units.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from pipeline.data.dataset import VibrationDataset, assemble_forces, group_runs, synchronous
from pipeline.parameters.geometry import bow_change, bow_force
from pipeline.parameters.kind import ModelParameter, turns_with_rotor
from pipeline.parameters.model import rotor_change, update_rotor
from pipeline.parameters.probes import runout, sensor_change, sensor_matrix
from pipeline.parameters.weights import force_changes, update_excitations
from pipeline.problem.response import ResponseBlock, ResponseEquations
from pipeline.rotor.dynamic_stiffness import apply, banded, coupled, solve
from pipeline.rotor.interpolation import bearing_places
from pipeline.rotor.model import RotorModel, casing_dof, translation_dof

REFERENCE_LOSS = 1.0
"""Loss factor of the reference bearings, ``H0 = k (1 + j)``: so damped, they have no resonance that costs digits."""


def _split(
    runs: np.ndarray, frequencies: np.ndarray, n_planes: int, at_bearings: np.ndarray, at_sensors: np.ndarray
) -> ResponseBlock:
    """The block of responses (.., S, 2 B, R + N + 2 B) and (.., S, P, R + N + 2 B), as :func:`_solved` orders them."""
    cuts = [len(runs), len(runs) + n_planes]
    forced_bearings, unit_bearings, receptance_bearings = np.split(at_bearings, cuts, axis=-1)
    forced_sensors, unit_sensors, receptance_sensors = np.split(at_sensors, cuts, axis=-1)
    return ResponseBlock(
        runs=runs,
        frequencies=frequencies,
        forced_sensors=forced_sensors,
        forced_bearings=forced_bearings,
        receptance_sensors=receptance_sensors,
        receptance_bearings=receptance_bearings,
        unit_sensors=unit_sensors,
        unit_bearings=unit_bearings,
    )


def _solved(
    rotor: RotorModel, dataset: VibrationDataset, reference: complex, planes: Sequence[int], bow: np.ndarray | None
) -> Iterator[tuple[np.ndarray, np.ndarray, int, np.ndarray]]:
    """Runs (indices) that share their frequencies (S,) rad/s, each block of them on reference bearings.

    With them how many planes N count, 0 where the runs are not synchronous, and the response (S, n, R + N + 2 B) of the
    forces, of 1 kg m at each plane, of 1 N at each bearing. Each run's own response is at its own frequencies.

    Runs that turn with the rotor are one block, though each has a speed of its own. What the weights do on the
    reference bearings is that of the run's own speed; what other bearings change of it is that of the mean. The error
    is of first order in the departure, times the amplification: under 3 % of the response for records within 0.5 %.
    """
    speeds, places = dataset.speeds, bearing_places(rotor)
    held = np.eye(rotor.n_dof)[:, casing_dof(rotor).ravel()]
    impedance = places.spread(np.broadcast_to(reference * np.eye(2), (len(places.dof), len(speeds), 2, 2)))
    loads = np.hstack([places.loads(rotor.n_dof), held])
    forces = assemble_forces(rotor, dataset.excitations, dataset.runs, dataset.frequencies)
    if bow is not None:
        forces = forces + bow[:, None] * turns_with_rotor(dataset)
    system, frequencies = banded(rotor), dataset.frequencies
    turning = np.flatnonzero(turns_with_rotor(dataset))
    blocks = [*group_runs(frequencies)]
    if len(turning) > 0 and (frequencies[:, turning] != frequencies[:, turning[:1]]).any():
        rest = np.setdiff1d(np.arange(len(dataset.runs)), turning)
        others = group_runs(frequencies[:, rest]) if len(rest) else ()
        blocks = [(turning, frequencies[:, turning].mean(axis=1)), *((rest[runs], w) for runs, w in others)]
    for runs, w in blocks:
        turning_planes = list(planes) if synchronous(w, speeds).all() else []
        width = len(runs) + len(turning_planes) + loads.shape[1]
        right = np.zeros((len(speeds), rotor.n_dof, width), dtype=complex)
        right[..., : len(runs)] = forces[..., runs]
        for n, node in enumerate(turning_planes):
            right[:, translation_dof(node, 0), len(runs) + n] = w**2
            right[:, translation_dof(node, 1), len(runs) + n] = -1j * w**2
        right[..., len(runs) + len(turning_planes) :] = loads
        response = solve(system, w, speeds, right, impedance, places.dof)
        apart = np.flatnonzero((dataset.frequencies[:, runs] != w[:, None]).any(axis=0))
        if len(apart):  # (S, r) systems of one right side each, as (S r,)
            alone = solve(
                system,
                dataset.frequencies[:, runs[apart]].ravel(),
                np.repeat(speeds, len(apart)),
                right[..., apart].swapaxes(1, 2).reshape(-1, rotor.n_dof, 1),
                np.repeat(impedance, len(apart), axis=1),
                places.dof,
            )
            response[..., apart] = alone.reshape(len(speeds), len(apart), -1).swapaxes(1, 2)
        yield runs, w, len(turning_planes), response


def _show(rotor: RotorModel, response: np.ndarray) -> np.ndarray:
    """(S, 2 B, ..) at bearings and casings, of a response (S, n, ..)."""
    return np.concatenate([bearing_places(rotor).show(response), response[:, casing_dof(rotor).ravel()]], axis=1)


def response_equations(
    rotor: RotorModel,
    dataset: VibrationDataset,
    stiffness: float,
    planes: Sequence[int] = (),
    sensors: np.ndarray | None = None,
    bow: np.ndarray | None = None,
) -> ResponseEquations:
    """Solve the rotor on reference bearings of about the ``stiffness`` (N/m), any value of the bearings' order.

    ``sensors`` (P, n) is what the channels show; None for what the data set says of them. ``bow`` (n,) N, complex, is a
    force that turns with the shaft in every run that does.
    """
    reference = stiffness * (1 + 1j * REFERENCE_LOSS)
    seen = dataset.sensor_matrix(rotor) if sensors is None else sensors
    solved = _solved(rotor, dataset, reference, planes, bow)
    blocks = tuple(
        _split(runs, w, n_planes, _show(rotor, response), seen @ response) for runs, w, n_planes, response in solved
    )
    return ResponseEquations(rotor.bearing_nodes, dataset.speeds, reference, tuple(planes), blocks)


def response_variations(
    rotor: RotorModel,
    dataset: VibrationDataset,
    stiffness: float,
    planes: Sequence[int],
    parameters: Sequence[ModelParameter],
) -> tuple[ResponseBlock, ...]:
    """The derivatives of every block by the parameters, leading with T, at their values.

    ``rotor`` and ``dataset`` are the stated ones. Bearings are not varied here: they follow from their coefficients.
    Empty without parameters.
    """
    if not parameters:
        return ()
    updated, data = update_rotor(rotor, parameters), update_excitations(dataset, parameters)
    sensors, bow = sensor_matrix(dataset, updated, parameters), bow_force(parameters, rotor)
    places, system, ground = bearing_places(updated), banded(updated), casing_dof(updated).ravel()
    forces = force_changes(parameters, rotor, dataset)
    reference, speeds, turns = stiffness * (1 + 1j * REFERENCE_LOSS), dataset.speeds, turns_with_rotor(dataset)
    impedance = places.spread(np.broadcast_to(reference * np.eye(2), (len(places.dof), len(speeds), 2, 2)))
    blocks, rows = [], places.loads(updated.n_dof).T
    shown = np.concatenate([rows, np.eye(updated.n_dof)[ground], sensors])  # at bearings, at casings, and by probes
    count, right = len(rows) + len(ground), np.broadcast_to(shown.T, (len(speeds), *shown.T.shape))
    for runs, w, n_planes, solved in _solved(updated, data, reference, planes, bow):
        adjoint = solve(system, w, speeds, right, impedance, places.dof, transposed=True).swapaxes(1, 2)  # (S, .., n)
        pushed, felt, forced = adjoint @ rows.T, rows @ solved, slice(0, len(runs))
        loaded, changes = slice(solved.shape[-1] - count, solved.shape[-1] - len(ground)), []
        for parameter, force in zip(parameters, forces, strict=True):
            variation = np.zeros((*adjoint.shape[:2], solved.shape[-1]), dtype=complex)
            if (change := rotor_change(parameter, rotor)) is not None:
                at = coupled(change)
                variation -= parameter.slope * adjoint[..., at] @ apply(change, at, at, w, speeds, solved[:, at])
            if force is not None:
                variation[..., forced] += adjoint @ force[..., runs]
            if (bent := bow_change(parameter, rotor)) is not None:
                variation[..., forced] += (adjoint @ bent)[..., None] * turns[runs]
            if parameter.row.derive_places:
                # With the bearings' rows c on the matrices, D + c' H0 c has the derivative dc' H0 c + c' H0 dc.
                slopes = parameter.deviation * parameter.row.derive_places(updated, parameter.place)
                turned = adjoint @ slopes.T
                variation -= reference * (turned @ felt + pushed @ (slopes @ solved))
                variation[..., loaded] += turned
                variation[:, : len(rows)] += slopes @ solved  # the bearings' own motion
            if (seen := sensor_change(parameter, dataset, updated, parameters)) is not None:
                variation[:, count:] += seen @ solved
            # What the sensors show besides is none of the rotor's.
            if (vector := runout([replace(parameter, value=1.0)], data)).any():
                variation[:, count:, forced] += vector[..., runs]
            changes.append(variation)
        every = np.stack(changes)
        blocks.append(_split(runs, w, n_planes, every[:, :, :count], every[:, :, count:]))
    return tuple(blocks)
