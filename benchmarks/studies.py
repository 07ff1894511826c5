"""Hyperparameter studies: what they spend beside training, and what a second worker gains."""

from __future__ import annotations

import os
import time
from dataclasses import replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

from benchmarks.machines import machine
from benchmarks.measure import BENCHMARKS, Aim, Times, seconds

if TYPE_CHECKING:
    from pipeline.tuning.finalists import TrialSummary

_EXPERIMENT = "experiment=hydrostatic_stiffness"


@BENCHMARKS.add(
    "study_overhead",
    "sampling, storage and tracking of a study of 24 trials",
    "the whole study",
    Aim(0.05),
)
def study_overhead() -> Times:
    """What is not training, as a share."""
    from pipeline.config.schema import TrackingConfig
    from pipeline.stages.tune import record_trial
    from pipeline.tracking import StageRecord, track

    overhead, whole = [], []
    for _ in range(3):
        with TemporaryDirectory() as folder:
            trials, wall = _studied(Path(folder), "tuning.n_trials=24")
            settings = TrackingConfig(enabled=True, uri=f"sqlite:///{folder}/mlflow.db", timeout_seconds=30.0)
            children = [record_trial("x", trial) for trial in trials]
            record = StageRecord(
                experiment="x", stage="tune", started=time.time() - 1, ended=time.time(), children=children
            )
            track(replace(record, children=()), settings)  # makes the database
            tracking = seconds(partial(track, record, settings))
        overhead.append(wall - sum(trial.seconds or 0.0 for trial in trials) + tracking)
        whole.append(wall + tracking)
    return Times(overhead, whole)


@BENCHMARKS.add(
    "two_workers",
    "a study of 20 trials by two workers, random search without pruning",
    "the same trials by one worker",
    Aim(1.7, "at least"),
)
def two_workers() -> Times:
    """Not of fewer trials: at the end one worker waits for the last trial of the other."""
    _require_a_free_core()
    one, two = [], []
    for _ in range(3):
        with TemporaryDirectory() as folder:
            alike = ("tuning.sampler=random", "tuning.pruner=none", "tuning.n_trials=20")
            two.append(_studied(Path(folder) / "two", "tuning.workers=2", *alike)[1])
            one.append(_studied(Path(folder) / "one", *alike)[1])
    return Times(two, one)


def _require_a_free_core() -> None:
    """Raises RuntimeError where a second worker could gain nothing."""
    cores, load = os.cpu_count() or 1, os.getloadavg()[0]
    if load > cores - 0.5:  # this process alone makes a load of 1
        raise RuntimeError(f"it needs a free core, but the load of the {cores} cores is {load:.1f}: run it again later")


def _studied(folder: Path, *overrides: str) -> tuple[list[TrialSummary], float]:
    """The trials of a study, and its time in seconds."""
    from pipeline.config.compose import compose_config
    from pipeline.tuning.finalists import summarize
    from pipeline.tuning.study import StudyProblem
    from pipeline.tuning.worker import run_study

    made = machine(_EXPERIMENT)
    config = compose_config(["stage=tune", f"tuning.storage=sqlite:///{folder}/optuna.db", *overrides])
    problem = StudyProblem(config, made.measurement)
    start = time.perf_counter()
    study, _ = run_study(problem, lambda _: None)
    wall = time.perf_counter() - start
    return summarize(study), wall
