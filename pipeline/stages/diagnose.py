"""What the data determine: rank, condition number, free combination and predicted deviation of every bearing."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from pipeline.coefficients import COEFFICIENTS
from pipeline.config.schema import Config
from pipeline.data.tables import write_table
from pipeline.data.vibration_files import to_rpm
from pipeline.files import write_json
from pipeline.identification.losses import loss_of
from pipeline.identification.quality import finite
from pipeline.identification.training import setup_of
from pipeline.problem.diagnosis import Diagnosis
from pipeline.problem.identifiability import Verdict
from pipeline.problem.measurement import Measurement
from pipeline.reporting.console import say, table
from pipeline.reporting.figures import draw_diagnosis
from pipeline.stages.execution import StageOutput, flat_metrics
from pipeline.stages.measurement import load_measurement
from pipeline.stages.workspace import workspace

if TYPE_CHECKING:
    import pandas as pd


def run(config: Config) -> StageOutput:
    """``diagnosis.json``, ``diagnosis.csv`` (a row a bearing and speed) and a figure over speed."""
    measurement, work = load_measurement(config), workspace(config)
    diagnosis = diagnose(config, measurement)
    for report in diagnosis.reports:
        say(f"{config.name}: {report.sentence}")
    _print(config, diagnosis)
    summary = {"stated_noise": config.stated_noise.model_dump(), "bearings": _summary(diagnosis)}
    written = [
        write_json(work.folder / "diagnosis.json", summary),
        write_table(work.folder / "diagnosis.csv", _rows(diagnosis)),
        draw_diagnosis(work.figure("diagnosis"), diagnosis.reports, diagnosis.relative, noise_words(config)),
    ]
    return StageOutput(flat_metrics(summary), {"data_fingerprint": measurement.dataset.fingerprint}, written)


def diagnose(config: Config, measurement: Measurement) -> Diagnosis:
    """What the measurement determines by the configured loss. Raises DataError for sensors that do not suffice."""
    setup = setup_of(config)
    return loss_of(setup.loss).diagnose(measurement, setup)


def say_diagnosis(config: Config, measurement: Measurement) -> Diagnosis:
    """A line a bearing, before a fit."""
    diagnosis = diagnose(config, measurement)
    for report in diagnosis.reports:
        text = report.sentence
        if report.verdict is not Verdict.NOT_IDENTIFIABLE:
            name, deviation = diagnosis.worst(report)
            method = "least squares" if diagnosis.by_least_squares else "the fit"
            text += (
                f"; condition number {np.median(report.condition):.2g} (worst {report.condition.max():.2g}); at "
                f"{noise_words(config)} {method} gives {name} to {100 * deviation:.2g} %"
            )
        say(f"{config.name}: {text}")
    return diagnosis


def noise_words(config: Config) -> str:
    """The stated noise, such as ``0.1 % noise``."""
    noise = config.stated_noise
    parts = [f"{100 * noise.multiplicative:g} %"] if noise.multiplicative else []
    parts += [f"{1e6 * noise.additive:g} um"] if noise.additive else []
    return " and ".join(parts) + " noise"


def _summary(diagnosis: Diagnosis) -> dict[str, object]:
    """By node; an infinite number is null, as JSON has none."""
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


def _rows(diagnosis: Diagnosis) -> pd.DataFrame:
    import pandas as pd

    frames = []
    for report in diagnosis.reports:
        for node in report.nodes:
            b = diagnosis.answer.nodes.index(node)
            columns: dict[str, object] = {
                "bearing_node": node,
                "speed_rpm": to_rpm(report.speeds),
                "unknowns": len(report.unknowns),
                "rank": report.rank,
                "condition_number": report.condition,
                "orbit_rank": report.orbit_rank,
                "orbit_condition_number": report.orbit_condition,
            }
            columns |= {f"singular_value_{i + 1}": values for i, values in enumerate(report.singular_values.T)}
            columns |= {
                f"{name}_std": diagnosis.deviation[b, :, COEFFICIENTS.index(name)] for name in diagnosis.relative(node)
            }
            frames.append(pd.DataFrame(columns))
    return pd.concat(frames, ignore_index=True)


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
    table(f"{config.name}: what the data determine at each speed, at {noise_words(config)} (medians)", header, rows)
