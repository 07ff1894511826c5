"""Errors of an answer where nobody measured: ``machine.unmeasured`` says at which operating conditions the modelled
coefficients are asked for."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pipeline.config.schema import Config
from pipeline.data.operating import split_states
from pipeline.data.operating_points import spread_states
from pipeline.evaluation.errors import CoefficientErrors, measure_errors
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
