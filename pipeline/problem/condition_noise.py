"""The noise of a data set whose runs are the means of a condition's records: correlated over probes and speeds.

Legend: S speeds, P channels, R runs (one a condition), D = S P (index s * P + p).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pipeline.data.conditions import Conditions
from pipeline.data.dataset import Excitation, VibrationDataset
from pipeline.data.sensors import NoiseModel
from pipeline.problem.noise_levels import NoiseLevels, estimate_noise_levels, levels_of, student_weights

NAMED = 0.3
"""A condition whose weight is below this is named: of conditions that belong together, one in a thousand."""


NO_LEVELS = NoiseLevels(np.zeros((0, 0, 0), dtype=complex), np.zeros((0, 0), dtype=complex), 0.0)
"""Noise that is not in levels: nothing ties readings together."""


def follow_residuals(noise: NoiseLevels, residual: np.ndarray, numbers: float, rounds: int = 50) -> NoiseLevels:
    """The noise that residuals (R, D) complex, m, of a fit of so many real ``numbers`` show.

    Where the fitted model can't follow the data, its misfit is part of the condition level: as large and in such
    directions as the data show it.
    """
    left = len(residual) - numbers / (2 * residual.shape[1])
    weights = noise.weights
    for _ in range(rounds):
        weights = student_weights(residual, weights, left)
    levels = levels_of(residual, weights, left, noise.record, noise.counts)
    return replace(levels, counts=noise.counts, weights=weights)


def condition_noise(conditions: Conditions, beside: NoiseModel | None = None) -> NoiseLevels:
    """The levels that the data themselves show, whatever the rotor is.

    Each probe's vector is taken for a free baseline and a free linear function of the weights U and of U |U|: what is
    left over is no matter of the bearings. ``beside`` is what a model may be off by beyond that in each probe
    and speed, in all conditions alike. Raises IdentifiabilityError for too few conditions.
    """
    loads = conditions.unbalance[:, np.abs(conditions.unbalance).any(axis=0)]
    design = np.concatenate([np.ones((len(loads), 1)), loads, loads * np.abs(loads)], axis=1)
    size = np.linalg.norm(design, axis=0)
    levels, weights = estimate_noise_levels(conditions, design / np.where(size > 0, size, 1.0))
    if beside is not None:
        # An error of the model is the same in all conditions: many of them do not average it.
        variance = len(loads) * (beside.deviation(conditions.vectors) ** 2).mean(axis=0)
        levels = replace(levels, condition=levels.condition + np.diag(variance))
    return replace(levels, counts=conditions.counts, weights=weights)


def suffices(conditions: Conditions, enough: int = 2) -> bool:
    """Whether there are conditions ``enough``, for each entry of a vector, to estimate the levels of their noise; they
    must have been read at every speed.
    """
    return len(conditions.names) > enough * int(conditions.vectors.shape[1]) and conditions.complete


def spread_conditions(
    unbalance: np.ndarray, planes: tuple[int, ...], speeds: np.ndarray, channels: tuple[tuple[int, float], ...]
) -> Conditions:
    """Conditions with weights (C, N) kg m at the ``speeds`` (S,) rad/s, of which nothing was read."""
    count, shape = len(unbalance), (len(unbalance), len(speeds), len(channels))
    return Conditions(
        names=tuple(map(str, range(count))),
        speeds=speeds,
        own_speeds=np.tile(speeds, (count, 1)),
        displacement=np.zeros(shape, dtype=complex),
        counts=np.ones(count),
        channels=channels,
        planes=planes,
        unbalance=unbalance,
        record_covariance=np.zeros((len(speeds), len(channels), len(channels)), dtype=complex),
    )


def to_dataset(conditions: Conditions) -> VibrationDataset:
    """The data set with one run a condition: the mean of its records, at their mean speed, where there are some."""
    acting = tuple(
        Excitation(name, "unbalance", node, float(np.abs(u)), float(np.angle(u)))
        for name, loads in zip(conditions.names, conditions.unbalance, strict=True)
        for node, u in zip(conditions.planes, loads, strict=True)
    )
    displacement = np.nan_to_num(conditions.displacement.transpose(1, 2, 0))
    present = np.isfinite(conditions.own_speeds.T)
    speeds = np.where(present, conditions.own_speeds.T, conditions.speeds[:, None])
    return VibrationDataset(
        conditions.speeds, conditions.names, conditions.channels, displacement, acting, speeds, present=present
    )
