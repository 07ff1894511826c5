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

from pipeline.data.dataset import Excitation
from pipeline.data.sensors import list_directions, project
from pipeline.methods.method import (
    Estimate,
    MethodOptions,
    Refusal,
    describe_sensors,
    describe_unbalance,
    make_estimate,
    require_bearing_equations,
)
from pipeline.parameters.kind import turns_with_rotor
from pipeline.problem.measurement import Measurement
from pipeline.problem.noise import DEPENDENT, linear_deviation
from pipeline.problem.residual import BearingEquations, bearing_equations, linear_residual


def identify_by_frequencies(measurement: Measurement, options: MethodOptions) -> Estimate:
    """Coefficients of each speed by itself; raises Refusal for data of one frequency a speed."""
    planes, unknowns = measurement.unknowns.planes, measurement.unknowns
    data, channels = measurement, list_directions(measurement.rotor.bearing_nodes)
    if planes:  # the motion of the bearings alone: they then feel an unbalance anywhere on the shaft
        if not set(channels) <= set(measurement.dataset.channels):
            raise Refusal("bearings_not_measured", f"the sensors are at {describe_sensors(measurement)}")
        data = replace(measurement, dataset=project(measurement.dataset, channels))
    dataset = data.dataset
    frequencies = [len(np.unique(np.round(frequency, 9))) for frequency in dataset.frequencies]
    equations = require_bearing_equations(data)
    if min(frequencies) < 2:
        raise Refusal("one_frequency", "every run turns with the rotor")
    matrix, offset = _join(data, equations)
    length = np.linalg.norm(matrix, axis=1, keepdims=True)
    if matrix.shape[1] < matrix.shape[2] or (np.linalg.cond(matrix / length) > 1 / DEPENDENT).any():
        raise Refusal("not_determined", f"{dataset.frequencies.shape[1]} runs give {matrix.shape[1]} equations a speed")
    inverse = np.linalg.pinv(matrix / length) / length.swapaxes(1, 2)
    answer = -np.einsum("svr,sr->sv", inverse, offset)  # (S, A + 2 N)
    values = unknowns.from_active(answer)
    root = data.residual_root(data.table(values))
    deviation = unknowns.from_active(linear_deviation(inverse, root))
    text = f"{min(frequencies)} frequencies a speed"
    if planes:
        pairs = answer[:, len(unknowns.active) :].reshape(len(answer), -1, 2)
        median = np.median(pairs, axis=0) @ np.array([1.0, 1j])
        text += describe_unbalance(planes, median)
    return make_estimate(data, values, deviation, text)


def _join(data: Measurement, equations: BearingEquations) -> tuple[np.ndarray, np.ndarray]:
    """A (S, rows, A + 2 N) and y (S, rows) of all bearings together; rows as LinearResidual has them."""
    residual = linear_residual(equations, data.unknowns, data.known)
    n_bearings, n_speeds, n_rows, _ = residual.matrix.shape
    columns = []
    for m, u in data.unknowns.active:
        mine = 1.0 if data.unknowns.shared else (np.arange(n_bearings) == m)[:, None, None]
        columns.append((residual.matrix[..., u] * mine).swapaxes(0, 1).reshape(n_speeds, -1))
    turning = [run for run, turns in zip(data.dataset.runs, turns_with_rotor(data.dataset), strict=True) if turns]
    still = replace(data.dataset, displacement=np.zeros_like(data.dataset.displacement))
    for node in data.unknowns.planes:  # the derivative by an unbalance, kg m, which is zero in runs that do not turn
        unit = replace(still, excitations=tuple(Excitation(run, "unbalance", node, 1.0, 0.0) for run in turning))
        force = bearing_equations(data.rotor, unit).free_residual.swapaxes(0, 1)  # (S, B, 2, R)
        for component in (force, 1j * force):
            flat = component.reshape(n_speeds, n_bearings, -1)
            columns.append(np.concatenate([flat.real, flat.imag], axis=2).reshape(n_speeds, n_bearings * n_rows))
    return np.stack(columns, axis=-1), residual.offset.swapaxes(0, 1).reshape(n_speeds, -1)
