"""One mistake that a person may have made, as the measurement without it; and how readings are changed.

Legend: S speeds, P channels, R runs.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np

from pipeline.problem.measurement import Measurement
from pipeline.trust.quick_fit import Free


@dataclass(frozen=True, eq=False)
class Mistake:
    """One explanation: the measurement without the mistake, and what it leaves free."""

    sentence: str  # what was done, as "the phases of all readings are leads, not lags"
    check: str  # what to look at
    measurement: Measurement
    free: Free | None = None
    gross: bool = True  # False: a number is a little off
    single: bool = False  # of one run, weight or probe
    penalty: float = 1.0  # on what it leaves over: it explains nothing, or leaves many numbers free


def change(measurement: Measurement, displacement: np.ndarray, deviation: np.ndarray) -> Measurement:
    """Other readings with their noise; the response is not solved again."""
    data = replace(measurement.dataset, displacement=displacement, subtracted=None)
    return replace(measurement, dataset=data, solved=measurement.response, weighed=deviation)


def scale(measurement: Measurement, factor: np.ndarray | complex) -> Measurement:
    """Readings times ``factor`` (broadcast to (S, P, R))."""
    return change(measurement, measurement.dataset.displacement * factor, measurement.deviation * np.abs(factor))


def exchange(measurement: Measurement, pairs: Iterable[tuple[int, int]], axis: int) -> Measurement:
    """The readings with these ``pairs`` of channels (axis 1) or runs (axis 2) in each other's place."""
    readings, order = measurement.dataset.displacement, np.arange(measurement.dataset.displacement.shape[axis])
    for i, j in pairs:
        order[[i, j]] = j, i
    return change(measurement, np.take(readings, order, axis), np.take(measurement.deviation, order, axis))


def free_gain(measurement: Measurement, chosen: np.ndarray) -> Free:
    """Size and phase of the ``chosen`` readings (mask, broadcast to (S, P, R)) are free."""
    column = chosen * np.ones(measurement.dataset.displacement.shape)
    return Free(np.stack([column, 1j * column], axis=-1))


LEFT_OUT = 3.0
"""The penalty on leaving a probe or a run out, which explains nothing."""
