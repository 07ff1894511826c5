"""The unbalance that the vibration of each condition means, by one model, and whether any unbalance explains it.

Legend: C conditions, S speeds, P channels, N planes, D = S P.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pipeline.balance.bands import circle_radius, judge_distance
from pipeline.balance.inverse import Unbalance, estimate_unbalance
from pipeline.balance.linear_vibration import LinearVibration
from pipeline.balance.readings import Readings
from pipeline.errors import DataError
from pipeline.problem.noise_levels import NoiseLevels

INCONSISTENT = 0.01
"""Chance below which a vibration is called inconsistent with any unbalance: one sound condition in a hundred is."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Estimates:
    """The unbalance of every condition in every plane, without the machine's own; beside the known one."""

    readings: Readings
    found: tuple[Unbalance, ...]  # C
    chance: np.ndarray  # (C,) that a sound condition departs as far from any unbalance; NaN where it can't be known
    label_chance: np.ndarray  # (C,) the same of the known weights; NaN where there are none

    @property
    def unbalance(self) -> np.ndarray:
        """(C, N) complex kg m."""
        return np.array([estimate.value for estimate in self.found])

    @property
    def radius(self) -> np.ndarray:
        """(C, N) kg m, of the circle about each vector that holds 95 %."""
        return np.array([circle_radius(np.diag(estimate.covariance).real, estimate.freedom) for estimate in self.found])

    @property
    def inconsistent(self) -> np.ndarray:
        """(C,) mask of the conditions that no unbalance explains."""
        return np.asarray(self.chance < INCONSISTENT)

    @property
    def contradicted(self) -> np.ndarray:
        """(C,) mask of the conditions whose vibration contradicts their known weights.

        It is that of a whole table: one table of sound conditions in a hundred has any (Bonferroni).
        """
        return np.asarray(self.label_chance < INCONSISTENT / len(self.found))


def estimate_all(readings: Readings, models: Sequence[LinearVibration]) -> Estimates:
    """The unbalance of each condition by its model of ``models`` (C). Raises DataError where too little was read."""
    estimates, chance, labels = [], [], []
    for c, vector in enumerate(readings.displacement.reshape(len(readings.names), -1)):
        model, counts = models[c], readings.counts[c]
        if not (counts > 0).any():
            raise DataError(f"condition '{readings.names[c]}' must have at least one measured vector, but has none")
        unbalance = estimate_unbalance(model, vector, int(counts[counts > 0].min()))
        away = readings.unbalance[c] - unbalance.value
        known = not np.isnan(away).any()
        squared = float((away.conj() @ np.linalg.solve(unbalance.covariance, away)).real) if known else np.nan
        estimates.append(unbalance)
        chance.append(_judge_rest(unbalance, int((counts > 0).sum()) - len(away), model.noise))
        labels.append(judge_distance(squared, len(away), unbalance.freedom))
    return Estimates(
        readings=readings, found=tuple(estimates), chance=np.array(chance), label_chance=np.array(labels, dtype=float)
    )


def _judge_rest(unbalance: Unbalance, spare: int, noise: NoiseLevels) -> float:
    """The chance of what the weights leave in ``spare`` complex numbers, with the tails that conditions have."""
    tail = noise.freedom - spare + 1 if noise.tail is None else noise.tail
    return judge_distance(unbalance.unexplained / noise.stretch, spare, tail)
