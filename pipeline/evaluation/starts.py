"""Many trainings of one measurement, from initial guesses or from seeds: how far apart their answers are."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.evaluation.errors import CoefficientError, measure_errors
from pipeline.identification.training import Minimum
from pipeline.rotor.bearing_table import BearingTable

if TYPE_CHECKING:
    import pandas as pd

_NO_ERROR = CoefficientError(*(float("nan"),) * 5)
"""Where there is no truth."""


def tabulate_starts(
    over: str,
    starts: np.ndarray,
    minimum: Minimum,
    answers: Sequence[BearingTable],
    modelled: BearingTable | None,
    names: Sequence[Sequence[str]],
) -> pd.DataFrame:
    """A row a start (G,), bearing and coefficient; the error is NaN where there is no truth."""
    import pandas as pd

    rows = []
    for g, (start, answer) in enumerate(zip(starts, answers, strict=True)):
        errors = {} if modelled is None else measure_errors(answer, modelled, names)
        for b, node in enumerate(answer.nodes):
            for name in names[b]:
                error = errors.get(node, {}).get(name, _NO_ERROR)
                rows.append(
                    {
                        over: start,
                        "bearing_node": node,
                        "coefficient": name,
                        "mean_value": float(answer.coefficient(name)[b].mean()),
                        "mean_error_percent": error.mean_error_percent,
                        "median_error_percent": error.median_error_percent,
                        "p95_error_percent": error.p95_error_percent,
                        "loss": float(minimum.loss[g]),
                        "outcome": minimum.outcomes[g].label,
                    }
                )
    return pd.DataFrame(rows)


def summarize_starts(minimum: Minimum, rows: pd.DataFrame) -> dict[str, Any]:
    """Outcomes, and the worst and median errors over the starts."""
    labels = [outcome.label for outcome in minimum.outcomes]
    coefficients: dict[str, dict[str, dict[str, float]]] = {}
    for (node, name), group in rows.groupby(["bearing_node", "coefficient"], sort=False):
        errors = group["mean_error_percent"]
        if errors.notna().all():
            values = {
                "worst_mean_error_percent": float(errors.max()),
                "median_mean_error_percent": float(errors.median()),
                "worst_median_error_percent": float(group["median_error_percent"].max()),
                "worst_p95_error_percent": float(group["p95_error_percent"].max()),
            }
            coefficients.setdefault(str(node), {})[str(name)] = values
    return {
        "starts": len(labels),
        "outcomes": {label: labels.count(label) for label in sorted(set(labels))},
        "worst_loss": float(minimum.loss.max()),
        "coefficients": coefficients,
    }
