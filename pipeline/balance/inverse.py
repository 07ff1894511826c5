"""The unbalance that a vibration means, with intervals.

Generalised least squares of y = baseline + B U with the covariance of the noise and of the model's prediction. The
D - N entries that the weights do not explain are covariates: a condition that leaves a large T^2 there has wider
intervals. Where the tail of the conditions is known (a Student t of ``tail`` complex degrees of freedom, stretch c),
the conditional law has the covariance times (c tail + T^2) / (tail + D - N), with tail + D - N degrees of freedom;
where only the freedom n of the covariance is, (n + T^2) / (n - D + N) with n - D + N (growth curves, Rao 1967).

Legend: N planes, D = S P (speeds times channels).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.balance.linear_vibration import LinearVibration
from pipeline.errors import DataError
from pipeline.problem.noise_levels import NoiseLevels, student_factor

LEVEL = 0.95
_STEPS = 30


@dataclass(frozen=True, eq=False)
class Unbalance:
    """The weights in all planes that a vibration means."""

    planes: tuple[int, ...]  # N
    value: np.ndarray  # (N,) complex, kg m
    covariance: np.ndarray  # (N, N) complex, (kg m)^2, circular
    freedom: float  # complex degrees of freedom of the covariance; 0 where it can't be known
    unexplained: float  # T^2 of what no weight in these planes explains

    @property
    def deviation(self) -> np.ndarray:
        """(N,) kg m, standard deviation of the real and of the imaginary part."""
        return np.asarray(np.sqrt(np.diag(self.covariance).real / 2))

    def half_width(self, level: float = LEVEL) -> np.ndarray:
        """(N,) kg m, half of the interval of the real and of the imaginary part."""
        return self.deviation * student_factor(self.freedom, level)

    def magnitude_interval(self, level: float = LEVEL) -> np.ndarray:
        """(N, 2) kg m, lowest and highest magnitude. The magnitude of a noisy vector has a Rice distribution."""
        return np.array([_rice(abs(u), h, level) for u, h in zip(self.value, self.half_width(level), strict=True)])

    def angle_half_width(self, level: float = LEVEL) -> np.ndarray:
        """(N,) rad, half of the interval of the angle; pi where every angle is possible."""
        ratio = self.half_width(level) / np.maximum(abs(self.value), np.finfo(float).tiny)
        return np.where(ratio < 1, np.arcsin(np.minimum(ratio, 1)), np.pi)


def estimate_unbalance(
    model: LinearVibration, vector: np.ndarray, count: int = 1, present: np.ndarray | None = None
) -> Unbalance:
    """The weights that explain ``vector`` (D,) complex m, the mean of ``count`` records.

    ``present`` (D,) says which entries were measured; by default those that are not NaN. Raises DataError where they
    are fewer than the planes.
    """
    kept = np.isfinite(vector) if present is None else np.asarray(present, dtype=bool)
    n_planes = len(model.planes)
    if kept.sum() < n_planes:
        raise DataError(
            f"unbalance in {n_planes} planes must be read from at least {n_planes} vectors (channels times speeds), "
            f"but {kept.sum()} were measured: add a speed or a probe, or leave a plane out"
        )
    noise = model.noise.covariance(np.array([count]))[0]
    value = np.zeros(n_planes, dtype=complex)
    for _ in range(_STEPS):
        mean, spread = model.predict(value[None])
        slope = model.influence_at(value)[0][kept]
        total = (noise + spread[0])[np.ix_(kept, kept)]
        residual = (vector - mean[0])[kept]
        whitened = np.linalg.solve(total, slope)
        information = slope.conj().T @ whitened
        step = np.linalg.solve(information, whitened.conj().T @ residual)
        value = value + step
        if np.linalg.norm(step) <= 1e-8 * np.linalg.norm(value):
            break
    residual = (vector - model.predict(value[None])[0][0])[kept]
    squared = float((residual.conj() @ np.linalg.solve(total, residual)).real)
    left, factor = _corrected(model.noise, int(kept.sum()) - n_planes, squared)
    return Unbalance(model.planes, value, np.linalg.inv(information) * factor, left, squared)


def _corrected(noise: NoiseLevels, spare: int, squared: float) -> tuple[float, float]:
    """Degrees of freedom of the answer, and the factor of its covariance, where ``spare`` entries are covariates."""
    if noise.tail is not None:  # the conditional law of a Student t
        left = noise.tail + spare
        return left, noise.stretch * (noise.tail + squared / noise.stretch) / left
    if noise.freedom <= 0 or not np.isfinite(noise.freedom):
        return noise.freedom, 1.0
    left = max(noise.freedom - spare, 1.0)  # a shrunk covariance has a little more; 1 is the least with an interval
    return left, noise.freedom / left * (1 + squared / noise.freedom)


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
