"""Errors of identified coefficients against modelled ones.

"Percentage error" is the mean over speeds of |identified - modelled| / |modelled|.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass

import numpy as np

from pipeline.coefficients import COEFFICIENTS
from pipeline.config.schema import Config
from pipeline.data.noise import NOMINAL_95
from pipeline.data.operating import split_states
from pipeline.data.operating_points import spread_states
from pipeline.rotor.bearing_table import BearingTable
from pipeline.rotor.stored import load_modelled_bearings


@dataclass(frozen=True)
class CoefficientError:
    """Relative errors over the speeds, in percent; ``l2`` is |identified - modelled|_2 / |modelled|_2."""

    mean_error_percent: float
    median_error_percent: float
    p95_error_percent: float
    max_error_percent: float
    l2_error_percent: float


CoefficientErrors = dict[int, dict[str, CoefficientError]]
"""Bearing node -> coefficient name -> error."""


def measure_relative_errors(identified: BearingTable, modelled: BearingTable, name: str) -> np.ndarray:
    """(B, S) |identified - modelled| / |modelled| in percent; NaN where the modelled value is zero."""
    value, true = identified.coefficient(name), modelled.coefficient(name)
    size = np.where(true == 0.0, np.nan, np.abs(true))
    return 100.0 * np.abs(value - true) / size


def measure_errors(
    identified: BearingTable, modelled: BearingTable, names: Sequence[Sequence[str]]
) -> CoefficientErrors:
    """Errors of the coefficients ``names`` of each bearing; one that is modelled as zero has none."""
    result: CoefficientErrors = {node: {} for node in identified.nodes}
    for b, node in enumerate(identified.nodes):
        for name in names[b]:
            relative = measure_relative_errors(identified, modelled, name)[b]
            errors = relative[~np.isnan(relative)]
            if len(errors):
                value, true = identified.coefficient(name)[b], modelled.coefficient(name)[b]
                l2 = 100.0 * np.linalg.norm(value - true) / np.linalg.norm(true)
                median, p95 = np.percentile(errors, (50.0, 95.0))
                result[node][name] = CoefficientError(
                    float(errors.mean()), float(median), float(p95), float(errors.max()), float(l2)
                )
    return result


def list_metrics(errors: CoefficientErrors) -> dict[str, dict[str, dict[str, float]]]:
    """The ``coefficients`` part of ``metrics.json``."""
    return {str(node): {name: asdict(error) for name, error in by_name.items()} for node, by_name in errors.items()}


def find_worst_mean(errors: CoefficientErrors, name: str) -> float:
    """The largest mean error of one coefficient among the bearings, percent."""
    return max((error[name].mean_error_percent for error in errors.values() if name in error), default=0.0)


def measure_coverage(errors: np.ndarray, deviation: np.ndarray) -> np.ndarray:
    """Percent (over the last axis) of errors inside the nominal 95 % interval, 1.96 standard deviations."""
    return np.asarray(100.0 * (np.abs(errors) <= NOMINAL_95 * deviation).mean(axis=-1))


def list_coverage(
    identified: BearingTable, modelled: BearingTable, deviation: np.ndarray, names: Sequence[Sequence[str]]
) -> dict[str, dict[str, float]]:
    """By node and coefficient, percent of the speeds at which the modelled one lies in the nominal 95 % interval."""
    inside = measure_coverage((identified.values - modelled.values).swapaxes(1, 2), deviation.swapaxes(1, 2))
    return {
        str(node): {name: float(inside[b, COEFFICIENTS.index(name)]) for name in names[b]}
        for b, node in enumerate(identified.nodes)
        if names[b]
    }


def model_unmeasured(config: Config, speeds: np.ndarray) -> BearingTable | None:
    """The modelled coefficients at every different speed of ``speeds`` (rad/s) and all conditions that are asked for.

    None where none are, or where data were measured.
    """
    wanted = config.machine.unmeasured
    if not wanted or config.machine.recordings.recorded:
        return None
    points = spread_states(np.unique(speeds), wanted)
    return load_modelled_bearings(config.machine.rotor, config.machine.bearings, *points)


def measure_unmeasured(
    answer: BearingTable, modelled: BearingTable, names: Sequence[Sequence[str]]
) -> dict[str, CoefficientErrors]:
    """Errors at each condition, by its words such as ``40 degC``."""
    states = split_states(modelled.speeds, modelled.operating)
    return {state: measure_errors(answer.at(points), modelled.at(points), names) for state, points in states}
