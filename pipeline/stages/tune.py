"""Search hyperparameters by the loss on held-out speeds, and promote the best into training."""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path
from typing import Any

from pipeline.config.schema import Config
from pipeline.errors import without_password
from pipeline.files import read_json
from pipeline.identification.fit import loss_of
from pipeline.identification.residual_loss import fit_chebyshev
from pipeline.identification.training import setup_of
from pipeline.reporting.console import count_progress, say
from pipeline.reporting.study_files import AGAIN, STUDY_FILES, SUMMARY, write_study
from pipeline.reporting.study_report import StudyReport, summarize_study
from pipeline.stages.analysis import Analysis
from pipeline.stages.before_fit import say_diagnosis
from pipeline.stages.execution import StageOutput
from pipeline.stages.measurement import load_modelled, prepare
from pipeline.stages.studies import pose_study, record_on_the_way, record_trial, say_interrupt, search
from pipeline.tuning.finalists import choose, hash_study, measure_importances, summarize, train_finalists
from pipeline.tuning.storage import close_storage, is_shared, open_storage
from pipeline.tuning.study import StudyProblem, require_study


def run(analysis: Analysis) -> StageOutput:
    """The study, then its best trials and the default over several seeds; ``studies/NAME/`` with what came of it."""
    config = analysis.config
    from filelock import FileLock

    if is_shared(config.tuning):
        # One that can't be reached is said at once, before the data are read.
        close_storage(open_storage(config.tuning))
    problem, folder = pose_study(config, prepare(analysis)), Path(config.tuning.folder)
    require_study(problem.measurement, setup_of(config))
    say_diagnosis(analysis)
    started = time.perf_counter()
    with say_interrupt(f"{config.name}: study"):
        study = search(problem, config.name, record_on_the_way(config))
        searched = time.perf_counter() - started
        folder.mkdir(parents=True, exist_ok=True)
        with FileLock(folder / ".lock"):  # of several processes that end a study together, one makes the report
            return _report(config, problem, study, searched)


def _report(config: Config, problem: StudyProblem, study: Any, searched: float) -> StageOutput:
    """The finalists, the choice, and the files of ``studies/NAME/``; nothing where they are up to date."""
    folder, trials, mark = Path(config.tuning.folder), summarize(study), hash_study(study, problem)
    before = read_json(folder / SUMMARY, AGAIN) if all((folder / name).exists() for name in STUDY_FILES) else {}
    if before.get("study_fingerprint") == mark:
        say(f"{config.name}: the study has its {len(trials)} trials, and '{folder}' is what came of them")
        return StageOutput(before)
    most = (config.tuning.finalists + 1) * len(config.tuning.seeds)
    with count_progress(config.name, most) as show:
        finalists, setup = train_finalists(study, problem, show), setup_of(config)
    judge = replace(setup, loss=setup.loss.model_copy(update={"scaling": "per_speed"}))  # trials are compared by it
    report = StudyReport(
        config=config,
        trials=trials,
        finalists=finalists,
        best=choose(finalists, config.tuning),
        chebyshev=None if loss_of(config.loss).weighs_noise else fit_chebyshev(problem.measurement, judge),
        importances=measure_importances(study),
        known=problem.measurement.known,
        modelled=load_modelled(config, problem.measurement),  # read when the choice is made
    )
    summary = summarize_study(report) | {"study_fingerprint": mark}
    written = write_study(folder, study, report, summary)
    say(
        f"{config.name}: {len(trials)} trials in {searched:.0f} s; {summary['verdict']}\n"
        f"report in '{folder / 'README.md'}'; look at the trials with: "
        f"optuna-dashboard {without_password(config.tuning.storage)}\n"
        f"training uses it after: python -m pipeline stage=promote {config.chosen} tuning.study={config.tuning.study}"
    )
    return StageOutput(
        summary | {"search_seconds": searched},
        {"data_fingerprint": problem.measurement.dataset.fingerprint, "study": config.tuning.study},
        written,
        children=[record_trial(config.name, trial) for trial in trials],
    )
