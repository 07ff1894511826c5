"""Tell what the data determine: rank, condition number, free combination and predicted deviation of each bearing."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from pipeline.coefficients import COEFFICIENTS
from pipeline.config.schema import Config
from pipeline.data.operating_points import list_columns
from pipeline.data.tables import write_table
from pipeline.data.vibration_files import to_rpm
from pipeline.files import write_json
from pipeline.identification.combinations import combine
from pipeline.identification.losses import loss_of
from pipeline.identification.quality import finite
from pipeline.identification.training import setup_of
from pipeline.problem.budget import budget_percent
from pipeline.problem.determination import Determined, Deviations, describe_determined, summarize_determined
from pipeline.problem.diagnosis import Diagnosis
from pipeline.problem.identifiability import Solvability
from pipeline.problem.measurement import Measurement
from pipeline.reporting.combinations import describe_combinations, summarize_combinations
from pipeline.reporting.console import say, table
from pipeline.reporting.diagnosis_figure import draw_diagnosis
from pipeline.reporting.model_error import Budget, draw_budget, print_budget
from pipeline.stages.execution import StageOutput
from pipeline.stages.law_diagnosis import diagnose_laws
from pipeline.stages.measurement import load_measurement
from pipeline.stages.workspace import locate_files


def run(config: Config) -> StageOutput:
    """``diagnosis.json``, ``diagnosis.csv`` (a row a bearing and speed) and a figure over speed."""
    measurement, work = load_measurement(config), locate_files(config)
    numbers = diagnose_laws(config, measurement, describe_noise(config))
    diagnosis = diagnose(config, measurement)
    for report in diagnosis.reports:
        say(f"{config.name}: {report.sentence}")
    _print(config, diagnosis)
    expected = judge(config, measurement, diagnosis)
    judged = expected.judge()
    _print_verdicts(config, expected, judged)
    summary: dict[str, object] = {
        "stated_noise": config.stated_noise.model_dump(),
        "bearings": _summarize(diagnosis),
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
        write_table(work.folder / "diagnosis.csv", _tabulate(diagnosis, judged, measurement.dataset.operating)),
        draw_diagnosis(work.figure("diagnosis"), diagnosis.reports, diagnosis.relative, describe_noise(config)),
    ]
    written += _write_budget(config, measurement, diagnosis)
    return StageOutput(summary, {"data_fingerprint": measurement.dataset.fingerprint}, written)


def _write_budget(config: Config, measurement: Measurement, diagnosis: Diagnosis) -> list[Path]:
    """The systematic budget of ``identify.model_parameters``; none without them, or where a speed tells too little."""
    percent = budget_percent(measurement, diagnosis.answer) if measurement.parameters else None
    if percent is None:
        return []
    names, nodes = measurement.unknowns.names, measurement.rotor.bearing_nodes
    shared = measurement.unknowns.shared
    coefficients = [names[u] if shared else f"{names[u]} node {nodes[m]}" for m, u in measurement.unknowns.active]
    budget = Budget(config.identify.model_parameters.deviations, coefficients, percent)
    print_budget(config.name, budget)
    work = locate_files(config)
    columns = {f"{kind}_percent": values for kind, values in percent.items()}
    return [
        write_table(work.folder / "systematic_budget.csv", {"coefficient": coefficients, **columns}),
        draw_budget(work.figure("systematic_budget"), budget),
    ]


def diagnose(config: Config, measurement: Measurement) -> Diagnosis:
    """Diagnose the measurement by the configured loss. Raises DataError for sensors that do not suffice."""
    setup = setup_of(config)
    return loss_of(setup.loss).diagnose(measurement, setup)


def say_diagnosis(config: Config, measurement: Measurement) -> tuple[Diagnosis, Deviations]:
    """A line a bearing, before a fit; with the deviations that its verdicts rest on."""
    diagnosis = diagnose(config, measurement)
    expected = judge(config, measurement, diagnosis)
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
    return diagnosis, expected


def judge(config: Config, measurement: Measurement, diagnosis: Diagnosis) -> Deviations:
    """The deviations that the stated noise will leave to the configured fit."""
    setup = setup_of(config)
    return loss_of(setup.loss).expect(measurement, setup, diagnosis)


def describe_noise(config: Config) -> str:
    """The stated noise, such as ``0.1 % noise``, or what takes its place in records of conditions."""
    if config.machine.recordings.planes:
        return "the noise of the conditions"
    noise = config.stated_noise
    parts = [f"{100 * noise.multiplicative:g} %"] if noise.multiplicative else []
    parts += [f"{1e6 * noise.additive:g} um"] if noise.additive else []
    return " and ".join(parts) + " noise"


def _summarize(diagnosis: Diagnosis) -> dict[str, object]:
    """Return the diagnosis by node; an infinite number is null, since JSON has none."""
    result: dict[str, object] = {}
    for report in diagnosis.reports:
        shared = {
            "verdict": report.verdict.value,
            "reason": report.reason,
            "unknowns": len(report.unknowns),
            "rank": {"least": int(report.rank.min()), "most": int(report.rank.max())},
            "orbit_rank": {"least": finite(report.orbit_rank.min()), "most": finite(report.orbit_rank.max())},
            "condition_number": {
                "median": finite(np.median(report.condition)),
                "max": finite(report.condition.max()),
            },
            "least_determined": report.free_combination(),
        }
        for node in report.nodes:
            deviations = {name: finite(100 * np.median(v)) for name, v in diagnosis.relative(node).items()}
            result[str(node)] = shared | {"median_deviation_percent": deviations}
    return result


def _tabulate(
    diagnosis: Diagnosis, judged: Sequence[Determined], operating: Mapping[str, np.ndarray]
) -> list[dict[str, object]]:
    """A row a bearing and operating point; the verdicts are those over all points."""
    rows: list[dict[str, object]] = []
    for report in diagnosis.reports:
        for node in report.nodes:
            b = diagnosis.answer.nodes.index(node)
            columns = {
                "speed_rpm": to_rpm(report.speeds),
                **list_columns(operating),
                "unknowns": np.full(len(report.speeds), len(report.unknowns)),
                "rank": report.rank,
                "condition_number": report.condition,
                "orbit_rank": report.orbit_rank,
                "orbit_condition_number": report.orbit_condition,
            }
            columns |= {f"singular_value_{i + 1}": values for i, values in enumerate(report.singular_values.T)}
            columns |= {
                f"{name}_std": diagnosis.deviation[b, :, COEFFICIENTS.index(name)] for name in diagnosis.relative(node)
            }
            verdicts = {
                f"{coefficient.name}_verdict": coefficient.verdict.value
                for coefficient in judged
                if coefficient.node == node
            }
            names, values = list(columns), [column.tolist() for column in columns.values()]
            every = zip(*values, strict=True)
            rows += [{"bearing_node": node, **dict(zip(names, row, strict=True)), **verdicts} for row in every]
    return rows


def _print_verdicts(config: Config, expected: Deviations, judged: Sequence[Determined]) -> None:
    nodes = expected.table.nodes
    names = list(dict.fromkeys(coefficient.name for coefficient in judged))
    cells = {
        (coefficient.node, coefficient.name): f"+- {100 * coefficient.deviation:.2g} %, {coefficient.verdict.value}"
        for coefficient in judged
    }
    rows = [[name, *(cells.get((node, name), "") for node in nodes)] for name in names]
    header = ["coefficient", *(f"bearing at node {node}" for node in nodes)]
    table(f"{config.name}: each coefficient at {describe_noise(config)}, {expected.of} (medians)", header, rows)


def _print(config: Config, diagnosis: Diagnosis) -> None:
    header = ["bearing", "rank", "orbits", "condition (median)", "worst", "worst coefficient", "determined least"]
    rows = []
    for report in diagnosis.reports:
        name, deviation = diagnosis.worst(report)
        worst = f"{name} +- {100 * deviation:.2g} %" if np.isfinite(deviation) else f"{name} free"
        rows.append(
            [
                report.where,
                f"{int(np.median(report.rank))} of {len(report.unknowns)}",
                "" if np.isnan(report.orbit_rank).any() else f"{int(np.median(report.orbit_rank))} of 2",
                f"{np.median(report.condition):.3g}",
                f"{report.condition.max():.3g}",
                worst,
                report.free_combination(),
            ]
        )
    table(f"{config.name}: what the data determine at each speed, at {describe_noise(config)} (medians)", header, rows)
