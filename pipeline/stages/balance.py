"""The unbalance behind a vibration, and the weights that take it away: in which hole, which mass, what remains."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from pipeline.balance.correction import place_holes
from pipeline.balance.linear_vibration import LinearVibration
from pipeline.balance.records import average_records, match_speeds
from pipeline.balance.sheet import find_state, propose_weights, share_tolerance
from pipeline.balance.unbalance import Estimates, estimate_all
from pipeline.config.balance import ANY, WeightsConfig
from pipeline.config.schema import Config
from pipeline.data.conditions import Conditions
from pipeline.data.tables import write_table
from pipeline.files import write_json
from pipeline.ingest.conventions import SourceUnits
from pipeline.reporting.balance import (
    describe_sheet,
    draw_balance,
    print_estimates,
    print_fewer,
    print_sheet,
    print_vibration_change,
    tabulate_estimates,
    tabulate_vibration_change,
)
from pipeline.reporting.console import say
from pipeline.rotor.model import RotorModel
from pipeline.stages.analysis import Analysis
from pipeline.stages.given_records import follow_day, list_missing, load_models, load_records
from pipeline.stages.measurement import prepare
from pipeline.tracking import StageRecord
from pipeline.units import RAD_S_PER_RPM


def run(analysis: Analysis) -> StageRecord:
    """``balance.csv``, ``balance.json`` and ``figures/balance.png``; on screen the unbalance of each condition, and the
    balance sheet where ``machine.balance`` says where weights can be put."""
    config = analysis.config
    measurement = prepare(analysis)
    (fitted, fingerprint), file = load_models(analysis), config.balance.records
    models = dict(fitted.models)
    source = SourceUnits(config.machine.recordings)
    method = fitted.pick(config.balance.method, "balance.method")
    planes = fitted.models[method].planes
    by_method: dict[str, Estimates] = {}
    rows: list[dict[str, Any]] = []
    for name, model in fitted.models.items():
        readings = fitted.conditions
        if file:
            readings, model = _read(config, file, model)
            models[name] = model
        by_method[name] = estimate_all(readings, [model] * len(readings.names) if file else fitted.leave_each_out(name))
        tabled = tabulate_estimates(name, by_method[name], planes, source)
        print_estimates(config.name, name, tabled)
        rows += tabled
        if not file and not fitted.can_leave_out(name):
            say(f"{config.name}: {name} was fitted to these conditions themselves; studies/folds tries it on others")
    summary: dict[str, Any] = {
        "methods": {name: estimates.summarize() for name, estimates in by_method.items()},
        "sheet": None,
    }
    if weights := config.machine.balance:
        readings = by_method[method].readings
        summary["sheet"] = correct(config, weights, models[method], method, readings, measurement.rotor)
    else:
        say(f"{config.name}: no correction weights, since machine.balance does not say where there are holes")
    written = [
        write_table(analysis.folder / "balance.csv", rows),
        write_json(analysis.folder / "balance.json", summary),
        draw_balance(analysis.figure("balance"), method, by_method[method], planes, source),
    ]
    return StageRecord(summary, {"data_fingerprint": fingerprint}, written)


def _read(config: Config, file: str, model: LinearVibration) -> tuple[Conditions, LinearVibration]:
    """The conditions of ``file``, and the model on their day."""
    records = load_records(config, file, "balance.records")
    readings = average_records(records, model)
    missing = list_missing(records)
    without = f" without {', '.join(missing)}" if missing else ""
    measured = np.flatnonzero((~np.isnan(readings.displacement)).any(axis=(0, 2)))
    rpm = ", ".join(f"{speed / RAD_S_PER_RPM:.0f}" for speed in model.speeds[measured])
    say(f"{config.name}: {len(readings.names)} conditions of '{file}' at {rpm} rpm{without}")
    return readings, follow_day(config.name, records, model, config.balance.reference)


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
