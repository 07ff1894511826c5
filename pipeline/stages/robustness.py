"""Many trainings at once, from initial guesses (paper, Figure 2) or from seeds."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.config.schema import Config
from pipeline.data.tables import write_table
from pipeline.errors import ConfigError
from pipeline.evaluation.repeats import summarize_starts, tabulate_starts
from pipeline.files import write_json
from pipeline.identification.residual_loss import ResidualTraining, initial_parameters, prepare_residual
from pipeline.identification.training import FitSetup, Minimum, Outcome, minimise, setup_of
from pipeline.reporting.console import say, table, training_progress
from pipeline.reporting.training_figures import draw_robustness
from pipeline.stages.analysis import Analysis
from pipeline.stages.diagnose import say_diagnosis
from pipeline.stages.execution import StageOutput, use_threads
from pipeline.stages.measurement import load_modelled, prepare
from pipeline.stages.train import say_promoted
from pipeline.twin.twin import measure_unseen

if TYPE_CHECKING:
    import torch


def choose_starts(config: Config) -> np.ndarray:
    """(G,) initial stiffnesses in N/m, log-spaced, or seeds."""
    spec = config.robustness
    if spec.over == "seed":
        return np.array(spec.seeds)
    return np.geomspace(spec.lowest_stiffness, spec.highest_stiffness, spec.count)


def run(analysis: Analysis) -> StageOutput:
    """``robustness.json``, a table with the final error of every start, and Figure 2."""
    config = analysis.config
    if config.robustness.over == "refit":
        from pipeline.stages import refit_study

        return refit_study.run(analysis)
    measurement, setup = prepare(analysis), setup_of(config)
    use_threads(config)
    say_promoted(config)
    if config.robustness.over == "initial_guess" and not any(name.startswith("k") for name in config.identify.named()):
        raise ConfigError(
            "robustness over initial guesses must have an unknown stiffness, but identify.unknowns has none: use "
            "robustness=seeds"
        )
    training = prepare_residual(measurement, setup)
    say_diagnosis(analysis)
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
    work = analysis.files
    answers = [training.identified(parameter).table(measurement.known) for parameter in minimum.parameters]
    names = measurement.unknowns.by_bearing
    rows = tabulate_starts(config.robustness.over, starts, minimum, answers, modelled, names)
    summary = summarize_starts(minimum, rows)
    error = measure_unseen(config.machine, measurement, answers, modelled)
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
