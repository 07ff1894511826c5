"""One natural frequency from several readings of a run-up, and an identified one held against it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

NORMAL = 1.96
"""Standard deviations of a 95 % interval."""


@dataclass(frozen=True)
class Reading:
    """A number with its standard deviation, in one unit."""

    value: float
    deviation: float


def combine(readings: Sequence[Reading]) -> Reading:
    """The mean of readings of one quantity that may contradict each other by more than their deviations.

    What they differ by beyond these is a variance of its own, which every reading gets (DerSimonian and Laird 1986).
    """
    values = np.array([reading.value for reading in readings])
    variances = np.array([reading.deviation**2 for reading in readings])
    weights = 1 / variances
    excess = float(weights @ (values - np.average(values, weights=weights)) ** 2) - (len(values) - 1)
    spread = weights.sum() - (weights**2).sum() / weights.sum()
    between = max(excess / spread, 0.0) if len(values) > 1 else 0.0
    weights = 1 / (variances + between)
    return Reading(float(np.average(values, weights=weights)), float(weights.sum() ** -0.5))


def compare_natural_frequency(run_up: Mapping[str, Any], rpm: float, deviation: float) -> dict[str, Any]:
    """An identified first natural frequency (rpm, standard deviation in rpm) against that of ``run_up.json``.

    ``within`` says whether the run-up's lies in the identified 95 % interval, widened by the run-up's own deviation;
    ``share_of_interval`` is the difference over its half-width;
    ``band_percent`` is how wide the identified interval is, of the run-up's value; ``sentence`` says all of it.
    """
    measured = run_up["natural_frequency"]
    apart = rpm - measured["rpm"]
    band = 100 * 2 * NORMAL * deviation / measured["rpm"]
    share = float(abs(apart) / (NORMAL * np.hypot(deviation, measured["deviation_rpm"])))
    within = share <= 1
    return {
        "identified_rpm": rpm,
        "identified_deviation_rpm": deviation,
        "run_up_rpm": measured["rpm"],
        "run_up_deviation_rpm": measured["deviation_rpm"],
        "difference_percent": 100 * apart / measured["rpm"],
        "band_percent": band,
        "within": within,
        "share_of_interval": share,
        "sentence": (
            f"first natural frequency: {rpm:.4g} +- {NORMAL * deviation:.2g} rpm identified (95 %, {band:.2g} % wide), "
            f"{measured['rpm']:.4g} +- {NORMAL * measured['deviation_rpm']:.2g} rpm in the run-up: they "
            f"{'agree' if within else 'contradict each other'} ({100 * apart / measured['rpm']:+.2g} %)"
        ),
    }
