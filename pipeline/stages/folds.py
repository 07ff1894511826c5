"""Methods that predict vibration from weights, on conditions that they have not seen; what contradicts its label."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from pipeline.balance.consistency import find_contradictions
from pipeline.balance.folds import Judged, judge, score
from pipeline.balance.influence import Influence, judge_drift
from pipeline.balance.peers import Peer, influence_peers
from pipeline.balance.physical_peers import physical_peers
from pipeline.balance.scores import floor_of_drift
from pipeline.balance.splits import list_splits
from pipeline.config.schema import Config
from pipeline.data.conditions import Conditions, gather_conditions
from pipeline.data.tables import write_table
from pipeline.errors import ConfigError, nearest
from pipeline.files import write_json
from pipeline.identification.training import setup_of
from pipeline.problem.measurement import Measurement
from pipeline.reporting.console import say, table
from pipeline.reporting.folds_figure import draw_folds
from pipeline.stages.analysis import Analysis
from pipeline.stages.contradictions import describe_contradiction, tell_contradiction
from pipeline.stages.execution import StageOutput
from pipeline.stages.measurement import load_dataset, load_measurement
from pipeline.stages.workspace import locate_files

_GRAM_MM = 1e-6
"""kg m."""


def run(analysis: Analysis) -> StageOutput:
    """``folds.json``, ``folds.csv`` (a row a task, method and choice of conditions) and a figure."""
    config = analysis.config
    work, dataset = locate_files(config), load_dataset(config)
    planes = tuple(config.identify.unbalance_planes) or None
    conditions = gather_conditions(dataset, planes)
    _require_names(config, conditions)
    contradictions, model = find_contradictions(conditions, config.folds.false_alarm_rate)
    named = [odd.name for odd in contradictions]
    kept = conditions.without(named)
    for contradiction in contradictions:
        say(f"{config.name}: {describe_contradiction(config, conditions, contradiction)}")
    calibration = config.folds.calibration
    splits = list_splits(conditions, calibration, config.folds.count, config.folds.heavy, config.seed)
    baseline = conditions.displacement[conditions.names.index(calibration[0])]
    peers = list_peers(config, load_measurement(config))
    judged = []
    for task in judge(dataset, conditions.planes, splits, peers, baseline):
        judged.append(task)
        say(f"{config.name}: {task.task}, {task.method}: {task.refusal or 'done'}")
    summary: dict[str, Any] = {
        "contradictions": [tell_contradiction(config, conditions, odd) for odd in contradictions],
        "noise": _tell_noise(kept, model),
        "floor": _floors(config, kept, model, baseline),
        "tasks": _scores(judged, named),
    }
    rows = list_rows(summary["tasks"])
    _print(config, rows)
    columns = list(dict.fromkeys(key for row in rows for key in row))
    written = [
        write_json(work.folder / "folds.json", summary),
        write_table(
            work.folder / "folds.csv", {key: np.array([row.get(key, np.nan) for row in rows]) for key in columns}
        ),
        draw_folds(work.figure("folds"), rows, summary["floor"]["folds"]["median_relative_error"]),
    ]
    return StageOutput(summary, {"data_fingerprint": dataset.fingerprint}, written)


def list_peers(config: Config, measurement: Measurement) -> dict[str, Peer]:
    """The methods that are tried."""
    rate = config.folds.false_alarm_rate
    peers = influence_peers(config.folds.calibration, rate)
    return peers | physical_peers(measurement, setup_of(config), rate)


def _require_names(config: Config, conditions: Conditions) -> None:
    """Raise ConfigError where the calibration is not of these conditions, or not led by one without weights."""
    calibration = config.folds.calibration
    if not calibration:
        bare = [name for name, weights in zip(conditions.names, conditions.unbalance, strict=True) if not weights.any()]
        step = f"give it, such as folds.calibration=[{bare[0]}]" if bare else "measure the machine without weights, too"
        raise ConfigError(
            "folds.calibration must name the condition without weights, from which the response counts, and those that "
            f"calibrate alone, but names none: {step}"
        )
    for name in calibration:
        if name not in conditions.names:
            raise ConfigError(
                f"folds.calibration must name conditions of the data, but '{name}' is none: "
                f"{nearest(name, conditions.names)}"
            )
    if conditions.unbalance[conditions.names.index(calibration[0])].any():
        raise ConfigError(
            f"folds.calibration must begin with a condition without weights, but '{calibration[0]}' has one: name the "
            "machine as it was found first"
        )


# --- noise, floors and scores ----------------------------------------------------------------------


def _tell_noise(kept: Conditions, model: Influence) -> dict[str, Any]:
    """Deviations of both levels in um (a row a speed, a column a channel), laws of the weights, and the evidence.

    That of conditions is without weights; with them its square grows.
    """
    noise, shape = model.noise, kept.displacement.shape[1:]
    return {
        "condition_um": (1e6 * np.sqrt(np.diag(noise.condition).real.reshape(shape) / 2)).tolist(),
        "record_um": (1e6 * np.sqrt(np.einsum("spp->sp", noise.record).real / 2)).tolist(),
        "tail": noise.tail,
        "law_per_g_mm": [model.law.real * _GRAM_MM, model.law.imag * _GRAM_MM],
        "law_chance": model.law_chance,
        "growth_per_g_mm_squared": model.growth * _GRAM_MM**2,
        "growth_chance": model.growth_chance,
        "drift_chance": judge_drift(kept, model),
    }


def _floors(config: Config, kept: Conditions, model: Influence, baseline: np.ndarray) -> dict[str, Any]:
    """What drift alone leaves: of a model that is exactly right, and of influence coefficients of the calibration."""
    rng, spread = (
        np.random.default_rng(config.seed),
        [c for c, name in enumerate(kept.names) if name in config.folds.calibration],
    )
    columns = len(model.coefficients)
    residual = kept.vectors - model.predict(kept.unbalance)[0]
    residual = residual * np.sqrt(len(residual) / (len(residual) - columns))
    tested = kept.of([c for c in range(len(kept.names)) if c not in spread])
    floors = {"folds": floor_of_drift(kept, residual, tested, baseline, rng)}
    if len(spread) == columns:
        floors["calibration_alone"] = floor_of_drift(kept, residual, tested, baseline, rng, kept.of(spread))
    return floors


def _scores(judged: Sequence[Judged], named: Sequence[str]) -> dict[str, Any]:
    """By task, method, and whether all conditions are scored or those that contradict nothing; or a refusal."""
    scores: dict[str, Any] = {}
    for judged_fold in judged:
        methods = (
            {"refusal": judged_fold.refusal}
            if judged_fold.refusal
            else {"all": _in_gram(score(judged_fold)), "consistent": _in_gram(score(judged_fold, named))}
        )
        scores.setdefault(judged_fold.task, {})[judged_fold.method] = methods
    return scores


def _in_gram(scores: dict[str, dict[str, float]]) -> dict[str, dict[str, float]]:
    inverse = dict(scores["inverse"])
    return {**scores, "inverse": {"magnitude_error_g_mm": inverse.pop("magnitude_error") / _GRAM_MM, **inverse}}


def list_rows(tasks: dict[str, Any]) -> list[dict[str, Any]]:
    """A row a task, method and choice of conditions that has scores."""
    return [
        {"task": task, "method": method, "conditions": chosen}
        | {f"{way}_{key}": value for way in ("forward", "inverse") for key, value in scores[chosen][way].items()}
        for task, methods in tasks.items()
        for method, scores in methods.items()
        if "refusal" not in scores
        for chosen in ("all", "consistent")
    ]


_SHOWN = {
    "forward_median_relative_error": "relative error",
    "forward_r2": "R2",
    "forward_coverage": "in 95 %",
    "inverse_magnitude_error_g_mm": "weights, g mm",
    "inverse_angle_error_deg": "deg",
    "inverse_r2": "R2",
    "inverse_coverage": "in 95 %",
}


def _print(config: Config, rows: Sequence[dict[str, Any]]) -> None:
    """A table a choice of conditions."""
    for chosen in ("all", "consistent"):
        title = f"{config.name}: predicted vibration and read weights, {chosen} conditions"
        lines = [
            [row["task"], row["method"], *(f"{row[key]:.3g}" if key in row else "-" for key in _SHOWN)]
            for row in rows
            if row["conditions"] == chosen
        ]
        table(title, ["task", "method", *_SHOWN.values()], lines)
