"""Identified against modelled coefficients; per-speed least squares and the residual beside them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from pipeline.coefficients import COEFFICIENTS
from pipeline.config.schema import Config
from pipeline.data.coefficient_files import write_coefficients
from pipeline.data.tables import write_table
from pipeline.data.vibration_files import to_rpm
from pipeline.evaluation.errors import find_worst_mean, list_metrics, measure_coverage, measure_errors
from pipeline.files import write_json
from pipeline.identification.losses import loss_of
from pipeline.identification.uncertainty import Uncertainty, load_uncertainty
from pipeline.problem.measurement import Measurement
from pipeline.reporting.console import say
from pipeline.reporting.error_table import describe_quality, describe_verdicts, make_error_table, print_error_table
from pipeline.reporting.figures import draw_coefficients, draw_history
from pipeline.reporting.identified_figure import draw_identified
from pipeline.reporting.physical_numbers import describe_law, list_numbers, print_numbers
from pipeline.reporting.state_figures import draw_states
from pipeline.rotor.bearing_table import BearingTable
from pipeline.stages.diagnose import diagnose
from pipeline.stages.execution import StageOutput
from pipeline.stages.measurement import (
    load_identified,
    load_measurement,
    load_modelled,
    load_quality,
    update_measurement,
)
from pipeline.stages.unmeasured import judge_beyond, judge_numbers
from pipeline.stages.workspace import Workspace, locate_files
from pipeline.twin.superposition import compare_held_out


def run(config: Config) -> StageOutput:
    """Errors, their summary (worst bearing, parts per million), least-squares coefficients, Figures 3 and 4."""
    work, measurement = locate_files(config), load_measurement(config)
    data, identified = measurement.dataset, load_identified(config, measurement)
    uncertainty = load_uncertainty(work.folder, identified)
    deviation = None if uncertainty is None else uncertainty.deviation(identified, data.speeds, data.operating)
    names = identified.unknowns.by_bearing
    answer = identified.table(update_measurement(measurement, uncertainty).updated_known)
    modelled = load_modelled(config, measurement)
    diagnosis = diagnose(config, measurement)
    conventional = diagnosis.answer if diagnosis.by_least_squares else None
    quality = load_quality(config)
    metrics: dict[str, object] = {"coefficients": {}, **quality}
    summary: dict[str, object] = {}
    if "residual" in quality:
        summary["residual_ppm"] = 1e6 * quality["residual"]["mean_over_bearing_force"]
    written: list[Path] = []
    if conventional is not None:
        written.append(write_coefficients(work.folder / "least_squares_coefficients.csv", conventional))
    errors = None if modelled is None else measure_errors(answer, modelled, names)
    beside = None if modelled is None or conventional is None else measure_errors(conventional, modelled, names)
    if modelled is not None and errors is not None:
        summary["mean_error_ppm"] = {name: 1e4 * find_worst_mean(errors, name) for name in config.identify.named()}
        metrics["coefficients"] = list_metrics(errors)
        if beside is not None:
            metrics["least_squares"] = list_metrics(beside)
        if deviation is not None:
            metrics["within_95_percent_interval"] = _measure_coverage(answer, modelled, deviation, names)
    rows = make_error_table(answer, names, modelled, errors, beside, deviation)
    written.append(write_table(work.folder / "coefficient_errors.csv", rows))
    print_error_table(config.name, rows)
    if "determined" in quality:
        say(f"{config.name}: {describe_verdicts(quality)}")
    loss = loss_of(config.loss)
    if modelled is None or loss.weighs_noise:
        say(f"{config.name}: {describe_quality(quality)}")
    print_numbers(config.name, list_numbers(quality.get("physical_numbers", {}), config))
    for text in describe_law(quality, config.model.kind):
        say(f"{config.name}: {text}")
    if "physical_numbers" in quality:
        metrics["physical_numbers"] = judge_numbers(config, quality["physical_numbers"])
    metrics |= judge_beyond(config, identified, measurement.dataset.speeds)
    if loss.weighs_noise:
        metrics["held_out"] = _judge_held_out(config, update_measurement(measurement, uncertainty), answer, uncertainty)
    written += [
        draw_history(work.figure("training"), work.history, loss.label),
        *_draw(work, answer, modelled, names, deviation),
        write_json(work.metrics, metrics),
        write_json(work.folder / "summary.json", summary),
    ]
    return StageOutput(metrics, {"data_fingerprint": measurement.dataset.fingerprint}, [*written, work.identified])


def _draw(
    work: Workspace,
    answer: BearingTable,
    modelled: BearingTable | None,
    names: Sequence[Sequence[str]],
    deviation: np.ndarray | None,
) -> list[Path]:
    """The coefficients over the speed; with operating conditions a line a state."""
    letters = {"stiffness": "k", "damping": "c"}
    if answer.operating:
        shown = {"identified": None, **letters}
        return [
            draw_states(work.figure(name), answer, modelled, names, deviation, letter) for name, letter in shown.items()
        ]
    over_speed = [
        draw_coefficients(work.figure(name), letter, answer, modelled, names, deviation)
        for name, letter in letters.items()
    ]
    return [draw_identified(work.figure("identified"), answer, modelled, names, deviation), *over_speed]


def _judge_held_out(
    config: Config, measurement: Measurement, answer: BearingTable, uncertainty: Uncertainty | None
) -> dict[str, dict[str, object]]:
    """What no fit saw, beside what superposition and interpolation make of it without a bearing model."""
    unbalance = None if uncertainty is None else uncertainty.residual_unbalance
    summary: dict[str, dict[str, object]] = {}
    for held_out in compare_held_out(measurement, answer, unbalance, config.training):
        rpm = to_rpm(held_out.speeds)
        what = f"{'range of ' if held_out.together else ''}speeds, {rpm.min():g} to {rpm.max():g} rpm"
        if held_out.state:
            what = f"conditions, {held_out.state}"
        what, rival = (
            (what, "interpolation") if held_out.run is None else (f"run {held_out.run}", "influence coefficients")
        )
        said = "no answer" if held_out.rival is None else f"{held_out.rival:.3g} %"
        told = "no prediction, since coefficients leave all bounds where nothing was fitted"
        if held_out.model is not None:
            told = f"predicted to {held_out.model:.3g} % (root mean square)"
        say(f"{config.name}: held-out {what}: {told}; by {rival}: {said}")
        summary[what] = {"model_error_percent": held_out.model, "rival": rival, "rival_error_percent": held_out.rival}
    return summary


def _measure_coverage(
    answer: BearingTable, modelled: BearingTable, deviation: np.ndarray, names: Sequence[Sequence[str]]
) -> dict[str, dict[str, float]]:
    """Percent of the speeds at which the modelled coefficient lies in the nominal 95 % interval."""
    result: dict[str, dict[str, float]] = {}
    for b, node in enumerate(answer.nodes):
        for name in names[b]:
            c = COEFFICIENTS.index(name)
            share = measure_coverage(answer.values[b, :, c] - modelled.values[b, :, c], deviation[b, :, c])
            result.setdefault(str(node), {})[name] = float(share)
    return result
