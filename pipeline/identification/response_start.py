"""Where the response fit starts: weighted linear least squares of the expanded residual, in the network's features.

From a random start the output error may stick; the residual, linear in the coefficients, has one answer. Where the
sensors are too few to tell the forces at the bearings, the start is the configured guess.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pipeline.equations.noise import whitened
from pipeline.equations.response import ResponseBlock, ResponseEquations, expansion
from pipeline.equations.unknown_system import UnknownSystem, unknown_system
from pipeline.rotor.bearing_table import BearingTable
from pipeline.unknowns import UnknownSet

_ROUNDS = 3
"""The noise of the residual depends on the coefficients: so often the weights are made again."""
_OUTLIER = 3.0
"""Rows beyond so many standard deviations count less."""


def linear_start(
    equations: ResponseEquations,
    measured: np.ndarray,
    deviation: np.ndarray,
    unknowns: UnknownSet,
    known: BearingTable,
    features: np.ndarray,
    scale: np.ndarray,
) -> np.ndarray | None:
    """Unknowns (M, S, U) in N/m and N s/m as combinations of the ``features`` (M, S, K); None for too few sensors.

    ``measured`` and ``deviation`` are (S, P, R) in m, ``scale`` (M, U) sizes of the unknowns.
    """
    if equations.planes:
        equations, measured, deviation = differences(equations, measured, deviation)
    expanded = expansion(equations, measured, deviation)
    if expanded is None:
        return None
    alike = len(features) < len(equations.bearing_nodes)
    system = unknown_system(expanded.equations, unknowns, known)
    covariance, values = expanded.force_covariance, None
    for _ in range(_ROUNDS):
        white = whitened(system, covariance, alike)
        values = _combination(white, features, scale)
        covariance = expanded.residual_covariance(equations, known.with_unknowns(unknowns, values))
    return values


def differences(
    equations: ResponseEquations, measured: np.ndarray, deviation: np.ndarray
) -> tuple[ResponseEquations, np.ndarray, np.ndarray]:
    """The synchronous runs less the first of them: a residual unbalance, the same in all, cancels exactly."""
    blocks: list[ResponseBlock] = []
    values, deviations = [], []
    for block in equations.blocks:
        runs = block.runs
        synchronous = block.unit_sensors.shape[-1] > 0
        if synchronous and len(runs) > 1:
            first, rest = runs[0], runs[1:]
            values.append(measured[..., rest] - measured[..., [first]])
            deviations.append(np.hypot(deviation[..., rest], deviation[..., [first]]))
            forced_s, forced_b = block.forced_sensors, block.forced_bearings
            block = replace(
                block,
                forced_sensors=forced_s[..., 1:] - forced_s[..., :1],
                forced_bearings=forced_b[..., 1:] - forced_b[..., :1],
            )
        else:
            values.append(measured[..., runs])
            deviations.append(deviation[..., runs])
        count = sum(value.shape[-1] for value in values)
        blocks.append(replace(block, runs=np.arange(count - values[-1].shape[-1], count)))
    made = replace(equations, planes=(), blocks=tuple(blocks))
    return made, np.concatenate(values, axis=-1), np.concatenate(deviations, axis=-1)


def _combination(white: UnknownSystem, features: np.ndarray, scale: np.ndarray) -> np.ndarray:
    """(M, S, U) least squares of ``A (Phi a) + y``, robust against single bad rows."""
    members, n_speeds, _, n_unknowns = white.matrix.shape
    values = np.zeros((members, n_speeds, n_unknowns))
    for m in range(members):
        present = white.unknowns.present[m]
        matrix = white.matrix[m][..., present] * scale[m, present]
        weight = np.ones(matrix.shape[:2])
        for _ in range(_ROUNDS):
            rows = np.einsum("sru,sk->sruk", matrix * weight[..., None], features[m])
            flat = rows.reshape(-1, rows.shape[2] * rows.shape[3])
            found = np.linalg.lstsq(flat, -(white.offset[m] * weight).ravel(), rcond=_NEGLIGIBLE)[0]
            outputs = features[m] @ found.reshape(rows.shape[2], rows.shape[3]).T
            rest = np.einsum("sru,su->sr", matrix, outputs) + white.offset[m]
            size = _OUTLIER * max(np.median(np.abs(rest)) / _MEDIAN_OF_NORMAL, _TINY)
            weight = np.sqrt(np.minimum(1.0, size / np.maximum(np.abs(rest), _TINY)))
        values[m][:, present] = outputs * scale[m, present]
    return values


_NEGLIGIBLE = 1e-10
_TINY = 1e-300
_MEDIAN_OF_NORMAL = 0.6745
