"""What the data determine: rank, condition number, free combination and predicted deviation of every bearing."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from pipeline.coefficients import COEFFICIENTS
from pipeline.config.schema import Config
from pipeline.data.tables import write_table
from pipeline.data.vibration_files import to_rpm
from pipeline.files import write_json
from pipeline.reporting.console import say, table
from pipeline.reporting.diagnosis_figures import diagnosis_figure
from pipeline.stages.diagnosis import Diagnosis, diagnose, noise_words
from pipeline.stages.inputs import load_inputs
from pipeline.stages.run import StageOutput, flat_metrics, workspace

if TYPE_CHECKING:
    import pandas as pd


def run(config: Config) -> StageOutput:
    """``diagnosis.json``, ``diagnosis.csv`` (a row a bearing and speed) and a figure over speed."""
    inputs = load_inputs(config)
    diagnosis = diagnose(config, inputs)
    work = workspace(config)
    for account in diagnosis.accounts:
        say(f"{config.name}: {account.sentence}")
    _print(config, diagnosis)
    summary = {"stated_noise": config.stated_noise.model_dump(), "bearings": _summary(diagnosis)}
    written = [
        write_json(work.folder / "diagnosis.json", summary),
        write_table(work.folder / "diagnosis.csv", _rows(diagnosis)),
        diagnosis_figure(work.figure("diagnosis"), diagnosis.accounts, diagnosis.relative, noise_words(config)),
    ]
    return StageOutput(flat_metrics(summary), {"data_fingerprint": inputs.dataset.fingerprint}, written)


def _finite(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def _summary(diagnosis: Diagnosis) -> dict[str, object]:
    """By node; an infinite number is null, as JSON has none."""
    result: dict[str, object] = {}
    for account in diagnosis.accounts:
        shared = {
            "verdict": account.verdict.value,
            "reason": account.reason,
            "unknowns": len(account.unknowns),
            "rank": {"least": int(account.rank.min()), "most": int(account.rank.max())},
            "orbit_rank": {"least": _finite(account.orbit_rank.min()), "most": _finite(account.orbit_rank.max())},
            "condition_number": {
                "median": _finite(np.median(account.condition)),
                "max": _finite(account.condition.max()),
            },
            "least_determined": account.free_combination(),
        }
        for node in account.nodes:
            deviations = {name: _finite(100 * np.median(v)) for name, v in diagnosis.relative(node).items()}
            result[str(node)] = shared | {"median_deviation_percent": deviations}
    return result


def _rows(diagnosis: Diagnosis) -> pd.DataFrame:
    import pandas as pd

    frames = []
    for account in diagnosis.accounts:
        for node in account.nodes:
            b = diagnosis.answer.nodes.index(node)
            columns: dict[str, object] = {
                "bearing_node": node,
                "speed_rpm": to_rpm(account.speeds),
                "unknowns": len(account.unknowns),
                "rank": account.rank,
                "condition_number": account.condition,
                "orbit_rank": account.orbit_rank,
                "orbit_condition_number": account.orbit_condition,
            }
            columns |= {f"singular_value_{i + 1}": values for i, values in enumerate(account.singular_values.T)}
            columns |= {
                f"{name}_std": diagnosis.deviation[b, :, COEFFICIENTS.index(name)] for name in diagnosis.relative(node)
            }
            frames.append(pd.DataFrame(columns))
    return pd.concat(frames, ignore_index=True)


def _print(config: Config, diagnosis: Diagnosis) -> None:
    header = ["bearing", "rank", "orbits", "condition (median)", "worst", "worst coefficient", "determined least"]
    rows = []
    for account in diagnosis.accounts:
        name, deviation = diagnosis.worst(account)
        worst = f"{name} +- {100 * deviation:.2g} %" if np.isfinite(deviation) else f"{name} free"
        rows.append(
            [
                account.where,
                f"{int(np.median(account.rank))} of {len(account.unknowns)}",
                "" if np.isnan(account.orbit_rank).any() else f"{int(np.median(account.orbit_rank))} of 2",
                f"{np.median(account.condition):.3g}",
                f"{account.condition.max():.3g}",
                worst,
                account.free_combination(),
            ]
        )
    table(f"{config.name}: what the data determine at each speed, at {noise_words(config)} (medians)", header, rows)
