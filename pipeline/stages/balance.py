"""The unbalance behind a vibration, and the weights that take it away: in which hole, which mass, what remains."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from pipeline.balance.correction import Holes
from pipeline.balance.estimates import Estimates, estimate_all
from pipeline.balance.linear_vibration import LinearVibration
from pipeline.balance.readings import Readings, average_records, describe_conditions, match_speeds
from pipeline.balance.sheet import State, predict_one, propose_weights
from pipeline.balance.tolerance import Tolerance, share_tolerance
from pipeline.config.balance import ANY, WeightsConfig
from pipeline.config.schema import Config
from pipeline.data.tables import write_table
from pipeline.errors import ConfigError, nearest
from pipeline.files import write_json
from pipeline.ingest.source_units import SourceUnits
from pipeline.reporting.balance_figure import draw_balance
from pipeline.reporting.balance_tables import (
    describe_sheet,
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
from pipeline.stages.execution import StageOutput
from pipeline.stages.measurement import load_measurement
from pipeline.stages.vibration_models import (
    can_leave_out,
    leave_each_out,
    list_missing,
    load_models,
    load_records,
    pick_method,
)
from pipeline.stages.workspace import locate_files
from pipeline.units import RAD_S_PER_RPM


def run(analysis: Analysis) -> StageOutput:
    """``balance.csv``, ``balance.json`` and ``figures/balance.png``; on screen the unbalance of each condition, and the
    balance sheet where ``machine.balance`` says where weights can be put."""
    config = analysis.config
    measurement, work = load_measurement(config), locate_files(config)
    fitted = load_models(config)
    models = fitted.models
    source = SourceUnits(config.machine.recordings)
    method = pick_method(models, config.balance.method, "balance.method")
    by_method: dict[str, Estimates] = {}
    for name, model in models.items():
        if config.balance.records is None:
            by_method[name] = estimate_all(describe_conditions(fitted.conditions), leave_each_out(fitted, name))
        else:
            readings = _read(config, config.balance.records, model)
            by_method[name] = estimate_all(readings, [model] * len(readings.names))
        print_estimates(config.name, name, by_method[name], model.planes, source)
        if config.balance.records is None and not can_leave_out(fitted, name):
            say(f"{config.name}: {name} was fitted to these conditions themselves; stage=folds tries it on unseen ones")
    planes = models[method].planes
    summary: dict[str, Any] = {
        "methods": {name: _summarize(estimates) for name, estimates in by_method.items()},
        "sheet": None,
    }
    if config.machine.balance is None:
        say(f"{config.name}: no correction weights, since machine.balance does not say where there are holes")
    else:
        readings = by_method[method].readings
        summary["sheet"] = _correct(config, config.machine.balance, models[method], method, readings, measurement.rotor)
    written = [
        write_table(work.folder / "balance.csv", tabulate_estimates(by_method, planes, source)),
        write_json(work.folder / "balance.json", summary),
        draw_balance(work.figure("balance"), method, by_method[method], planes, source),
    ]
    return StageOutput(summary, {"data_fingerprint": fitted.fingerprint}, written)


def _read(config: Config, file: str, model: LinearVibration) -> Readings:
    records = load_records(config, file, "balance.records")
    readings = average_records(records, model)
    missing = list_missing(records)
    without = f" without {', '.join(missing)}" if missing else ""
    measured = np.flatnonzero((readings.counts > 0).any(axis=(0, 2)))
    rpm = ", ".join(f"{speed / RAD_S_PER_RPM:.0f}" for speed in model.speeds[measured])
    say(f"{config.name}: {len(readings.names)} conditions of '{file}' at {rpm} rpm{without}")
    return readings


def _summarize(estimates: Estimates) -> dict[str, Any]:
    """Names of what is out of order, and how the known weights lie in the bands."""
    names = estimates.readings.names
    known = ~np.isnan(estimates.readings.unbalance)
    inside = np.abs(estimates.readings.unbalance - estimates.unbalance) <= estimates.radius
    return {
        "conditions": len(names),
        "inconsistent": [name for name, bad in zip(names, estimates.inconsistent, strict=True) if bad],
        "contradicted": [name for name, bad in zip(names, estimates.contradicted, strict=True) if bad],
        "known_within_95_percent": float(inside[known].mean()) if known.any() else None,
    }


def _correct(
    config: Config, given: WeightsConfig, model: LinearVibration, method: str, readings: Readings, rotor: RotorModel
) -> dict[str, Any]:
    """Choose, print and summarise the correction weights."""
    source, asked = SourceUnits(config.machine.recordings), config.balance
    holes = [_place_holes(given, node, source) for node in model.planes]
    for plane in given.planes:
        if plane.node not in model.planes:
            raise ConfigError(
                "machine.balance.planes must be planes that had weights in some condition, since the influence of "
                f"others is not known, but node {plane.node} had none ({', '.join(map(str, model.planes))} had)"
            )
    speeds = match_speeds(np.array(asked.speeds_rpm) * RAD_S_PER_RPM, model.speeds, "balance.speeds_rpm")
    state = _find_state(config, model, readings)
    every = [
        propose_weights(
            model, state, [hole and replace(hole, most=k) for hole in holes], asked.minimise, speeds.tolist()
        )
        for k in range(given.most if given.masses == ANY else 1, given.most + 1)
    ]
    sheet = every[-1]
    whose = {"residual": "the machine's own unbalance", "condition": f"condition {asked.condition}"}
    whose["both"] = f"{whose['condition']} and the machine's own unbalance"
    tolerance = _find_tolerance(given, rotor, model.planes)
    title = f"balance sheet for {whose[asked.remove]}, by {method}: least {asked.minimise}"
    print_sheet(title, sheet, model.planes, source, tolerance)
    if len(every) > 1:
        print_fewer(every, model.planes, source)
    rows = tabulate_vibration_change(sheet, model.speeds, model.channels, source)
    print_vibration_change(rows, source.unit)
    return describe_sheet(sheet, model.planes, source, tolerance) | {
        "method": method,
        "remove": asked.remove,
        "condition": asked.condition,
        "minimise": asked.minimise,
        "vibration": rows,
    }


def _place_holes(given: WeightsConfig, node: int, source: SourceUnits) -> Holes | None:
    """The holes of the plane at a node; None where it has none."""
    plane = next((given_plane for given_plane in given.planes if given_plane.node == node), None)
    if plane is None:
        return None
    sense = 1 if plane.numbering == "with_rotation" else -1
    turn = 2 * np.pi * np.arange(plane.holes) / plane.holes
    masses = None if given.masses == ANY else tuple(given.masses)
    return Holes(source.recordings.angle_from_x(plane.first_angle) + sense * turn, plane.radius, masses, given.most)


def _find_state(config: Config, model: LinearVibration, readings: Readings) -> State:
    """What the machine shows, and which part of it is to be taken away."""
    nothing = np.zeros(len(model.planes), dtype=complex)
    vibration, asked = predict_one(model, nothing), config.balance
    if asked.remove != "condition" and config.data.baseline is not None:
        raise ConfigError(
            f"the machine's own unbalance must be in the data, but its vibration (data.baseline={config.data.baseline})"
            " was subtracted: name a condition to correct (balance.condition, balance.remove=condition)"
        )
    if asked.remove == "residual":
        return State(shown=vibration, remove=vibration, weights=nothing)
    if asked.condition not in readings.names:
        raise ConfigError(
            f"balance.condition must be a condition of the records, but got '{asked.condition}': "
            f"{nearest(str(asked.condition), readings.names)}"
        )
    c = readings.names.index(asked.condition)
    shown, known = readings.displacement[c].ravel(), readings.unbalance[c]
    weights = nothing if np.isnan(known).any() else known
    return State(shown=shown, remove=shown - vibration if asked.remove == "condition" else shown, weights=weights)


def _find_tolerance(given: WeightsConfig, rotor: RotorModel, planes: Sequence[int]) -> Tolerance | None:
    if given.tolerance is None:
        return None
    return share_tolerance(rotor, planes, given.tolerance.permissible(rotor.total_mass))
