"""What an answer is worth beside its coefficients at the data: where nobody measured, and its physical numbers.

``machine.unmeasured`` says at which operating conditions the modelled coefficients are asked for.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from pipeline.config.schema import Config
from pipeline.data.operating import split_states
from pipeline.data.operating_points import spread_states
from pipeline.evaluation.errors import CoefficientErrors, list_metrics, measure_errors
from pipeline.evaluation.physical_numbers import measure_numbers
from pipeline.identification.identified import IdentifiedModel
from pipeline.reporting.console import say
from pipeline.rotor.bearing_table import BearingTable
from pipeline.rotor.stored import load_modelled_bearings


def model_unmeasured(config: Config, speeds: np.ndarray) -> BearingTable | None:
    """The modelled coefficients at every different speed of ``speeds`` (rad/s) and all conditions that are asked for.

    None where none are, or where data were measured.
    """
    wanted = config.machine.unmeasured
    if not wanted or config.machine.recordings.format != "none":
        return None
    points = spread_states(np.unique(speeds), wanted)
    return load_modelled_bearings(config.machine.rotor, config.machine.bearings, *points)


def measure_unmeasured(
    answer: BearingTable, modelled: BearingTable, names: Sequence[Sequence[str]]
) -> dict[str, CoefficientErrors]:
    """Errors at each condition, by its words such as ``40 degC``."""
    states = split_states(modelled.speeds, modelled.operating)
    return {state: measure_errors(answer.at(points), modelled.at(points), names) for state, points in states}


def judge_beyond(config: Config, identified: IdentifiedModel, speeds: np.ndarray) -> dict[str, Any]:
    """The ``unmeasured`` part of ``metrics.json``, said on the console, too; empty where nothing is asked for."""
    modelled = model_unmeasured(config, speeds)
    if modelled is None:
        return {}
    errors = measure_unmeasured(identified.table(modelled), modelled, identified.unknowns.by_bearing)
    for state, error in errors.items():
        worst = max(name.median_error_percent for names in error.values() for name in names.values())
        say(f"{config.name}: at {state}, which no run has, the worst coefficient is off by {worst:.3g} % (median)")
    return {"unmeasured": {label: list_metrics(errors_by_node) for label, errors_by_node in errors.items()}}


def judge_numbers(config: Config, numbers: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    """The ``physical_numbers`` of a fit with their true values and errors, of a modelled machine."""
    if config.machine.recordings.format != "none":
        return dict(numbers)
    errors = measure_numbers(
        {name: (number["value"], number["deviation"]) for name, number in numbers.items()}, config.machine
    )
    more = {name: {"true": error.true, "error_percent": error.error_percent} for name, error in errors.items()}
    return {name: {**number, **more.get(name, {})} for name, number in numbers.items()}
