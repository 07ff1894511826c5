"""Impulses, or forces of several frequencies, at a fixed rotor speed: all coefficients at once, and the unbalance.

At a fixed speed the coefficients are the same at every frequency w of the response to an impulse, and each spectral
line gives ``(K + j w C) q_b + g = 0``. All lines together are solved by least squares for the coefficients of both
bearings (Qiu and Tieu 1997) and, from the lines that turn with the rotor, for the unbalance that is left in it
(Tiwari and Chakravarthy 2006).

Legend: B bearings, S speeds, R runs (the spectral lines of a speed), U unknowns, A of them that members have, N planes.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pipeline.comparison.method import Estimate, Reason, Refusal, Task
from pipeline.data.dataset import Excitation, VibrationDataset
from pipeline.data.sensors import both_directions, seen_by
from pipeline.equations.bearing_equations import BearingEquations, bearing_equations
from pipeline.equations.identifiability import DEPENDENT
from pipeline.equations.noise import linear_deviation, residual_covariance
from pipeline.equations.unknown_system import unknown_system


def multi_frequency(task: Task) -> Estimate:
    """Coefficients of each speed by itself; raises Refusal for data of one frequency a speed."""
    dataset = _at_bearings(task) if task.identify.unbalance_planes else task.dataset
    frequencies = [len(np.unique(np.round(of, 9))) for of in dataset.frequencies]
    equations = task.equations
    if min(frequencies) < 2:
        raise Refusal(Reason.ONE_FREQUENCY, "every run turns with the rotor")
    if dataset is not task.dataset:
        equations = bearing_equations(task.rotor, dataset)
    matrix, offset = _joined(task, equations, dataset)
    length = np.linalg.norm(matrix, axis=1, keepdims=True)
    left, singular, right = np.linalg.svd(matrix / length, full_matrices=False)
    if matrix.shape[1] < matrix.shape[2] or (singular[:, -1] < DEPENDENT * singular[:, 0]).any():
        raise Refusal(
            Reason.NOT_DETERMINED, f"{dataset.frequencies.shape[1]} runs give {matrix.shape[1]} equations a speed"
        )
    inverse = np.einsum("skv,sk,srk->svr", right, 1 / singular, left) / length[:, 0, :, None]
    answer = -np.einsum("svr,sr->sv", inverse, offset)  # (S, A + 2 N)
    values = task.active_values(answer)
    covariance = residual_covariance(task.rotor, dataset, task.table(values), _deviation(task, dataset))
    deviation = task.active_values(linear_deviation(inverse, covariance))
    words = f"{min(frequencies)} frequencies a speed"
    if task.identify.unbalance_planes:
        pairs = answer[:, len(task.active) :].reshape(len(answer), -1, 2)
        found = np.median(pairs, axis=0) @ np.array([1.0, 1j])
        planes = zip(task.identify.unbalance_planes, found, strict=True)
        words += ", residual unbalance " + ", ".join(f"{1e6 * abs(u):.3g} g mm at node {node}" for node, u in planes)
    return task.estimate(values, deviation, words)


def _at_bearings(task: Task) -> VibrationDataset:
    """The motion of the bearings alone: they then feel an unbalance anywhere on the shaft."""
    channels = both_directions(task.rotor.bearing_nodes)
    if not set(channels) <= set(task.dataset.channels):
        raise Refusal(Reason.BEARINGS_NOT_MEASURED, f"the sensors are at {task.sensors}")
    return seen_by(task.dataset, channels)


def _deviation(task: Task, dataset: VibrationDataset) -> np.ndarray:
    place = [task.dataset.channels.index(channel) for channel in dataset.channels]
    return task.deviation[:, place]


def _joined(task: Task, equations: BearingEquations, dataset: VibrationDataset) -> tuple[np.ndarray, np.ndarray]:
    """A (S, rows, A + 2 N) and y (S, rows) of all bearings together; rows as UnknownSystem has them."""
    system = unknown_system(equations, task.unknowns, task.known)
    n_bearings, n_speeds, n_rows, _ = system.matrix.shape
    columns = []
    for m, u in task.active:
        own = system.matrix[..., u] * (1.0 if task.alike else (np.arange(n_bearings) == m)[:, None, None])
        columns.append(own.swapaxes(0, 1).reshape(n_speeds, -1))
    for node in task.identify.unbalance_planes:
        force = _unit_unbalance(task, dataset, node).swapaxes(0, 1)  # (S, B, 2, R)
        for part in (force, 1j * force):
            flat = part.reshape(n_speeds, n_bearings, -1)
            columns.append(np.concatenate([flat.real, flat.imag], axis=2).reshape(n_speeds, n_bearings * n_rows))
    return np.stack(columns, axis=-1), system.offset.swapaxes(0, 1).reshape(n_speeds, -1)


def _unit_unbalance(task: Task, dataset: VibrationDataset, node: int) -> np.ndarray:
    """(B, S, 2, R) derivative of the residual by an unbalance (kg m) at the node; zero in runs that do not turn."""
    turning = [run for run, turns in zip(dataset.runs, task.synchronous(), strict=True) if turns]
    still = replace(
        dataset,
        displacement=np.zeros_like(dataset.displacement),
        excitations=tuple(Excitation(run, "unbalance", node, 1.0, 0.0) for run in turning),
    )
    return bearing_equations(task.rotor, still).free_residual
