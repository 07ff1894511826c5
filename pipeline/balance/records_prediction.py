"""The vibration that known weights make in each record, with 95 % bands, beside what was measured.

Legend: n records, S speeds, P channels, D = S P.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.balance.bands import circle_of
from pipeline.balance.linear_vibration import LinearVibration
from pipeline.balance.readings import match_speeds
from pipeline.errors import DataError
from pipeline.ingest.records import Records


@dataclass(frozen=True, eq=False, kw_only=True)
class PredictedRecords:
    """What one record with these weights shows, and how far it may be off."""

    mean: np.ndarray  # (n, P) complex m
    deviation: np.ndarray  # (n, P) m, standard deviation of the real and of the imaginary part
    half_width: np.ndarray  # (n, P) m, half of the 95 % band of the real and of the imaginary part
    circle: np.ndarray  # (n, P) m, radius that holds 95 % of the vectors of such records
    off: np.ndarray  # (n, P) complex m, measured less predicted; NaN where nothing was measured

    @property
    def within(self) -> np.ndarray:
        """(n, P) whether the measured vector lies in the circle that holds 95 %; False where nothing was measured."""
        return np.asarray(np.abs(self.off) <= self.circle)

    @property
    def measured(self) -> np.ndarray:
        """(n, P) where there is a measured vector."""
        return ~np.isnan(self.off)


def predict_records(records: Records, vibration: LinearVibration) -> PredictedRecords:
    """The vibration of each record's known weights, at the nominal speed that is nearest to its own.

    The bands hold the model's own uncertainty, the drift between conditions, and the scatter of a record. Raises
    DataError for a record without weights, and for a speed that is not one of the model's.
    """
    planes = [records.planes.index(node) for node in vibration.planes]
    weights = records.unbalance[:, planes]
    without = np.flatnonzero(np.isnan(weights).any(axis=1))
    if len(without):
        raise DataError(
            f"{records.source} must have the weights of every plane (machine.recordings.weights; 0 for none) in each "
            f"record that is predicted, but row {without[0] + 1} has not ({len(without)} rows in all): complete its "
            "columns"
        )
    at = match_speeds(records.speeds, vibration.speeds, records.source)
    channels = [vibration.channels.index(channel) for channel in records.channels]
    distinct, groups = np.unique(weights, axis=0, return_inverse=True)
    mean, covariance = vibration.predict(distinct)
    variance = np.einsum("cdd->cd", covariance).real + np.diag(vibration.noise.covariance(np.ones(1))[0]).real
    place = at[:, None] * len(vibration.channels) + np.array(channels)
    rows = groups.reshape(-1)[:, None]
    predicted = mean[rows, place]
    return PredictedRecords(
        mean=predicted,
        deviation=np.sqrt(vibration.noise.stretch * variance[rows, place] / 2),
        half_width=vibration.noise.half_width(variance[rows, place]),
        circle=circle_of(vibration.noise, variance[rows, place]),
        off=records.displacement - predicted,
    )
