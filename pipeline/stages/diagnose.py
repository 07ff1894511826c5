"""Tell what the data determine: rank, condition number, free combination and predicted deviation of each bearing."""

from __future__ import annotations

from pathlib import Path

from pipeline.data.tables import write_table
from pipeline.errors import ConfigError
from pipeline.files import write_json
from pipeline.identification.combinations import combine
from pipeline.identification.fit import loss_of
from pipeline.identification.training import setup_of
from pipeline.problem.determination import judge_determined, summarize_determined
from pipeline.problem.diagnosis import budget_percent
from pipeline.reporting.console import say, table, warn
from pipeline.reporting.diagnosis import (
    describe_combinations,
    describe_series,
    draw_budget,
    draw_diagnosis,
    list_bearings,
    list_determined,
    name_tolerance,
    print_budget,
    summarize_combinations,
    summarize_diagnosis,
    tabulate_diagnosis,
)
from pipeline.stages.analysis import Analysis, use_threads
from pipeline.stages.before_fit import diagnose_laws
from pipeline.stages.measurement import diagnose, expect, prepare
from pipeline.tracking import StageRecord
from pipeline.twin.twin import plan_twin


def run(analysis: Analysis) -> StageRecord:
    """``diagnosis.json``, ``diagnosis.csv`` (a row a bearing and speed) and a figure over speed."""
    config, measurement = analysis.config, prepare(analysis)
    use_threads(config)
    noise, numbers = config.describe_noise(), diagnose_laws(analysis)
    diagnosis = diagnose(analysis)
    try:
        plan_twin(config.machine, measurement)
    except ConfigError as error:
        warn(f"{config.name}: no prediction can follow a fit, and summary and report will lack it: {error}")
    for report in diagnosis.reports:
        say(f"{config.name}: {report.sentence}")
    bearings = summarize_diagnosis(diagnosis)
    table(*list_bearings(f"{config.name}: what the data determine at each speed, at {noise}", bearings))
    expected = expect(analysis)
    judged = judge_determined(expected)
    table(*list_determined(f"{config.name}: each coefficient at {noise}, {expected.by} (medians)", judged))
    summary: dict[str, object] = {
        "stated_noise": config.stated_noise.model_dump(),
        "bearings": bearings,
        "determined": {"by": expected.by, "coefficients": summarize_determined(judged)},
        **numbers,
    }
    judges = diagnosis.solved and loss_of(config.loss).weighs_noise
    if judges and (combined := combine(measurement, setup_of(config))) is not None:
        say(f"{config.name}: {describe_combinations(combined)}")
        summary["combinations"] = summarize_combinations(combined)
        if series := describe_series(combined, measurement.rotor.unseen_casings(measurement.dataset.channels)):
            warn(f"{config.name}: {series}")
    written = [
        write_json(analysis.folder / "diagnosis.json", summary),
        write_table(
            analysis.folder / "diagnosis.csv", tabulate_diagnosis(diagnosis, judged, measurement.dataset.operating)
        ),
        draw_diagnosis(analysis.figure("diagnosis"), diagnosis.reports, diagnosis.relative, noise),
        *_write_budget(analysis),
    ]
    return StageRecord(summary, {"data_fingerprint": measurement.dataset.fingerprint}, written)


def _write_budget(analysis: Analysis) -> list[Path]:
    """The systematic budget of ``identify.model_parameters``; none without them, or where a speed tells too little."""
    config, measurement = analysis.config, prepare(analysis)
    stated = config.identify.model_parameters.deviations
    every = budget_percent(measurement, diagnose(analysis).expected) if stated else None
    if every is None:
        return []
    names, nodes = measurement.unknowns.names, measurement.rotor.bearing_nodes
    shared = measurement.unknowns.shared
    coefficients = [names[u] if shared else f"{names[u]} node {nodes[m]}" for m, u in measurement.unknowns.active]
    named = {name_tolerance(kind, stated[kind]): every[kind] for kind in stated}
    print_budget(config.name, coefficients, named)
    columns = {f"{kind}_percent": every[kind] for kind in stated}
    return [
        write_table(analysis.folder / "systematic_budget.csv", {"coefficient": coefficients, **columns}),
        draw_budget(analysis.figure("systematic_budget"), coefficients, named),
    ]
