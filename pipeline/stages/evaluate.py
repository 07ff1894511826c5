"""Identified against modelled coefficients; per-speed least squares and the residual beside them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

from pipeline.config.schema import Config
from pipeline.data.coefficient_files import write_coefficients
from pipeline.data.tables import write_table
from pipeline.data.vibration_files import to_rpm
from pipeline.evaluation.errors import (
    find_worst_mean,
    judge_numbers,
    list_coverage,
    measure_errors,
    measure_unmeasured,
    model_unmeasured,
)
from pipeline.files import write_json
from pipeline.identification.fit import loss_of
from pipeline.identification.identified import Answer
from pipeline.reporting.coefficient_figures import Coefficients, draw_coefficients
from pipeline.reporting.console import say, warn
from pipeline.reporting.fit_tables import (
    describe_quality,
    describe_verdicts,
    make_error_table,
    print_error_table,
    print_laws,
)
from pipeline.reporting.training import draw_history
from pipeline.stages.analysis import Analysis
from pipeline.stages.measurement import diagnose, load_modelled, load_quality, restore
from pipeline.tracking import StageRecord
from pipeline.twin.prediction import compare_held_out
from pipeline.write_numbers import write_number


def run(analysis: Analysis) -> StageRecord:
    """Errors, their summary (worst bearing, parts per million), least-squares coefficients, Figures 3 and 4."""
    config, answer = analysis.config, restore(analysis)
    table, names = answer.stated, answer.names
    modelled, quality = load_modelled(config, answer.measurement), load_quality(config)
    diagnosis = diagnose(analysis)
    conventional = replace(diagnosis.expected, deviation=None) if diagnosis.by_least_squares else None
    summary: dict[str, object] = {}
    written: list[Path] = []
    if "residual" in quality:
        summary["residual_ppm"] = 1e6 * quality["residual"]["mean_over_bearing_force"]
    if conventional is not None:
        written.append(write_coefficients(analysis.folder / "least_squares_coefficients.csv", conventional))
    if not (bounded := table.bounded).all():
        rpm = to_rpm(table.speeds[~bounded])
        warn(
            f"{config.name}: coefficients leave all bounds from {rpm.min():g} to {rpm.max():g} rpm, which was held out"
        )
        table = table.at(bounded)
        modelled = None if modelled is None else modelled.at(bounded)
        conventional = None if conventional is None else conventional.at(bounded)
    errors, beside = (
        {} if modelled is None or each is None else measure_errors(each, modelled, names)
        for each in (table, conventional)
    )
    shown, metrics = Coefficients(table, modelled, names), {"coefficients": errors, **quality}
    if modelled is not None:
        summary["mean_error_ppm"] = {name: 1e4 * find_worst_mean(errors, name) for name in config.identify.named()}
        metrics |= {"least_squares": beside} if beside else {}
        metrics |= {"within_95_percent_interval": list_coverage(table, modelled, names)} if shown.stated else {}
    rows = make_error_table(shown, errors, beside)
    written.append(write_table(analysis.folder / "coefficient_errors.csv", rows))
    print_error_table(config.name, rows)
    if "determined" in quality:
        say(f"{config.name}: {describe_verdicts(quality)}")
    loss = loss_of(config.loss)
    if modelled is None or loss.weighs_noise:
        say(f"{config.name}: {describe_quality(quality)}")
    if numbers := quality.get("physical_numbers"):
        print_laws(config, quality)
        metrics["physical_numbers"] = judge_numbers(numbers, config.machine)
    elsewhere = model_unmeasured(config, answer.table.speeds)
    beyond = {} if elsewhere is None else measure_unmeasured(answer.model.table(elsewhere), elsewhere, names)
    for state, error in beyond.items():
        worst = max(entry["median_error_percent"] for names_of in error.values() for entry in names_of.values())
        say(
            f"{config.name}: at {state}, which no run has, the worst coefficient is off by "
            f"{write_number(worst, digits=3)} % (median)"
        )
    if beyond:
        metrics["unmeasured"] = beyond
    if loss.weighs_noise:
        metrics["held_out"] = _judge_held_out(config, answer)
    written += [
        draw_history(analysis.figure("training"), analysis.history, loss.label),
        *(draw_coefficients(analysis.figure(name), shown, letter) for name, letter in _FIGURES.items()),
        write_json(analysis.metrics, metrics),
        write_json(analysis.folder / "summary.json", summary),
    ]
    return StageRecord(metrics, answer.tags, [*written, analysis.identified])


_FIGURES = {"identified": "", "stiffness": "k", "damping": "c"}


def _judge_held_out(config: Config, answer: Answer) -> dict[str, dict[str, Any]]:
    """What no fit saw, beside what superposition and interpolation make of it without a bearing model."""
    compared = compare_held_out(answer.measurement, answer.table, answer.unbalance, config.training)
    for what, held_out in compared.items():
        model, rival = held_out["model_error_percent"], held_out["rival_error_percent"]
        told = (
            "no prediction, since coefficients leave all bounds where nothing was fitted"
            if model is None
            else f"predicted to {write_number(model, digits=3)} % (root mean square)"
        )
        said = "no answer" if rival is None else f"{write_number(rival, digits=3)} %"
        say(f"{config.name}: held-out {what}: {told}; by {held_out['rival']}: {said}")
    return compared
