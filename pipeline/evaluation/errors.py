"""Errors of identified coefficients against modelled ones.

"Percentage error" is the mean over speeds of |identified - modelled| / |modelled|.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass

import numpy as np

from pipeline.rotor.bearing_table import BearingTable


@dataclass(frozen=True)
class CoefficientError:
    """Relative errors over the speeds, in percent; ``l2`` is |identified - modelled|_2 / |modelled|_2."""

    mean_error_percent: float
    median_error_percent: float
    max_error_percent: float
    l2_error_percent: float


CoefficientErrors = dict[int, dict[str, CoefficientError]]
"""Bearing node -> coefficient name -> error."""


def relative_errors(identified: BearingTable, modelled: BearingTable, name: str) -> np.ndarray:
    """(B, S) |identified - modelled| / |modelled| in percent; infinite or 0 where modelled is zero."""
    found, true = identified.coefficient(name), modelled.coefficient(name)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.nan_to_num(100.0 * np.abs(found - true) / np.abs(true), nan=0.0, posinf=np.inf)


def coefficient_errors(identified: BearingTable, modelled: BearingTable, names: Sequence[str]) -> CoefficientErrors:
    """Errors of the coefficients ``names`` at every bearing."""
    result: CoefficientErrors = {node: {} for node in identified.nodes}
    for name in names:
        relative = relative_errors(identified, modelled, name)
        found, true = identified.coefficient(name), modelled.coefficient(name)
        l2 = 100.0 * np.linalg.norm(found - true, axis=1) / np.linalg.norm(true, axis=1)
        for b, node in enumerate(identified.nodes):
            result[node][name] = CoefficientError(
                float(relative[b].mean()),
                float(np.median(relative[b])),
                float(relative[b].max()),
                float(l2[b]),
            )
    return result


def as_metrics(errors: CoefficientErrors) -> dict[str, dict[str, dict[str, float]]]:
    """The ``coefficients`` part of ``metrics.json``."""
    return {str(node): {name: asdict(error) for name, error in of.items()} for node, of in errors.items()}


def worst_mean_error(errors: CoefficientErrors, name: str) -> float:
    """The largest mean error of one coefficient among the bearings, percent."""
    return max(of[name].mean_error_percent for of in errors.values())
