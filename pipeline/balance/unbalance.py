"""The unbalance that a vibration means, with intervals, and whether any unbalance explains it.

Generalised least squares of y = baseline + B U with the covariance of the noise and of the model's prediction. The
D - N entries that the weights do not explain are covariates: a condition that leaves a large T^2 there has wider
intervals. Where the tail of the conditions is known (a Student t of ``tail`` complex degrees of freedom, stretch c),
the conditional law has the covariance times (c tail + T^2) / (tail + D - N), with tail + D - N degrees of freedom;
where only the freedom n of the covariance is, (n + T^2) / (n - D + N) with n - D + N (growth curves, Rao 1967).

Legend: C conditions, S speeds, P channels, N planes, D = S P.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from pipeline.balance.linear_vibration import LinearVibration, circle_radius, invert_influence, judge_distance
from pipeline.data.conditions import Conditions
from pipeline.errors import DataError
from pipeline.problem.noise_levels import student_factor


@dataclass(frozen=True, eq=False)
class Unbalance:
    """The weights in all planes that a vibration means."""

    value: np.ndarray  # (N,) complex, kg m
    covariance: np.ndarray  # (N, N) complex, (kg m)^2, circular
    freedom: float  # complex degrees of freedom of the covariance; 0 where it can't be known
    unexplained: float  # T^2 of what no weight in these planes explains

    def half_width(self, level: float = 0.95) -> np.ndarray:
        """(N,) kg m, half of the interval of the real and of the imaginary part."""
        return np.sqrt(np.diag(self.covariance).real / 2) * student_factor(self.freedom, level)

    def magnitude_interval(self, level: float = 0.95) -> np.ndarray:
        """(N, 2) kg m, lowest and highest magnitude. The magnitude of a noisy vector has a Rice distribution."""
        return np.array([_rice(abs(u), h, level) for u, h in zip(self.value, self.half_width(level), strict=True)])

    def angle_half_width(self, level: float = 0.95) -> np.ndarray:
        """(N,) rad, half of the interval of the angle; pi where every angle is possible."""
        ratio = self.half_width(level) / np.maximum(abs(self.value), np.finfo(float).tiny)
        return np.where(ratio < 1, np.arcsin(np.minimum(ratio, 1)), np.pi)


def estimate_unbalance(model: LinearVibration, vector: np.ndarray, count: int = 1, steps: int = 30) -> Unbalance:
    """The weights that explain ``vector`` (D,) complex m, the mean of ``count`` records; NaN where nothing was read.

    Raises DataError where fewer entries were read than there are planes, ConfigError where they act alike.
    """
    kept, n_planes = np.isfinite(vector), len(model.planes)
    if kept.sum() < n_planes:
        raise DataError(
            f"unbalance in {n_planes} planes must be read from at least {n_planes} vectors (channels times speeds), "
            f"but {kept.sum()} were measured: add a speed or a probe, or leave a plane out"
        )
    noise = model.noise.covariance(np.array([count]))[0]
    value = np.zeros(n_planes, dtype=complex)
    for _ in range(steps):
        mean, spread = model.predict(value[None])
        slope = model.influence_at(value)[0][kept]
        total = (noise + spread[0])[np.ix_(kept, kept)]
        residual = (vector - mean[0])[kept]
        inverse, covariance = invert_influence(slope, total)
        step = inverse @ residual
        value = value + step
        if np.linalg.norm(step) <= 1e-8 * np.linalg.norm(value):
            break
    residual = (vector - model.predict(value[None])[0][0])[kept]
    squared = float((residual.conj() @ np.linalg.solve(total, residual)).real)
    spare, levels, factor = int(kept.sum()) - n_planes, model.noise, 1.0  # entries that are covariates
    left = levels.freedom
    if levels.tail:  # the conditional law of a Student t
        left = levels.tail + spare
        factor = levels.stretch * (levels.tail + squared / levels.stretch) / left
    elif 0 < left < np.inf:
        left = max(left - spare, 1.0)  # a shrunk covariance has a little more; 1 is the least with an interval
        factor = levels.freedom / left * (1 + squared / levels.freedom)
    return Unbalance(value, covariance * factor, left, squared)


def _rice(magnitude: float, half_width: float, level: float) -> tuple[float, float]:
    """Magnitudes for which a reading as small, or as large, as this one has at least half of the level's rest."""
    from scipy import optimize, stats

    if not np.isfinite(half_width):
        return 0.0, float("inf")
    if half_width == 0:
        return magnitude, magnitude
    tail = (1 - level) / 2
    deviation = half_width / float(stats.norm.ppf(1 - tail))
    # Below the median of pure noise a reading says no more than that the magnitude may be zero.
    x, seen = magnitude / deviation, max(magnitude / deviation, 1.18)
    if x > 10:
        return magnitude - half_width, magnitude + half_width

    def below(x: float, true: float) -> float:
        return float(stats.rice.cdf(x, true))

    high = optimize.brentq(lambda true: below(seen, true) - tail, 0.0, seen + 10)
    low = optimize.brentq(lambda true: below(x, true) - (1 - tail), 0.0, x) if below(x, 0.0) > 1 - tail else 0.0
    return float(low * deviation), float(high * deviation)


# --- of many conditions ------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False, kw_only=True)
class Estimates:
    """The unbalance of every condition in every plane, without the machine's own; beside the known one.

    ``RARE`` is the chance below which a vibration is called inconsistent with any unbalance: one sound condition in a
    hundred is.
    """

    RARE: ClassVar[float] = 0.01
    readings: Conditions
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
        return np.asarray(self.chance < self.RARE)

    @property
    def contradicted(self) -> np.ndarray:
        """(C,) mask of the conditions whose vibration contradicts their known weights.

        It is that of a whole table: one table of sound conditions in a hundred has any (Bonferroni).
        """
        return np.asarray(self.label_chance < self.RARE / len(self.found))

    def summarize(self) -> dict[str, Any]:
        """Names of what is out of order, and how the known weights lie in the bands."""
        names = np.array(self.readings.names, dtype=object)
        known = ~np.isnan(self.readings.unbalance)
        inside = np.abs(self.readings.unbalance - self.unbalance) <= self.radius
        return {
            "conditions": len(names),
            "inconsistent": names[self.inconsistent].tolist(),
            "contradicted": names[self.contradicted].tolist(),
            "known_within_95_percent": float(inside[known].mean()) if known.any() else None,
        }


def estimate_all(readings: Conditions, models: Sequence[LinearVibration]) -> Estimates:
    """The unbalance of each condition by its model of ``models`` (C). Raises DataError where too little was read."""
    estimates, chance, labels = [], [], []
    for c, vector in enumerate(readings.vectors):
        model, measured = models[c], ~np.isnan(vector)
        if not measured.any():
            raise DataError(f"condition '{readings.names[c]}' must have at least one measured vector, but has none")
        unbalance = estimate_unbalance(model, vector, int(readings.counts[c]))
        away = readings.unbalance[c] - unbalance.value
        known = not np.isnan(away).any()
        squared = float((away.conj() @ np.linalg.solve(unbalance.covariance, away)).real) if known else np.nan
        estimates.append(unbalance)
        spare, noise = int(measured.sum()) - len(away), model.noise
        tail = noise.tail or noise.freedom - spare + 1  # with the tails that conditions have
        chance.append(judge_distance(unbalance.unexplained / noise.stretch, spare, tail))
        labels.append(judge_distance(squared, len(away), unbalance.freedom))
    return Estimates(
        readings=readings, found=tuple(estimates), chance=np.array(chance), label_chance=np.array(labels, dtype=float)
    )
