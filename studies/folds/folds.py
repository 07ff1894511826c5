"""Methods that predict vibration from weights, on conditions that they have not seen; what contradicts its label.

    python studies/folds/folds.py experiment=rk4 --calibration BASE A007 A015 --heavy "36 g mm"

It trains influence coefficients, the physical model and their blend on parts of the conditions of an experiment and
asks them for the rest; first it names the conditions whose vibration contradicts their labels. ``folds.json``,
``folds.csv`` (a row a task, method and choice of conditions) and ``figures/folds.png`` go to the experiment's folder.
"""

from __future__ import annotations

import sys
from argparse import ArgumentParser, ArgumentTypeError, Namespace, RawDescriptionHelpFormatter
from collections.abc import Sequence
from typing import Any

import numpy as np
from contradictions import describe_contradiction, explain, tell_contradiction
from folds_figure import draw_folds
from judge import Judged, judge, score
from peers import Peer, influence_peers
from physical_peers import physical_peers
from scores import floor_of_drift
from splits import list_splits

from pipeline.balance.fitted import find_contradictions
from pipeline.balance.influence import Influence, design_of, judges
from pipeline.config.compose import compose_config
from pipeline.config.quantities import UnbalanceMagnitude
from pipeline.config.schema import Config
from pipeline.data.conditions import Conditions, gather_conditions
from pipeline.data.tables import write_table
from pipeline.errors import ConfigError, exit_code, nearest
from pipeline.files import write_json
from pipeline.identification.training import setup_of
from pipeline.problem.measurement import Measurement
from pipeline.problem.noise_levels import solve_weighted
from pipeline.reporting.console import say, table
from pipeline.stages.analysis import Analysis, record, use_threads
from pipeline.stages.measurement import load_dataset, load_measurement
from pipeline.tracking import StageRecord, recorder_beside

_GRAM_MM = 1e-6
"""kg m."""


def main(arguments: Sequence[str]) -> int:
    """Run the command line; the exit code is that of the pipeline's own commands."""
    asked = parse(arguments)
    return exit_code(lambda: _record(asked))


def parse(arguments: Sequence[str]) -> Namespace:
    """``overrides``, ``calibration``, ``heavy`` (kg m, or None), ``count`` and ``rate``; exits where they are wrong."""
    parser = ArgumentParser(
        prog="python studies/folds/folds.py", description=__doc__, formatter_class=RawDescriptionHelpFormatter
    )
    parser.add_argument("overrides", nargs="*", help="as of python -m pipeline, such as experiment=rk4 output=FOLDER")
    parser.add_argument(
        "--calibration",
        nargs="+",
        default=[],
        metavar="NAME",
        help="conditions that calibrate alone and are never scored, the one without weights first",
    )
    parser.add_argument(
        "--heavy", type=_parse_heavy, help="sum of weights from which on conditions are predicted by lighter ones"
    )
    parser.add_argument("--count", type=int, default=5, help="folds by condition (5)")
    parser.add_argument(
        "--rate", type=float, default=0.01, help="chance to name a condition where none contradicts its label (0.01)"
    )
    asked = parser.parse_args(arguments)
    if asked.count < 2 or not 0 < asked.rate < 0.5:
        parser.error("needs a count of 2 or more, and a rate between 0 and 0.5")
    return asked


def _parse_heavy(text: str) -> float:
    """kg m."""
    from pydantic import TypeAdapter, ValidationError

    try:
        return TypeAdapter(UnbalanceMagnitude).validate_python(text)
    except ValidationError as error:
        raise ArgumentTypeError(error.errors()[0]["msg"]) from None


def _record(asked: Namespace) -> None:
    config = compose_config(asked.overrides).model_copy(update={"stage": "folds"})
    use_threads(config)
    with recorder_beside(config.tracking.enabled):
        record(
            Analysis(config),
            lambda analysis: run(analysis.config, asked.calibration, asked.heavy, asked.count, asked.rate),
        )


