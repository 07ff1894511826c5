"""Records that a model of the vibration is asked about: the mean of each condition, and what their weights would make.

Legend: n records, C conditions, S speeds, P channels, N planes, D = S P (index s * P + p).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.balance.linear_vibration import LinearVibration, circle_radius, judge_distance
from pipeline.data.conditions import Conditions
from pipeline.data.dataset import SYNCHRONOUS
from pipeline.errors import DataError, nearest
from pipeline.ingest.records import Records
from pipeline.ingest.tracks import format_rpm


def average_records(records: Records, grid: Conditions | LinearVibration) -> Conditions:
    """The means of the ``records`` of each condition, in the order of the table; NaN where nothing was read.

    Speeds, channels and planes are those of the ``grid``. ``counts`` are the fewest records behind a mean of each; the
    records' own scatter is not asked for. Raises DataError for a speed that is not one of the grid's, channels or
    planes other than the grid's, a table without vibration, and a condition whose known weights differ.
    """
    at = match_speeds(records.speeds, grid.speeds, records.source)
    names = tuple(dict.fromkeys(records.conditions))
    conditions = np.array([names.index(name) for name in records.conditions])
    channels = [records.channels.index(channel) for channel in grid.channels]
    read = records.displacement[:, channels]
    present = ~np.isnan(read)
    if not present.any():
        raise DataError(
            f"{records.source} must have the vibration of at least one probe, but no column of "
            f"{', '.join(records.probes)} has a number: give its columns as machine.recordings.probes names them"
        )
    shape = (len(names), len(grid.speeds), len(channels))
    total, counts = np.zeros(shape, dtype=complex), np.zeros(shape, dtype=int)
    np.add.at(total, (conditions, at), np.where(present, read, 0.0))
    np.add.at(counts, (conditions, at), present)
    mean = np.where(counts > 0, total / np.maximum(counts, 1), np.nan)
    planes = [records.planes.index(node) for node in grid.planes]
    known = np.full((len(names), len(planes)), np.nan, dtype=complex)  # NaN where its records do not say it
    for c, name in enumerate(names):
        given = records.unbalance[conditions == c][:, planes]
        given = given[~np.isnan(given).any(axis=1)]
        if len(given) and not np.allclose(given, given[0], rtol=1e-6, atol=1e-12):
            raise DataError(f"{records.source} must have one set of weights a condition, but '{name}' has several")
        known[c] = given[0] if len(given) else np.nan
    return Conditions(
        names=names,
        speeds=grid.speeds,
        own_speeds=np.tile(grid.speeds, (len(names), 1)),
        displacement=mean,
        counts=np.where(counts > 0, counts, counts.max()).min(axis=(1, 2)),
        channels=grid.channels,
        planes=grid.planes,
        unbalance=known,
        record_covariance=np.zeros((*shape[1:], shape[2]), dtype=complex),
    )


def match_speeds(speeds: np.ndarray, nominal: np.ndarray, source: str) -> np.ndarray:
    """(n,) index of the ``nominal`` speed (S,) of each of the ``speeds`` (n,), rad/s.

    Raises DataError where one is more than 1 % from all of them.
    """
    at = np.abs(speeds[:, None] / nominal - 1).argmin(axis=1)
    off = np.abs(speeds / nominal[at] - 1)
    if off.max(initial=0.0) > SYNCHRONOUS:
        known = ", ".join(format_rpm(speed) for speed in nominal)
        raise DataError(
            f"{source} must have speeds within {100 * SYNCHRONOUS:g} % of those that influence coefficients are known "
            f"at ({known} rpm), but got {format_rpm(speeds[off.argmax()])} rpm: leave these records out, or use the "
            "physical model"
        )
    return at


# --- another day -------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False, kw_only=True)
class OfDay(LinearVibration):
    """A model of the vibration on another day, to which that day adds the same vector in every condition."""

    model: LinearVibration
    shift: np.ndarray  # (D,) m
    spread: np.ndarray  # (D, D) m^2, covariance of the shift

    def predict(self, unbalance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Mean (C, D) m and covariance (C, D, D) m^2. The model's uncertainty counts in the shift, too: where both have
        the same cause, that is too much."""
        mean, covariance = self.model.predict(unbalance)
        return mean + self.shift, covariance + self.spread

    def influence_at(self, unbalance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Derivative (D, N) m/(kg m) by the weights at ``unbalance`` (N,), and the day's baseline (D,) m."""
        slope, baseline = self.model.influence_at(unbalance)
        return slope, baseline + self.shift


def find_reference(conditions: Conditions, reference: str) -> Conditions:
    """The condition called ``reference`` alone, which shows what its day adds.

    Raises DataError for one that is not among them, or lacks a weight or a vector.
    """
    if reference not in conditions.names:
        raise DataError(
            f"the reference must be a condition of the records, but got '{reference}': "
            f"{nearest(reference, conditions.names)}"
        )
    only = conditions.of([conditions.names.index(reference)])
    if np.isnan(only.unbalance).any() or np.isnan(only.displacement).any():
        raise DataError(
            f"the reference '{reference}' must have its weights, and a vector of each probe at each speed, but lacks "
            "some: complete its rows, or name another condition"
        )
    return only


def shift_to_day(reference: Conditions, vibration: LinearVibration) -> OfDay:
    """The model on the day of the ``reference``, a condition alone, as that shows it."""
    (mean,), (covariance,) = vibration.predict(reference.unbalance)
    (scatter,) = vibration.noise.covariance(reference.counts)
    return OfDay(
        speeds=vibration.speeds,
        channels=vibration.channels,
        planes=vibration.planes,
        noise=vibration.noise,
        model=vibration,
        shift=reference.vectors[0] - mean,
        spread=covariance + scatter,
    )


def judge_together(conditions: Conditions, vibration: LinearVibration, rare: float) -> float:
    """The chance that the mean of all conditions departs as far from what their weights make, if they belong to the
    model's day. NaN where it does not tell: of one condition, or where they depart so differently that chance makes
    it in less than the share ``rare`` of tables, as with a wrong label.

    Conditions scatter by themselves, and have what is uncertain of the model in common.
    """
    whole = ~(np.isnan(conditions.unbalance).any(axis=1) | np.isnan(conditions.vectors).any(axis=1))
    if whole.sum() < 2:
        return float("nan")
    mean, covariance = vibration.predict(conditions.unbalance[whole])
    off, noise = conditions.vectors[whole] - mean, vibration.noise
    scatter, common = noise.covariance(conditions.counts[whole]), off.mean(axis=0)
    apart = np.einsum("cd,cd->", (off - common).conj(), np.linalg.solve(scatter, (off - common)[..., None])[..., 0])
    total = covariance.mean(axis=0) + scatter.mean(axis=0) / len(off)
    squares = ((off.size - len(common), apart), (len(common), common.conj() @ np.linalg.solve(total, common)))
    alike, chance = (
        judge_distance(float(squared.real) / noise.stretch, size, noise.tail or noise.freedom - len(common) + 1)
        for size, squared in squares
    )
    return chance if alike >= rare else float("nan")


# --- predicted --------------------------------------------------------------------------------------


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


def place_records(records: Records, grid: Conditions | LinearVibration) -> tuple[np.ndarray, np.ndarray]:
    """The known weights (n, N) kg m of each record in the planes of the ``grid``, and the index (n,) of its speed.

    Raises DataError for a record without weights, and for a speed that is not one of the grid's.
    """
    weights = records.unbalance[:, [records.planes.index(node) for node in grid.planes]]
    without = np.flatnonzero(np.isnan(weights).any(axis=1))
    if len(without):
        raise DataError(
            f"{records.source} must have the weights of every plane (machine.recordings.weights; 0 for none) in each "
            f"record that is predicted, but row {without[0] + 1} has not ({len(without)} rows in all): complete its "
            "columns"
        )
    return weights, match_speeds(records.speeds, grid.speeds, records.source)


def predict_records(records: Records, vibration: LinearVibration) -> PredictedRecords:
    """The vibration of each record's known weights, at the nominal speed that is nearest to its own.

    The bands hold the model's own uncertainty, the drift between conditions, and the scatter of a record. Raises
    DataError as :func:`place_records`.
    """
    weights, at = place_records(records, vibration)
    channels = [vibration.channels.index(channel) for channel in records.channels]
    distinct, groups = np.unique(weights, axis=0, return_inverse=True)
    (mean, covariance), noise = vibration.predict(distinct), vibration.noise
    variance = np.einsum("cdd->cd", covariance).real + np.diag(noise.covariance(np.ones(1))[0]).real
    place = at[:, None] * len(vibration.channels) + np.array(channels)
    rows = groups.reshape(-1)[:, None]
    predicted = mean[rows, place]
    return PredictedRecords(
        mean=predicted,
        deviation=np.sqrt(noise.stretch * variance[rows, place] / 2),
        half_width=noise.half_width(variance[rows, place]),
        circle=circle_radius(noise.stretch * variance[rows, place], noise.tail or noise.freedom),
        off=records.displacement - predicted,
    )
