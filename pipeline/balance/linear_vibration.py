"""What predicts the vibration of a machine from the weights on it, with its covariance.

Influence coefficients, a physical model and their blend are such; what is done with them asks for nothing else.

Legend: C conditions, S speeds, P channels, N planes, D = S P (index s * P + p).
"""

from __future__ import annotations

from typing import Protocol

import numpy as np

from pipeline.problem.noise_levels import NoiseLevels


class LinearVibration(Protocol):
    """A model of the vector of a condition that is linear in the weights, or nearly."""

    @property
    def speeds(self) -> np.ndarray:
        """(S,) rad/s, nominal."""

    @property
    def channels(self) -> tuple[tuple[int, float], ...]:
        """P of (node, angle in degrees)."""

    @property
    def planes(self) -> tuple[int, ...]:
        """N nodes."""

    @property
    def noise(self) -> NoiseLevels:
        """How records and conditions scatter about the prediction."""

    def predict(self, unbalance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Mean (C, D) m, and its covariance (C, D, D) m^2 (circular) from the model's own uncertainty alone.

        ``unbalance`` (C, N) complex is in kg m.
        """

    def influence_at(self, unbalance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Derivative (D, N) m/(kg m) of the vector by the weights at ``unbalance`` (N,), and the baseline (D,) m."""