def run(
    config: Config, calibration: Sequence[str], heavy: float | None = None, count: int = 5, rate: float = 0.01
) -> StageRecord:
    """``folds.json``, ``folds.csv`` (a row a task, method and choice of conditions) and a figure.

    ``calibration`` names the conditions that calibrate alone and are never scored, the one without weights first.
    ``heavy`` (kg m) is the sum of weights from which on conditions are predicted by lighter ones; None leaves that out.
    ``rate`` is the chance to name a condition where none contradicts its label. Raises ConfigError where the
    calibration is not of these conditions, or not led by one without weights.
    """
    work, dataset = Analysis(config), load_dataset(config)
    planes = tuple(config.identify.unbalance_planes) or None
    conditions = gather_conditions(dataset, planes)
    _require_names(calibration, conditions)
    named, model = find_contradictions(conditions, rate)
    kept = conditions.without(named)
    contradictions = [
        explain(conditions.of([conditions.names.index(name)]), model, chance) for name, chance in named.items()
    ]
    for contradiction in contradictions:
        say(f"{config.name}: {describe_contradiction(config, conditions, contradiction)}")
    splits = list_splits(conditions, tuple(calibration), count, heavy, config.seed)
    baseline = conditions.displacement[conditions.names.index(calibration[0])]
    peers = list_peers(config, load_measurement(config), tuple(calibration), rate)
    judged = []
    for task in judge(dataset, conditions.planes, splits, peers, baseline):
        judged.append(task)
        say(f"{config.name}: {task.task}, {task.method}: {task.refusal or 'done'}")
    summary: dict[str, Any] = {
        "contradictions": [tell_contradiction(config, conditions, odd) for odd in contradictions],
        "noise": _tell_noise(kept, model),
        "floor": _floors(kept, model, baseline, calibration, config.seed),
        "tasks": _scores(judged, list(named)),
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
    return StageRecord(summary, {"data_fingerprint": dataset.fingerprint}, written)


def list_peers(config: Config, measurement: Measurement, calibration: tuple[str, ...], rate: float) -> dict[str, Peer]:
    """The methods that are tried."""
    return influence_peers(calibration, rate) | physical_peers(measurement, setup_of(config), rate)


def _require_names(calibration: Sequence[str], conditions: Conditions) -> None:
    """Raise ConfigError where the calibration is not of these conditions, or not led by one without weights."""
    if not calibration:
        bare = [name for name, weights in zip(conditions.names, conditions.unbalance, strict=True) if not weights.any()]
        step = f"give it, such as --calibration {bare[0]}" if bare else "measure the machine without weights, too"
        raise ConfigError(
            "--calibration must name the condition without weights, from which the response counts, and those that "
            f"calibrate alone, but names none: {step}"
        )
    for name in calibration:
        if name not in conditions.names:
            raise ConfigError(
                f"--calibration must name conditions of the data, but '{name}' is none: "
                f"{nearest(name, conditions.names)}"
            )
    if conditions.unbalance[conditions.names.index(calibration[0])].any():
        raise ConfigError(
            f"--calibration must begin with a condition without weights, but '{calibration[0]}' has one: name the "
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


def judge_drift(conditions: Conditions, model: Influence) -> float | None:
    """Chance that conditions without a steady drift in their order would show the slope that these show.

    Hotelling's T^2 of a slope of the baseline over the order, for circular complex data (Giri 1965). None where the
    noise has too few degrees of freedom to judge by.
    """
    from scipy import stats

    if not judges(model):
        return None
    design = design_of(conditions.unbalance, model.law)
    order = np.linspace(-0.5, 0.5, len(design))[:, None] + 0j
    order = order - design @ solve_weighted(order, design, model.weights)
    power = float((model.weights * abs(order[:, 0]) ** 2).sum())
    residual = conditions.vectors - design @ model.coefficients
    slope = (order[:, 0].conj() * model.weights) @ residual / power
    level = model.noise.covariance(np.array([np.mean(conditions.counts)]))[0]
    squared = power * float((slope.conj() @ np.linalg.solve(level, slope)).real)
    size = len(level)
    left = model.noise.freedom - size + 1
    return float(stats.f.sf(squared * left / (model.noise.freedom * size), 2 * size, 2 * left))


def _floors(
    kept: Conditions, model: Influence, baseline: np.ndarray, calibration: Sequence[str], seed: int
) -> dict[str, Any]:
    """What drift alone leaves: of a model that is exactly right, and of influence coefficients of the calibration."""
    rng = np.random.default_rng(seed)
    spread = [c for c, name in enumerate(kept.names) if name in calibration]
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


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
