"""Tell what the data determine: rank, condition number, free combination and predicted deviation of each bearing."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from pipeline.config.schema import Config
from pipeline.data.tables import write_table
from pipeline.files import write_json
from pipeline.identification.combinations import combine
from pipeline.identification.fit import loss_of
from pipeline.identification.training import setup_of
from pipeline.problem.budget import budget_percent
from pipeline.problem.determination import describe_determined, summarize_determined
from pipeline.problem.identifiability import Solvability
from pipeline.reporting.console import say
from pipeline.reporting.diagnosis import (
    describe_combinations,
    draw_budget,
    draw_diagnosis,
    name_tolerance,
    print_budget,
    print_determined,
    print_diagnosis,
    summarize_combinations,
    summarize_diagnosis,
    tabulate_diagnosis,
)
from pipeline.stages.analysis import Analysis
from pipeline.stages.execution import StageOutput, use_threads
from pipeline.stages.law_diagnosis import diagnose_laws
from pipeline.stages.measurement import diagnose, expect, prepare


def run(analysis: Analysis) -> StageOutput:
    """``diagnosis.json``, ``diagnosis.csv`` (a row a bearing and speed) and a figure over speed."""
    config, measurement, work = analysis.config, prepare(analysis), analysis.files
    use_threads(config)
    noise = describe_noise(config)
    numbers = diagnose_laws(config, measurement, noise)
    diagnosis = diagnose(analysis)
    for report in diagnosis.reports:
        say(f"{config.name}: {report.sentence}")
    print_diagnosis(config.name, diagnosis, noise)
    expected = expect(analysis)
    judged = expected.judge()
    print_determined(config.name, expected, judged, noise)
    summary: dict[str, object] = {
        "stated_noise": config.stated_noise.model_dump(),
        "bearings": summarize_diagnosis(diagnosis),
        "determined": {"by": expected.of, "coefficients": summarize_determined(judged)},
    }
    summary |= numbers
    solvable = all(report.verdict is not Solvability.NOT_IDENTIFIABLE for report in diagnosis.reports)
    if solvable and diagnosis.by_least_squares and loss_of(config.loss).weighs_noise:
        combined = combine(measurement, setup_of(config))
        if combined is not None:
            say(f"{config.name}: {describe_combinations(combined)}")
            summary["combinations"] = summarize_combinations(combined)
    written = [
        write_json(work.folder / "diagnosis.json", summary),
        write_table(
            work.folder / "diagnosis.csv", tabulate_diagnosis(diagnosis, judged, measurement.dataset.operating)
        ),
        draw_diagnosis(work.figure("diagnosis"), diagnosis.reports, diagnosis.relative, noise),
    ]
    written += _write_budget(analysis)
    return StageOutput(summary, {"data_fingerprint": measurement.dataset.fingerprint}, written)


def _write_budget(analysis: Analysis) -> list[Path]:
    """The systematic budget of ``identify.model_parameters``; none without them, or where a speed tells too little."""
    config, measurement, work = analysis.config, prepare(analysis), analysis.files
    stated = config.identify.model_parameters.deviations
    every = budget_percent(measurement, diagnose(analysis).answer) if stated else None
    if every is None:
        return []
    percent = {kind: every[kind] for kind in stated}
    names, nodes = measurement.unknowns.names, measurement.rotor.bearing_nodes
    shared = measurement.unknowns.shared
    coefficients = [names[u] if shared else f"{names[u]} node {nodes[m]}" for m, u in measurement.unknowns.active]
    named = {name_tolerance(kind, stated[kind]): values for kind, values in percent.items()}
    print_budget(config.name, coefficients, named)
    columns = {f"{kind}_percent": values for kind, values in percent.items()}
    return [
        write_table(work.folder / "systematic_budget.csv", {"coefficient": coefficients, **columns}),
        draw_budget(work.figure("systematic_budget"), coefficients, named),
    ]


def say_diagnosis(analysis: Analysis) -> None:
    """A line a bearing, before a fit."""
    config, diagnosis, expected = analysis.config, diagnose(analysis), expect(analysis)
    judged = expected.judge()
    for report in diagnosis.reports:
        text = report.sentence
        if report.verdict is not Solvability.NOT_IDENTIFIABLE:
            members = [coefficient for coefficient in judged if coefficient.node in report.nodes]
            text += (
                f"; condition number {np.median(report.condition):.2g} (worst {report.condition.max():.2g}); at "
                f"{describe_noise(config)}, {expected.of}: {describe_determined(members)}"
            )
        say(f"{config.name}: {text}")


def describe_noise(config: Config) -> str:
    """The stated noise, such as ``0.1 % noise``, or what takes its place in records of conditions."""
    if config.machine.recordings.planes:
        return "the noise of the conditions"
    noise = config.stated_noise
    parts = [f"{100 * noise.multiplicative:g} %"] if noise.multiplicative else []
    parts += [f"{1e6 * noise.additive:g} um"] if noise.additive else []
    return " and ".join(parts) + " noise"
