"""One mistake that a person may have made, as the measurement without it; and how readings are changed.

Legend: S speeds, P channels, R runs.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from pipeline.problem.measurement import Measurement
from pipeline.trust.quick_fit import Extra, nothing_free


@dataclass(frozen=True, eq=False)
class Mistake:
    """One explanation: the measurement without the mistake, and what it leaves free."""

    sentence: str  # what was done, as "the phases of all readings are leads, not lags"
    check: str  # what to look at
    measurement: Measurement
    extra: Extra = nothing_free
    gross: bool = True  # False: a number is a little off
    single: bool = False  # of one run, weight or probe
    penalty: float = 1.0  # on what it leaves over: it explains nothing, or leaves many numbers free

    @property
    def frees(self) -> bool:
        """Whether it leaves numbers free."""
        return self.extra is not nothing_free


def change(measurement: Measurement, displacement: np.ndarray, deviation: np.ndarray) -> Measurement:
    """Other readings with their noise; the response is not solved again."""
    made = replace(measurement, dataset=replace(measurement.dataset, displacement=displacement, subtracted=None))
    vars(made)["response"] = measurement.response
    vars(made)["deviation"] = deviation
    return made


def scale(measurement: Measurement, factor: np.ndarray | complex) -> Measurement:
    """Readings times ``factor`` (broadcast to (S, P, R))."""
    size = np.abs(factor) * np.ones_like(measurement.deviation)
    return change(measurement, measurement.dataset.displacement * factor, measurement.deviation * size)


def exchange(measurement: Measurement, order: Sequence[int], axis: int) -> Measurement:
    """The readings in another ``order`` of channels (axis 1) or runs (axis 2)."""
    data = measurement.dataset
    return change(measurement, np.take(data.displacement, order, axis), np.take(measurement.deviation, order, axis))


def free_gain(chosen: np.ndarray) -> Extra:
    """Size and phase of the ``chosen`` readings (mask, broadcast to (S, P, R)) are free, to first order."""

    def columns(predicted: np.ndarray) -> np.ndarray:
        column = predicted * chosen
        return np.stack([column, 1j * column], axis=-1)

    return columns


LEFT_OUT = 3.0
"""The penalty on leaving a probe or a run out, which explains nothing."""
