"""Many trainings at once, from initial guesses (paper, Figure 2) or from seeds."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.config.schema import Config
from pipeline.data.tables import write_table
from pipeline.errors import ConfigError, PipelineError
from pipeline.evaluation.errors import CoefficientErrors, measure_errors
from pipeline.files import write_json
from pipeline.identification.residual_loss import ResidualTraining, initial_parameters, prepare_residual
from pipeline.identification.training import FitSetup, Minimum, Outcome, minimise, setup_of
from pipeline.problem.measurement import Measurement
from pipeline.reporting.console import say, table, training_progress
from pipeline.reporting.figures import draw_robustness
from pipeline.rotor.bearing_table import BearingTable
from pipeline.stages.diagnose import say_diagnosis
from pipeline.stages.execution import StageOutput, use_threads
from pipeline.stages.measurement import load_measurement, load_modelled
from pipeline.stages.predict import find_same_run, list_unseen
from pipeline.stages.train import say_promoted
from pipeline.stages.workspace import locate_files
from pipeline.twin.prediction import predict

if TYPE_CHECKING:
    import pandas as pd
    import torch


def choose_starts(config: Config) -> np.ndarray:
    """(G,) initial stiffnesses in N/m, log-spaced, or seeds."""
    spec = config.robustness
    if spec.over == "seed":
        return np.array(spec.seeds)
    return np.geomspace(spec.lowest_stiffness, spec.highest_stiffness, spec.count)


def run(config: Config) -> StageOutput:
    """``robustness.json``, a table with the final error of every start, and Figure 2."""
    if config.robustness.over == "refit":
        from pipeline.stages import refit_study

        return refit_study.run(config)
    measurement, setup = load_measurement(config), setup_of(config)
    use_threads(config)
    say_promoted(config)
    if config.robustness.over == "initial_guess" and not any(name.startswith("k") for name in config.identify.named()):
        raise ConfigError(
            "robustness over initial guesses must have an unknown stiffness, but identify.unknowns has none: use "
            "robustness=seeds"
        )
    training = prepare_residual(measurement, setup)
    say_diagnosis(config, measurement)
    starts = choose_starts(config)
    with training_progress(f"{config.name}: {len(starts)} at once") as progress:
        minimum = minimise(
            training.problem,
            _start(config, training, setup, starts),
            setup,
            held_out=training.held_out,
            progress=progress,
            record_trajectory=setup.constant,
        )
    modelled = load_modelled(config, measurement)  # read when training is over
    work = locate_files(config)
    answers = [training.identified(parameter).table(measurement.known) for parameter in minimum.parameters]
    rows = _tabulate(config, minimum, answers, starts, modelled, measurement)
    summary = _summarize(minimum, rows)
    error = None if modelled is None else _measure_displacement(config, measurement, answers, modelled)
    if error is not None:
        summary["displacement"] = {"worst_mean_error_percent": error}
    _print(config, summary, minimum)
    written = [
        write_json(work.folder / "robustness.json", summary),
        write_table(work.folder / "robustness.csv", rows),
        draw_robustness(work.figure("robustness"), training, minimum, config.robustness.over, rows, modelled),
    ]
    exit_code = 130 if Outcome.INTERRUPTED in minimum.outcomes else 0
    return StageOutput(
        summary | {"seconds": minimum.seconds},
        {"data_fingerprint": measurement.dataset.fingerprint},
        written,
        exit_code=exit_code,
    )


def _start(config: Config, training: ResidualTraining, setup: FitSetup, starts: np.ndarray) -> torch.Tensor:
    """(G, M, Q) where each training starts: from a seed, or from a guess of the stiffness."""
    import torch  # when the data have been found sound

    if config.robustness.over == "seed":
        return torch.cat([initial_parameters(training, setup, int(seed)) for seed in starts])
    return torch.cat([initial_parameters(training, setup, config.seed, float(guess)) for guess in starts])


def _tabulate(
    config: Config,
    minimum: Minimum,
    answers: list[BearingTable],
    starts: np.ndarray,
    modelled: BearingTable | None,
    measurement: Measurement,
) -> pd.DataFrame:
    """One row a start, bearing and coefficient; the error is NaN where there is no truth."""
    import pandas as pd

    rows, names = [], measurement.unknowns.by_bearing
    for g, (start, answer) in enumerate(zip(starts, answers, strict=True)):
        errors = None if modelled is None else measure_errors(answer, modelled, names)
        for b, node in enumerate(answer.nodes):
            for name in names[b]:
                rows.append(
                    {
                        config.robustness.over: start,
                        "bearing_node": node,
                        "coefficient": name,
                        "mean_value": float(answer.coefficient(name)[b].mean()),
                        "mean_error_percent": _get_error(errors, node, name, "mean"),
                        "median_error_percent": _get_error(errors, node, name, "median"),
                        "p95_error_percent": _get_error(errors, node, name, "p95"),
                        "loss": float(minimum.loss[g]),
                        "outcome": minimum.outcomes[g].label,
                    }
                )
    return pd.DataFrame(rows)


def _get_error(errors: CoefficientErrors | None, node: int, name: str, kind: str) -> float:
    error = None if errors is None else errors[node].get(name)
    return float("nan") if error is None else float(getattr(error, f"{kind}_error_percent"))


def _summarize(minimum: Minimum, rows: pd.DataFrame) -> dict[str, Any]:
    labels = [outcome.label for outcome in minimum.outcomes]
    coefficients: dict[str, dict[str, dict[str, float]]] = {}
    for (node, name), group in rows.groupby(["bearing_node", "coefficient"], sort=False):
        errors = group["mean_error_percent"]
        if errors.notna().all():
            values = {
                "worst_mean_error_percent": float(errors.max()),
                "median_mean_error_percent": float(errors.median()),
                "worst_median_error_percent": float(group["median_error_percent"].max()),
                "worst_p95_error_percent": float(group["p95_error_percent"].max()),
            }
            coefficients.setdefault(str(node), {})[str(name)] = values
    return {
        "starts": len(labels),
        "outcomes": {label: labels.count(label) for label in sorted(set(labels))},
        "worst_loss": float(minimum.loss.max()),
        "coefficients": coefficients,
    }


def _measure_displacement(
    config: Config, measurement: Measurement, answers: list[BearingTable], modelled: BearingTable
) -> float | None:
    """Error of the vibration never seen, percent: the mean over speed, of the worst start and direction.

    None where this rotor lacks the prediction's nodes, a run has the very unbalance, or a start has no finite answer.
    """
    unseen, node, rotor = list_unseen(config), config.machine.prediction.node, measurement.rotor
    if max(node, *(force.node for force in unseen)) >= rotor.n_nodes or find_same_run(
        unseen, measurement.dataset.excitations
    ):
        return None
    worst = 0.0
    try:
        true = predict(rotor, modelled, unseen, node)
        for answer in answers:
            if not np.isfinite(answer.values).all():
                return None
            error = predict(rotor, answer, unseen, node).error_percent(true).mean(axis=0).max()
            worst = max(worst, float(error))
    except PipelineError:  # a diverged start may have a singular machine
        return None
    return worst if np.isfinite(worst) else None


def _print(config: Config, summary: Mapping[str, Any], minimum: Minimum) -> None:
    outcomes = ", ".join(f"{count} {label.replace('_', ' ')}" for label, count in summary["outcomes"].items())
    varied = {"seed": "seeds", "initial_guess": "initial guesses"}[config.robustness.over]
    say(f"{config.name}: {summary['starts']} {varied} trained at once in {minimum.seconds:.1f} s ({outcomes})")
    rows = [
        [
            f"node {node} {name}",
            f"{values['worst_mean_error_percent']:.2g}",
            f"{values['median_mean_error_percent']:.2g}",
        ]
        for node, entry in summary["coefficients"].items()
        for name, values in entry.items()
    ]
    if rows:
        table(
            f"{config.name}: mean error % over all {varied}",
            ["bearing and coefficient", "worst", "median"],
            rows,
        )
