"""What a fit found beside the coefficients, as tables for files; without a row where the loss says nothing of it."""

from __future__ import annotations

from typing import Any

import numpy as np

from pipeline.data.operating_points import list_columns
from pipeline.data.vibration_files import to_rpm
from pipeline.identification.identified import Fit
from pipeline.identification.uncertainty import Uncertainty
from pipeline.rotor.parameters import UNITS


def tabulate_bad_points(fitted: Fit) -> dict[str, list[Any]]:
    """Readings, and how many deviations they are off."""
    every = fitted.quality.bad_points
    columns: dict[str, list[Any]] = {
        "run": [point.run for point in every],
        "speed_rpm": to_rpm(np.array([point.speed for point in every])).tolist(),
    }
    names = every[0].operating if every else ()
    conditions = {name: np.array([point.operating[name] for point in every]) for name in names}
    columns |= {name: values.tolist() for name, values in list_columns(conditions).items()}
    return columns | {name: [getattr(point, name) for point in every] for name in ("node", "direction", "deviations")}


def tabulate_unbalance(uncertainty: Uncertainty | None) -> dict[str, Any]:
    """kg m and degrees."""
    if uncertainty is None:
        return {"node": [], "magnitude": [], "phase_deg": [], "magnitude_std": []}
    return {
        "node": uncertainty.planes,
        "magnitude": np.abs(uncertainty.residual_unbalance),
        "phase_deg": np.degrees(np.angle(uncertainty.residual_unbalance)),
        "magnitude_std": uncertainty.unbalance_deviation(),
    }


def tabulate_parameters(fitted: Fit) -> dict[str, list[Any]]:
    """Prior deviation, and what the fit made of it: a share of the stated value, or in the unit."""
    every = fitted.parameters
    return {
        "kind": [number.parameter.kind for number in every],
        "of": [number.parameter.label for number in every],
        "unit": [UNITS[number.parameter.kind] for number in every],
        "prior_std": [number.parameter.deviation for number in every],
        "value": [number.value * number.parameter.deviation for number in every],
        "std": [number.deviation * number.parameter.deviation for number in every],
    }
