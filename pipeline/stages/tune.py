"""Search hyperparameters by the loss on held-out speeds, and promote the best into training."""

from __future__ import annotations

import math
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

from pipeline.config.promotion import BEST, PromotedTrial
from pipeline.config.schema import Config
from pipeline.config.tuning import HeldOutLoss
from pipeline.errors import ConfigError, without_password
from pipeline.files import read_json, write_json, write_text
from pipeline.identification.fit import loss_of
from pipeline.identification.residual_loss import fit_chebyshev
from pipeline.identification.training import setup_of
from pipeline.problem.measurement import Measurement
from pipeline.reporting.console import StudyProgress, say, study_progress, warn
from pipeline.reporting.study_figures import draw_study
from pipeline.reporting.study_report import (
    StudyReport,
    summarize_study,
    tabulate_finalists,
    tabulate_trials,
    write_report,
)
from pipeline.stages.analysis import Analysis
from pipeline.stages.diagnose import say_diagnosis
from pipeline.stages.execution import StageOutput
from pipeline.stages.measurement import load_modelled, prepare
from pipeline.tracking import StageRecord
from pipeline.tuning.attempts import list_results
from pipeline.tuning.finalists import TrialSummary, choose, hash_study, measure_importances, summarize, train_finalists
from pipeline.tuning.judging import require_study
from pipeline.tuning.storage import close_storage, is_shared, open_storage
from pipeline.tuning.study import StudyProblem
from pipeline.tuning.trials_file import TRIALS, format_trials
from pipeline.tuning.worker import Seen, run_study

SUMMARY = "summary.json"
AGAIN = "run stage=tune again after moving it away"


def pose_study(config: Config, measurement: Measurement) -> StudyProblem:
    """Return the problem that a study of ``config`` searches on.

    Raises ConfigError where no speed is held out, or the noise is estimated from the deviations to be judged.
    """
    if not config.training.holdout_every and not config.training.holdout_operating:
        raise ConfigError(
            "a study must judge its trials on held-out speeds, but training.holdout_every is 0: give it 10, or another "
            "number from 2"
        )
    if config.loss.noise == "estimated" and loss_of(config.loss).weighs_noise:
        raise ConfigError(
            "a study by the output error must judge its trials by one noise, but loss.noise is estimated, which each "
            "trial does by what it leaves over: state it in stated_noise, and give loss.noise=stated"
        )
    return StudyProblem(config, measurement)


def run(analysis: Analysis) -> StageOutput:
    """The study, then its best trials and the default over several seeds; ``studies/NAME/`` with what came of it."""
    config = analysis.config
    from filelock import FileLock

    if is_shared(config.tuning):
        # One that can't be reached is said at once, before the data are read.
        close_storage(open_storage(config.tuning))
    measurement = prepare(analysis)
    problem, folder = pose_study(config, measurement), Path(config.tuning.folder)
    require_study(measurement, setup_of(config))
    say_diagnosis(analysis)
    started = time.perf_counter()
    try:
        with study_progress(config.name, config.tuning.n_trials) as shown:
            study, sentences = run_study(problem, follow_progress(shown, config.tuning.n_trials))
        searched = time.perf_counter() - started
        for sentence in sentences:
            warn(f"{config.name}: {sentence}")
        folder.mkdir(parents=True, exist_ok=True)
        with FileLock(folder / ".lock"):  # of several processes that end a study together, one makes the report
            return _report(config, problem, study, searched)
    except KeyboardInterrupt:
        warn(f"{config.name}: study interrupted; no finished trial is lost, and the same command goes on")
        raise SystemExit(130) from None


def _report(config: Config, problem: StudyProblem, study: Any, searched: float) -> StageOutput:
    """The finalists, the choice, and the files of ``studies/NAME/``; nothing where they are up to date."""
    folder, trials, mark = Path(config.tuning.folder), summarize(study), hash_study(study, problem)
    files = (BEST, SUMMARY, "README.md", TRIALS, "trials.csv", "finalists.csv")
    before = read_json(folder / SUMMARY, AGAIN) if all((folder / name).exists() for name in files) else {}
    if before.get("study_fingerprint") == mark:
        say(f"{config.name}: the study has its {len(trials)} trials, and '{folder}' is what came of them")
        return StageOutput(before)
    finalists = train_finalists(study, problem)
    setup = setup_of(config)
    by_residual = not loss_of(config.loss).weighs_noise
    judge = replace(setup, loss=setup.loss.model_copy(update={"scaling": "per_speed"}))  # trials are compared by it
    report = StudyReport(
        config=config,
        trials=trials,
        finalists=finalists,
        best=choose(finalists, config.tuning),
        chebyshev=fit_chebyshev(problem.measurement, judge) if by_residual else None,
        importances=measure_importances(study),
        known=problem.measurement.known,
        modelled=load_modelled(config, problem.measurement),  # read when the choice is made
    )
    summary = summarize_study(report) | {"study_fingerprint": mark}
    written = _write(config, study, report, summary, folder)
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


def follow_progress(shown: StudyProgress, total: int) -> Seen:
    """Return what a worker calls between its steps to show how far the study is; it asks the database once a second."""
    due = 0.0

    def seen(study: Any) -> None:
        nonlocal due
        if time.monotonic() < due:
            return
        due = time.monotonic() + 1.0
        finished = list_results(study).values()
        losses = [10**trial.value for trial in finished if trial.state.name == "COMPLETE" and trial.value is not None]
        shown(min(len(finished), total), min(losses, default=None))

    return seen


def _write(config: Config, study: Any, report: StudyReport, summary: dict[str, object], folder: Path) -> list[Path]:
    import yaml

    from pipeline.data.tables import write_table

    medians = {"configured": report.default.median, "promoted": report.best.median}
    values = PromotedTrial(
        study=config.tuning.study,
        trial=report.best.trial,
        values=dict(report.best.values),
        held_out_loss=HeldOutLoss(
            **{name: median if math.isfinite(median) else None for name, median in medians.items()}
        ),
    )
    head = (
        f"# Found by: python -m pipeline stage=tune {config.chosen}\n"
        "# Training uses these values; one given on the command line wins, and tuned=false leaves them all out.\n"
    )
    return [
        write_table(folder / "trials.csv", tabulate_trials(report)),
        write_table(folder / "finalists.csv", tabulate_finalists(report)),
        *draw_study(folder / "figures", report.trials, config.tuning.space, report.importances, report.finalists),
        write_text(folder / TRIALS, format_trials(study)),
        write_text(folder / "README.md", write_report(report)),
        write_text(folder / BEST, head + yaml.safe_dump(values.model_dump(mode="json"), sort_keys=False)),
        write_json(folder / SUMMARY, summary),
    ]


def record_trial(experiment: str, trial: TrialSummary) -> StageRecord:
    """A trial as a run below the study's."""
    metrics = {"held_out_loss": trial.loss, "training_seconds": trial.seconds, "epochs": trial.epochs}
    return StageRecord(
        experiment=experiment,
        stage=f"trial {trial.number}",
        parameters=dict(trial.parameters),
        tags={"outcome": trial.outcome or trial.state, "state": trial.state}
        | ({"reason": trial.reason} if trial.reason else {}),
        metrics={name: float(value) for name, value in metrics.items() if value is not None},
        # Not by the metric's name, or its final value would be a point of the curve, at step 0.
        history=[{"step": percent, "learning_curve": loss} for percent, loss in trial.curve.items()],
        started=trial.started,
        ended=trial.ended,
        status="FAILED" if trial.state == "failed" else "FINISHED",
    )
