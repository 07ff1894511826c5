"""What predicts the vibration of a machine from the weights on it, with its covariance.

Influence coefficients, a physical model and their blend are such; what is done with them asks for nothing else.

Legend: C conditions, S speeds, P channels, N planes, D = S P (index s * P + p).
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass

import numpy as np

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
