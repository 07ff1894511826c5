"""The digital twin (paper, Figure 5): vibration never seen, critical speeds, stability."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from pipeline.config.schema import Config
from pipeline.data.operating import name_state
from pipeline.data.tables import write_table
from pipeline.files import write_json
from pipeline.reporting.console import say, warn
from pipeline.reporting.matplotlib_figures import write_figure
from pipeline.reporting.twin import (
    draw_modes,
    draw_orbit,
    draw_response,
    draw_time,
    print_twin,
    summarize_modes,
    tabulate_modes,
    tabulate_vibration,
)
from pipeline.stages.analysis import Analysis, made_once
from pipeline.stages.measurement import ANSWER, load_modelled, prepare, restore
from pipeline.stages.verdict import say_reservation
from pipeline.tracking import StageRecord
from pipeline.twin.at_conditions import say_beyond
from pipeline.twin.prediction import error_percent
from pipeline.twin.twin import Twin, build_twin, plan_twin, superpose_unseen
from pipeline.write_numbers import write_rough


@made_once(*ANSWER)
def load_twin(analysis: Analysis) -> Twin:
    """The twin, training first where its model is missing. Raises as :func:`pipeline.twin.twin.build_twin`."""
    config = analysis.config
    plan_twin(config.machine, prepare(analysis))  # before any fit
    answer = restore(analysis)
    return build_twin(config.machine, answer, load_modelled(config, answer.measurement))


def run(analysis: Analysis) -> StageRecord:
    """``prediction.json``, ``prediction.csv``, ``modes.csv``, Figure 6 and the Campbell diagram."""
    config, measurement, twin = analysis.config, restore(analysis).measurement, load_twin(analysis)
    vibration, at = dict(twin.vibration), twin.at
    running = config.machine.prediction.speed_rpm
    summary: dict[str, Any] = {name: summarize_modes(behaviour, running) for name, behaviour in twin.behaviour.items()}
    summary["reservation"] = say_reservation(analysis)
    beyond = say_beyond(measurement.dataset.operating, twin.operating)
    if twin.operating:
        summary |= {"operating": dict(twin.operating), "outside_measured": beyond}
    for text in beyond:
        warn(f"{config.name}: {text}: the bands grow there, and rest on the model of the coefficients alone")
    if "modelled" in vibration:
        error = vibration["identified"].error_percent(vibration["modelled"])
        summary["displacement"] = {
            direction: {"mean_error_percent": float(e.mean()), "max_error_percent": float(e.max())}
            for direction, e in zip("xy", error.T, strict=True)
        }
    summed = superpose_unseen(config.machine, measurement, twin)
    if not isinstance(summed, str) and "modelled" in vibration:
        pairs = zip("xy", summed.T, vibration["modelled"].displacement.T, strict=True)
        summary["influence_coefficients"] = {"error_percent": {d: error_percent(*pair) for d, *pair in pairs}}
    print_twin(config, summary, vibration, at, twin.operating)
    _say_superposed(config, summed, summary, at)
    written = [
        write_json(analysis.folder / "prediction.json", summary),
        write_table(analysis.folder / "prediction.csv", tabulate_vibration(vibration, twin.operating)),
        write_table(analysis.folder / "modes.csv", tabulate_modes(twin.behaviour, twin.operating)),
        draw_time(analysis.figure("prediction_time"), vibration, at, name_state(twin.operating)),
        draw_orbit(analysis.figure("prediction_orbit"), vibration, at, name_state(twin.operating)),
        draw_response(analysis.figure("prediction_response"), vibration, name_state(twin.operating)),
        write_figure(analysis.figure("campbell"), draw_modes(twin.behaviour, name_state(twin.operating))),
    ]
    return StageRecord(summary, restore(analysis).tags, written)


def _say_superposed(config: Config, summed: np.ndarray | str, summary: Mapping[str, Any], at: int) -> None:
    beside = f"{config.name}: influence coefficients (sums of the runs, without a bearing model)"
    if isinstance(summed, str):
        say(f"{beside} have no answer: {summed}")
        return
    size, error = 1e6 * np.abs(summed[at]), summary.get("influence_coefficients", {}).get("error_percent", {})
    off = ", ".join(f"{direction} {write_rough(percent)} %" for direction, percent in error.items())
    shown = f"x {size[0]:.5f} um, y {size[1]:.5f} um at {config.machine.prediction.speed_rpm:g} rpm"
    say(f"{beside}: {shown}" + (f"; error over all speeds (root mean square) {off}" if off else ""))
