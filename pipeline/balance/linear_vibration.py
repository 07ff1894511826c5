"""What predicts the vibration of a machine from the weights on it, with its covariance, and the bands of such numbers.

Influence coefficients, a physical model and their blend are such; what is done with them asks for nothing else.

Legend: C conditions, S speeds, P channels, N planes, D = S P (index s * P + p).
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass

import numpy as np

from pipeline.errors import ConfigError
from pipeline.problem.noise_levels import NoiseLevels


@dataclass(frozen=True, eq=False, kw_only=True)
class LinearVibration(ABC):
    """A model of the vector of a condition that is linear in the weights, or nearly."""

    speeds: np.ndarray  # (S,) rad/s, nominal
    channels: tuple[tuple[int, float], ...]  # P of (node, angle in degrees)
    planes: tuple[int, ...]  # N nodes
    noise: NoiseLevels  # how records and conditions scatter about the prediction

    @abstractmethod
    def predict(self, unbalance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Mean (C, D) m, and its covariance (C, D, D) m^2 (circular) from the model's own uncertainty alone.

        ``unbalance`` (C, N) complex is in kg m.
        """

    @abstractmethod
    def influence_at(self, unbalance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Derivative (D, N) m/(kg m) of the vector by the weights at ``unbalance`` (N,), and the baseline (D,) m."""


def invert_influence(
    influence: np.ndarray, covariance: np.ndarray, most: float = 1e14
) -> tuple[np.ndarray, np.ndarray]:
    """The generalised inverse (N, M) of ``influence`` (M, N), and the covariance (N, N) of what it gives.

    Raises ConfigError where the condition number of the planes' information is above ``most``.
    """
    weighed = np.linalg.solve(covariance, influence)
    information = influence.conj().T @ weighed
    if len(influence) < influence.shape[1] or np.linalg.cond(information) > most:
        raise ConfigError(
            "the vibration that was read must tell the planes apart, but two of them act alike at these probes and "
            "speeds: use more of either, or leave a plane out"
        )
    spread = np.linalg.inv(information)
    return spread @ weighed.conj().T, spread


# --- bands: of circular numbers whose covariance was estimated, or whose tails are heavier than Gaussian ----


def circle_radius(variance: np.ndarray, freedom: float, level: float = 0.95) -> np.ndarray:
    """Radius of the circle that holds the share ``level`` of complex numbers with this ``variance`` E|e|^2 (any shape).

    It is in the root of the variance's unit.
    ``freedom`` counts complex degrees of freedom: |e|^2 over the variance has an F distribution, infinite for a guess.
    """
    from scipy import stats

    if freedom <= 0:
        return np.full(np.shape(variance), np.inf)
    factor = stats.chi2.ppf(level, 2) / 2 if np.isinf(freedom) else stats.f.ppf(level, 2, 2 * freedom)
    return np.asarray(np.sqrt(factor * np.asarray(variance)))


def bound_size(vectors: np.ndarray, radius: np.ndarray, level: float = 0.95) -> np.ndarray:
    """What the size of each complex number about ``vectors`` exceeds with 5 % chance.

    ``radius`` are those of their 95 % circles. The square of a Gaussian number has a noncentral chi-square distribution
    with two degrees of freedom.
    """
    from scipy import stats

    each = np.maximum(np.asarray(radius), 1e-300) ** 2 / stats.chi2.ppf(level, 2)
    squared = np.abs(vectors) ** 2 / each
    with np.errstate(invalid="ignore", over="ignore"):
        near = np.sqrt(stats.ncx2.ppf(level, 2, np.minimum(squared, 1e4)) * each)
    # A vector of many deviations has a Gaussian size, and the noncentral distribution no longer a sum that converges.
    return np.where(np.isinf(each), np.inf, np.where(squared < 1e4, near, np.abs(vectors) + 1.645 * np.sqrt(each)))


def judge_distance(squared: float, size: int, freedom: float) -> float:
    """The chance that ``size`` complex numbers of a sound condition depart by a T^2 (``squared``) as large.

    T^2 / size has an F distribution with 2 size and 2 ``freedom`` degrees of freedom. NaN where nothing is left over to
    judge by, or the covariance is a guess.
    """
    from scipy import stats

    if size <= 0 or freedom <= 0 or np.isnan(squared):
        return float("nan")
    if np.isinf(freedom):
        return float(stats.chi2.sf(2 * squared, 2 * size))
    return float(stats.f.sf(squared / size, 2 * size, 2 * freedom))
