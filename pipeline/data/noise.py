"""The noise of a reading."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

NOMINAL_95 = 1.959964
"""Standard deviations to either side of a normal value, within which 95 of 100 lie."""


@dataclass(frozen=True)
class NoiseModel:
    """Circular noise of each measured complex displacement: a floor, and a share of the reading's size."""

    additive: float  # m, root mean square
    multiplicative: float  # share of the reading, root mean square
    drift: float = 0.0  # m, root mean square, of the records of a condition together where nothing estimates it

    def with_drift(self) -> NoiseModel:
        """The noise of conditions that are too few to tell their drift: it counts as noise of each reading."""
        return NoiseModel(float(np.hypot(self.additive, self.drift)), self.multiplicative)

    def deviation(self, displacement: np.ndarray, subtracted: np.ndarray | None = None) -> np.ndarray:
        """(.., S, P, R) m, root mean square of the noise of each reading.

        The noise of a baseline that was ``subtracted`` (zero where none was) is still there.
        """
        subtracted = np.zeros(1) if subtracted is None else subtracted
        read = np.hypot(self.additive, self.multiplicative * np.abs(displacement + subtracted))
        baseline = np.hypot(self.additive, self.multiplicative * np.abs(subtracted))
        return np.hypot(read, np.where(subtracted != 0, baseline, 0.0))
