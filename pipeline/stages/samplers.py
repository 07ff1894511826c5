"""Samplers at equal budget: several studies of each, on the same problem and without pruning."""

from __future__ import annotations

import itertools
from pathlib import Path

import numpy as np

from pipeline.config.schema import Config
from pipeline.data.tables import write_table
from pipeline.files import write_json
from pipeline.reporting.console import say, table
from pipeline.reporting.study_files import draw_samplers
from pipeline.stages.analysis import Analysis
from pipeline.stages.execution import StageOutput
from pipeline.stages.measurement import prepare
from pipeline.stages.studies import pose_study, say_interrupt, search
from pipeline.tuning.finalists import TrialSummary, replace_sampler, summarize
from pipeline.tuning.worker import ROUNDING


def run(analysis: Analysis) -> StageOutput:
    """``samplers.csv``, ``samplers.json`` and a figure in ``studies/NAME/``: the best loss after each trial."""
    config, problem = analysis.config, pose_study(analysis.config, prepare(analysis))
    folder, spec = Path(config.tuning.folder), config.tuning.comparison
    best: dict[str, list[np.ndarray]] = {sampler: [] for sampler in spec.samplers}
    seconds: dict[str, float] = dict.fromkeys(spec.samplers, 0.0)
    with say_interrupt(f"{config.name}: comparison"):
        for seed, sampler in itertools.product(spec.seeds, spec.samplers):
            study = search(replace_sampler(problem, sampler, seed), f"{config.name}: {sampler}, seed {seed}")
            trials = summarize(study)
            best[sampler].append(track_best(trials))
            seconds[sampler] += sum(t.seconds or 0.0 for t in trials)
    curves = {sampler: np.array(runs) for sampler, runs in best.items()}
    summary = {
        sampler: {
            "median_best_loss": float(np.median(runs[:, -1])),
            "best_losses": runs[:, -1].tolist(),
            "training_seconds": round(seconds[sampler], 1),
        }
        for sampler, runs in curves.items()
    }
    _print(config, {sampler: runs[:, -1] for sampler, runs in curves.items()})
    rows = [
        {"sampler": sampler, "seed": seed, "trial": trial, "best_held_out_loss": loss}
        for sampler, runs in curves.items()
        for seed, run in zip(spec.seeds, runs, strict=True)
        for trial, loss in enumerate(run, start=1)
    ]
    written = [
        write_table(folder / "samplers.csv", rows),
        draw_samplers(folder / "figures" / "samplers.png", curves),
        write_json(folder / "samplers.json", summary),
    ]
    return StageOutput(summary, {"data_fingerprint": problem.measurement.dataset.fingerprint}, written)


def track_best(trials: list[TrialSummary]) -> np.ndarray:
    """(trials,) lowest held-out loss of the complete trials up to each; the default, trial 0, is left out.

    Every study has the same default, which would hide what the sampler found by itself. Losses that are rounding
    count as equal.
    """
    losses = [t.loss if t.state == "complete" and t.loss is not None else np.inf for t in trials[1:]]
    return np.minimum.accumulate(np.maximum(losses, ROUNDING))


def _print(config: Config, best: dict[str, np.ndarray]) -> None:
    """``best`` has the losses (seeds,) that each sampler's studies ended with."""
    medians = {sampler: float(np.median(losses)) for sampler, losses in best.items()}
    rows = [[name, f"{medians[name]:.3g}", *(f"{loss:.3g}" for loss in losses)] for name, losses in best.items()]
    seeds = [f"seed {seed}" for seed in config.tuning.comparison.seeds]
    title = f"{config.name}: best held-out loss of {config.tuning.n_trials} trials, the configured default left out"
    table(title, ["sampler", "median", *seeds], rows)
    first, *others = best
    for other in others:
        mine, its = medians[first], medians[other]
        verdict = "beats" if mine < its else "ends level with" if mine == its else "does not beat"
        say(f"{first} {verdict} {other} in the median of {len(seeds)} studies")
