"""The shaft's angle from the pulses of a tacho.

Pulse times are crossings of a threshold, interpolated between the two samples around them, with a hysteresis that
noise does not pass. A sharp edge is seen half a sample early or late, so the angle is not drawn through every pulse:
it is a cubic spline fitted by least squares to all of them, with as many knots as generalised cross-validation asks
for (each pulse weighted by the speed there: the error is one of time). Exact pulses get many knots, jittering ones
few.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from pipeline.errors import DataError
from pipeline.write_numbers import write_number

_TURN = 2 * np.pi


@dataclass(frozen=True, eq=False)
class ShaftAngle:
    """phi(t), zero (modulo a turn) when the mark passes the tacho probe, between the first pulse and the last."""

    spline: Any  # revolutions over the time in s
    start: float  # s
    end: float  # s

    def angle(self, time: np.ndarray) -> np.ndarray:
        """phi in rad at ``time`` (n,) s."""
        return _TURN * np.asarray(self.spline(time))

    def speed(self, time: np.ndarray) -> np.ndarray:
        """Rotor speed in rad/s at ``time`` (n,) s."""
        return _TURN * np.asarray(self.spline(time, 1))


def find_pulses(
    time: np.ndarray, signal: np.ndarray, edge: str, threshold: float | None, hysteresis: float | None, where: str
) -> tuple[np.ndarray, float]:
    """When ``signal`` (n,) at ``time`` (n,) s crosses the threshold upwards (edge rising) or downwards (falling).

    Times (N,) s, and how late or early all of them may be together (s).

    A pulse counts where the signal has been beyond half the ``hysteresis`` on one side and then is on the other.
    Null: half way between the levels of the signal, and four tenths of what lies between them. Raises DataError, which
    begins with ``where``, for a signal without pulses.
    """
    low, high = np.percentile(signal, [0.2, 99.8])
    if high <= low:
        low, high = float(signal.min()), float(signal.max())  # pulses that are shorter than that
    level = np.float64(0.5 * (low + high) if threshold is None else threshold)
    band = np.float64(0.4 * (high - low) if hysteresis is None else hysteresis)
    if not signal.min() < level < signal.max():
        raise DataError(
            f"{where} must have tacho pulses, but the signal stays between {signal.min():g} and {signal.max():g}"
            + ("" if threshold is None else f", and the threshold is {threshold:g}")
            + ": check the channel and tacho.threshold"
        )
    if edge == "falling":
        signal, level = -signal, -level
    above = signal >= level + band / 2
    arrivals = _find_ends(~above) + 1
    # Between two arrivals the signal has been below: it has left that later than it was above.
    was_below, was_above = (_find_last(state, arrivals) for state in (signal <= level - band / 2, above))
    arrivals = arrivals[was_below > was_above]
    if not len(arrivals):
        raise DataError(
            f"{where} must have tacho pulses, but the signal never passes {abs(level):g} by half the hysteresis of "
            f"{band:g} on either side: check the channel, tacho.edge, tacho.threshold and tacho.hysteresis"
        )
    before = _find_last(signal < level, arrivals)  # the last sample under the threshold
    under, over = (signal[places].astype(float) for places in (before, before + 1))
    share = (level - under) / (over - under)
    step = time[before + 1] - time[before]
    pulses = time[before] + share * step
    # An edge that is higher than what the interpolation sees of it lies anywhere between two samples.
    sharp = np.median(over - under) > 0.9 * (high - low)
    # At a whole number of samples a period all of them are off together, by half a step between samples at most.
    apart = np.diff(pulses) / np.median(step)
    locked = len(apart) > 1 and np.abs(apart - np.round(apart)).max() < 0.2 and np.ptp(apart) < 0.5
    return pulses, 0.5 * float(np.median(step)) if sharp and locked else 0.0


def _find_ends(state: np.ndarray) -> np.ndarray:
    """The samples after which a ``state`` (n,) ends."""
    return np.flatnonzero(state[:-1] & ~state[1:])


def _find_last(state: np.ndarray, samples: np.ndarray) -> np.ndarray:
    """The last sample in a ``state`` (n,) before each of the ``samples``, which are not in it; -1 for none."""
    ends = np.append(-1, _find_ends(state))
    return ends[np.searchsorted(ends, samples) - 1]


def fit_angle(
    pulses: np.ndarray, per_revolution: int, where: str, marks: np.ndarray | None = None, least_revolutions: int = 4
) -> ShaftAngle:
    """The angle from ``pulses`` (N,) s; with several a revolution, ``marks`` (M,) s says where zero is.

    Raises DataError for too few pulses, and for missing or doubled ones.
    """
    least = max(least_revolutions * per_revolution + 1, 6)
    if len(pulses) < least:
        raise DataError(
            f"{where} must have at least {least} tacho pulses ({least_revolutions} revolutions), but it has "
            f"{len(pulses)}: give a longer record, or check tacho.threshold"
        )
    _check_regular(pulses, where)
    turns = np.arange(len(pulses)) / per_revolution
    spline = _fit_spline(pulses, turns)
    if marks is not None:
        turns = turns - _find_mark(np.asarray(spline(marks[(marks >= pulses[0]) & (marks <= pulses[-1])])), where)
        spline = _fit_spline(pulses, turns)
    return ShaftAngle(spline, float(pulses[0]), float(pulses[-1]))


def _check_regular(pulses: np.ndarray, where: str) -> None:
    """With a constant acceleration the squared pulse rate is linear in the pulse number, also from standstill."""
    squared = np.diff(pulses) ** -2.0
    ratio = squared[1:-1] / (0.5 * (squared[:-2] + squared[2:]))
    odd = np.flatnonzero((ratio < 0.6) | (ratio > 1.5))
    if len(odd):
        at = pulses[odd[0] + 1]
        raise DataError(
            f"{where} must have evenly spaced tacho pulses, but {len(odd)} of {len(pulses)} intervals do not fit their "
            f"neighbours (the first at {write_number(at, digits=6)} s): pulses are missing or doubled; check "
            "tacho.threshold and tacho.hysteresis, or cut the record"
        )


def _find_mark(marks: np.ndarray, where: str) -> float:
    """The place of the mark in a revolution, from where its pulses fall."""
    if not len(marks):
        raise DataError(f"{where} must have a pulse in tacho.mark_channel within the record, but there is none")
    mean = np.exp(1j * _TURN * marks).mean()
    if abs(mean) < 0.9:
        raise DataError(
            f"{where} must have its marks at one angle of the shaft, but they are spread over the revolution: check "
            "tacho.pulses_per_revolution"
        )
    return float(np.angle(mean) / _TURN)


def _fit_spline(pulses: np.ndarray, turns: np.ndarray) -> Any:
    from scipy.interpolate import make_lsq_spline

    period = np.gradient(pulses)

    def fit(knots: np.ndarray, method: str) -> Any:
        return make_lsq_spline(pulses, turns, np.pad(knots, 3, mode="edge"), k=3, w=period, method=method)

    def cross_validate(knots: np.ndarray) -> float:
        # By normal equations, in a sixth of the time: exact enough to rank by.
        rest = (turns - fit(knots, "norm-eq")(pulses)) * period
        return float(rest @ rest) / (1 - (len(knots) + 2) / len(pulses)) ** 2

    return fit(min(_list_knots(pulses, period), key=cross_validate), "qr")


def _list_knots(pulses: np.ndarray, period: np.ndarray) -> list[np.ndarray]:
    """Candidates, from a single cubic to a knot at every second pulse: even in the angle, and even in the time."""
    most = max(1, (len(pulses) - 4) // 2)
    counts = np.unique(np.round(np.sqrt(2.0) ** np.arange(2 * np.log2(most) + 1e-9)).astype(int))
    number = np.arange(len(pulses))
    even_in_angle = [np.interp(np.linspace(0, len(pulses) - 1, m + 1), number, pulses) for m in counts]
    longest = (pulses[-1] - pulses[0]) / (2 * period.max())
    even_in_time = [np.linspace(pulses[0], pulses[-1], m + 1) for m in counts if 1 < m <= longest]
    return [*even_in_angle, *even_in_time]
