"""The unbalance behind a vibration, and the weights that take it away: in which hole, which mass, what remains."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from pipeline.balance.correction import Holes, place_holes
from pipeline.balance.linear_vibration import LinearVibration
from pipeline.balance.records import match_speeds
from pipeline.balance.sheet import Tolerance, find_state, propose_weights, require_state, share_tolerance
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
from pipeline.stages.given_records import Day, fit_models, list_missing, load_models, load_records, read_day
from pipeline.stages.measurement import prepare
from pipeline.tracking import StageRecord
from pipeline.units import RAD_S_PER_RPM


def run(analysis: Analysis) -> StageRecord:
    """``balance.csv``, ``balance.json`` and ``figures/balance.png``; on screen the unbalance of each condition, and the
    balance sheet where ``machine.balance`` says where weights can be put."""
    config = analysis.config
    measurement = prepare(analysis)
    (fitted, fingerprint), asked, weights = load_models(analysis), config.balance, config.machine.balance
    source = SourceUnits(config.machine.recordings)
    # What is wrong with the question is said before a fit.
    method = fitted.pick(asked.method, "balance.method")
    day = _read(config, asked.records, fitted.conditions) if asked.records else None
    readings, _ = day or (fitted.conditions, None)
    plan = plan_correction(config, weights, readings, measurement.rotor) if weights else None
    models = fit_models(config.name, fitted, day)
    by_method: dict[str, Estimates] = {}
    rows: list[dict[str, Any]] = []
    for name, model in models.items():
        by_method[name] = estimate_all(readings, [model] * len(readings.names) if day else fitted.leave_each_out(name))
        tabled = tabulate_estimates(name, by_method[name], readings.planes, source)
        print_estimates(config.name, name, tabled)
        rows += tabled
        if not day and not fitted.can_leave_out(name):
            say(f"{config.name}: {name} was fitted to these conditions themselves; studies/folds tries it on others")
    summary: dict[str, Any] = {
        "methods": {name: estimates.summarize() for name, estimates in by_method.items()},
        "sheet": correct(config, plan, models[method], method, readings) if plan else None,
    }
    if not plan:
        say(f"{config.name}: no correction weights, since machine.balance does not say where there are holes")
    written = [
        write_table(analysis.folder / "balance.csv", rows),
        write_json(analysis.folder / "balance.json", summary),
        draw_balance(analysis.figure("balance"), method, by_method[method], readings.planes, source),
    ]
    return StageRecord(summary, {"data_fingerprint": fingerprint}, written)


def _read(config: Config, file: str, experiment: Conditions) -> Day:
    """The conditions of ``file``, at the speeds of the experiment's."""
    records = load_records(config, file, "balance.records")
    readings, reference = read_day(records, experiment, config.balance.reference)
    without = f" without {', '.join(missing)}" if (missing := list_missing(records)) else ""
    measured = np.flatnonzero((~np.isnan(readings.displacement)).any(axis=(0, 2)))
    rpm = ", ".join(f"{speed / RAD_S_PER_RPM:.0f}" for speed in readings.speeds[measured])
    say(f"{config.name}: {len(readings.names)} conditions of '{file}' at {rpm} rpm{without}")
    return readings, reference


def plan_correction(
    config: Config, given: WeightsConfig, readings: Conditions, rotor: RotorModel
) -> tuple[WeightsConfig, list[Holes | None], list[int], Tolerance | None]:
    """What there is to correct with, the holes of each plane, the speeds that count, and what may remain.

    Raises ConfigError and DataError for what can't be asked of the readings.
    """
    require_state(readings, config.balance, config.data.baseline)
    wanted, grade = np.array(config.balance.speeds_rpm) * RAD_S_PER_RPM, given.tolerance
    return (
        given,
        place_holes(given, readings.planes, SourceUnits(config.machine.recordings)),
        match_speeds(wanted, readings.speeds, "balance.speeds_rpm").tolist(),
        share_tolerance(rotor, readings.planes, grade.permissible(rotor.total_mass)) if grade else None,
    )


def correct(
    config: Config,
    plan: tuple[WeightsConfig, list[Holes | None], list[int], Tolerance | None],
    model: LinearVibration,
    method: str,
    readings: Conditions,
) -> dict[str, Any]:
    """Choose, print and summarise the correction weights."""
    source, asked, (given, holes, speeds, tolerance) = SourceUnits(config.machine.recordings), config.balance, plan
    state = find_state(model, readings, asked)
    every = [
        propose_weights(model, state, [hole and replace(hole, most=k) for hole in holes], asked.minimise, speeds)
        for k in range(given.most if given.masses == ANY else 1, given.most + 1)
    ]
    sheet = every[-1]
    whose = {"residual": "the machine's own unbalance", "condition": f"condition {asked.condition}"}
    whose["both"] = f"{whose['condition']} and the machine's own unbalance"
    described = describe_sheet(sheet, model.planes, source, tolerance)
    print_sheet(f"balance sheet for {whose[asked.remove]}, by {method}: least {asked.minimise}", described)
    if len(every) > 1:
        print_fewer(every, model.planes, source)
    rows = tabulate_vibration_change(sheet, model.speeds, model.channels, source)
    print_vibration_change(rows, source.unit)
    asked_for = {"remove": asked.remove, "condition": asked.condition, "minimise": asked.minimise}
    return described | {"method": method} | asked_for | {"vibration": rows}
