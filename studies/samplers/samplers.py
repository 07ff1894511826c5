"""Samplers at equal budget: several studies of each, on the same problem and without pruning.

    python studies/samplers/samplers.py experiment=NAME [--samplers tpe random] [--seeds 0 1 2 3 4]

``samplers.csv``, ``samplers.json`` and ``figures/samplers.png`` go to the folder of the experiment's study.
"""

from __future__ import annotations

import itertools
import sys
from argparse import ArgumentParser, RawDescriptionHelpFormatter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from pipeline.config.compose import compose_config
from pipeline.config.schema import Config
from pipeline.data.tables import write_table
from pipeline.errors import exit_code
from pipeline.files import write_json
from pipeline.reporting.blocks import BLUE, GREEN, ORANGE, Axes, Curve, Panel, shade
from pipeline.reporting.console import say, table
from pipeline.reporting.matplotlib_figures import write_panel
from pipeline.reporting.study_files import HELD_OUT
from pipeline.stages.analysis import Analysis, record, say_interrupt
from pipeline.stages.measurement import load_measurement
from pipeline.stages.tune import pose_study, search
from pipeline.tracking import StageRecord, recorder_beside
from pipeline.tuning.finalists import TrialSummary, summarize
from pipeline.tuning.study import StudyProblem
from pipeline.tuning.worker import ROUNDING


def main(arguments: Sequence[str]) -> int:
    """Run the command line; the exit code is that of the pipeline's own commands."""
    parser = ArgumentParser(
        prog="python studies/samplers/samplers.py", description=__doc__, formatter_class=RawDescriptionHelpFormatter
    )
    parser.add_argument("overrides", nargs="*", help="as of python -m pipeline stage=tune, such as tuning.n_trials=30")
    parser.add_argument("--samplers", nargs="+", choices=("tpe", "random", "gp"), default=["tpe", "random"])
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2, 3, 4])
    asked = parser.parse_intermixed_args(arguments)

    def compare() -> None:
        config = compose_config([*asked.overrides, "stage=tune"]).model_copy(update={"stage": "samplers"})
        with recorder_beside(config.tracking.enabled):
            record(Analysis(config), lambda analysis: run(analysis.config, asked.samplers, asked.seeds))

    return exit_code(compare)


def run(config: Config, samplers: Sequence[str], seeds: Sequence[int]) -> StageRecord:
    """``samplers.csv``, ``samplers.json`` and a figure in the folder of the study: the best loss after each trial."""
    problem, folder = pose_study(config, load_measurement(config)), Path(config.tuning.folder)
    best: dict[str, list[np.ndarray]] = {sampler: [] for sampler in samplers}
    seconds: dict[str, float] = dict.fromkeys(samplers, 0.0)
    with say_interrupt(f"{config.name}: comparison"):
        for seed, sampler in itertools.product(seeds, samplers):
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
    _print(config, seeds, {sampler: runs[:, -1] for sampler, runs in curves.items()})
    rows = [
        {"sampler": sampler, "seed": seed, "trial": trial, "best_held_out_loss": loss}
        for sampler, runs in curves.items()
        for seed, run in zip(seeds, runs, strict=True)
        for trial, loss in enumerate(run, start=1)
    ]
    written = [
        write_table(folder / "samplers.csv", rows),
        draw_samplers(folder / "figures" / "samplers.png", curves),
        write_json(folder / "samplers.json", summary),
    ]
    return StageRecord(summary, {"data_fingerprint": problem.measurement.dataset.fingerprint}, written)


def track_best(trials: list[TrialSummary]) -> np.ndarray:
    """(trials,) lowest held-out loss of the complete trials up to each; the default, trial 0, is left out.

    Every study has the same default, which would hide what the sampler found by itself. Losses that are rounding
    count as equal.
    """
    losses = [t.loss if t.state == "complete" and t.loss is not None else np.inf for t in trials[1:]]
    return np.minimum.accumulate(np.maximum(losses, ROUNDING))


def _print(config: Config, seeds: Sequence[int], best: dict[str, np.ndarray]) -> None:
    """``best`` has the losses (seeds,) that each sampler's studies ended with."""
    medians = {sampler: float(np.median(losses)) for sampler, losses in best.items()}
    rows = [[name, f"{medians[name]:.3g}", *(f"{loss:.3g}" for loss in losses)] for name, losses in best.items()]
    title = f"{config.name}: best held-out loss of {config.tuning.n_trials} trials, the configured default left out"
    table(title, ["sampler", "median", *(f"seed {seed}" for seed in seeds)], rows)
    first, *others = best
    for other in others:
        mine, its = medians[first], medians[other]
        verdict = "beats" if mine < its else "ends level with" if mine == its else "does not beat"
        say(f"{first} {verdict} {other} in the median of {len(seeds)} studies")


def replace_sampler(problem: StudyProblem, sampler: str, seed: int) -> StudyProblem:
    """The same problem as a study of its own with another sampler."""
    tuning = problem.config.tuning.model_copy(
        update={
            "sampler": sampler,
            "sampler_seed": seed,
            "study": f"{problem.config.tuning.study} · {sampler} {seed}",
            "pruner": "none",  # what is pruned depends on the trials before, which differ
        }
    )
    return replace(problem, config=problem.config.model_copy(update={"tuning": tuning}))


def draw_samplers(path: Path, best: Mapping[str, np.ndarray]) -> Path:
    """Best loss so far over the trials: the median of a sampler's studies, and their range."""
    curves = []
    for (name, losses), colour in zip(best.items(), (BLUE, ORANGE, GREEN), strict=False):
        trials, low, high = 1 + np.arange(losses.shape[1]), losses.min(axis=0), losses.max(axis=0)
        curves += [
            shade(trials, low, high, colour),
            Curve(trials, np.median(losses, axis=0), name, colour, width=2.4),
        ]
    return write_panel(path, Panel("", "trial", [Axes(curves, f"best {HELD_OUT}", scale="log")], wide=True))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
