"""The correction weights of a machine: chosen, printed and summarised."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from pipeline.balance.correction import place_holes
from pipeline.balance.linear_vibration import LinearVibration
from pipeline.balance.records import match_speeds
from pipeline.balance.sheet import find_state, propose_weights, share_tolerance
from pipeline.config.balance import ANY, WeightsConfig
from pipeline.config.schema import Config
from pipeline.data.conditions import Conditions
from pipeline.ingest.conventions import SourceUnits
from pipeline.reporting.balance import (
    describe_sheet,
    print_fewer,
    print_sheet,
    print_vibration_change,
    tabulate_vibration_change,
)
from pipeline.rotor.model import RotorModel
from pipeline.units import RAD_S_PER_RPM


def correct(
    config: Config, given: WeightsConfig, model: LinearVibration, method: str, readings: Conditions, rotor: RotorModel
) -> dict[str, Any]:
    """Choose, print and summarise the correction weights."""
    source, asked = SourceUnits(config.machine.recordings), config.balance
    holes = place_holes(given, model.planes, source)
    speeds = match_speeds(np.array(asked.speeds_rpm) * RAD_S_PER_RPM, model.speeds, "balance.speeds_rpm").tolist()
    state = find_state(model, readings, asked, config.data.baseline)
    every = [
        propose_weights(model, state, [hole and replace(hole, most=k) for hole in holes], asked.minimise, speeds)
        for k in range(given.most if given.masses == ANY else 1, given.most + 1)
    ]
    sheet = every[-1]
    whose = {"residual": "the machine's own unbalance", "condition": f"condition {asked.condition}"}
    whose["both"] = f"{whose['condition']} and the machine's own unbalance"
    grade = given.tolerance
    tolerance = share_tolerance(rotor, model.planes, grade.permissible(rotor.total_mass)) if grade else None
    title = f"balance sheet for {whose[asked.remove]}, by {method}: least {asked.minimise}"
    described = describe_sheet(sheet, model.planes, source, tolerance)
    print_sheet(title, described)
    if len(every) > 1:
        print_fewer(every, model.planes, source)
    rows = tabulate_vibration_change(sheet, model.speeds, model.channels, source)
    print_vibration_change(rows, source.unit)
    asked_for = {"remove": asked.remove, "condition": asked.condition, "minimise": asked.minimise}
    return described | {"method": method} | asked_for | {"vibration": rows}
