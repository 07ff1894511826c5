"""Search hyperparameters by the loss on held-out speeds, and promote the best into training."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

from pipeline.config.schema import Config
from pipeline.errors import ConfigError, without_password
from pipeline.files import read_json
from pipeline.identification.fit import loss_of
from pipeline.identification.residual_loss import fit_chebyshev
from pipeline.identification.training import setup_of
from pipeline.problem.measurement import Measurement
from pipeline.reporting.console import count_progress, say, warn
from pipeline.reporting.study_files import AGAIN, STUDY_FILES, SUMMARY, write_study
from pipeline.reporting.study_report import StudyReport, summarize_study
from pipeline.stages.analysis import Analysis, say_interrupt
from pipeline.stages.before_fit import say_diagnosis
from pipeline.stages.measurement import load_modelled, prepare
from pipeline.tracking import RUNNING, StageRecord, hand_over
from pipeline.tuning.finalists import TrialSummary, choose, hash_study, measure_importances, summarize, train_finalists
from pipeline.tuning.storage import close_storage, is_shared, list_results, open_storage
from pipeline.tuning.study import StudyProblem, require_study
from pipeline.tuning.worker import run_study
from pipeline.write_numbers import write_number


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


def search(problem: StudyProblem, title: str, seen: Callable[[Any], None] = lambda study: None) -> Any:
    """The study with all its trials, and on screen how far it is: the database is asked once a second, and the study
    is ``seen`` then."""
    total, due = problem.config.tuning.n_trials, 0.0

    def show(study: Any) -> None:
        """Bring the bar up to date."""
        nonlocal due
        if time.monotonic() < due:
            return
        due = time.monotonic() + 1.0
        finished = list_results(study).values()
        losses = [10**trial.value for trial in finished if trial.state.name == "COMPLETE" and trial.value is not None]
        best = write_number(min(losses, default=None))
        shown(min(len(finished), total), f"trials, best held-out loss {best}")
        seen(study)

    with count_progress(title, total) as shown:
        study, sentences = run_study(problem, show)
    for sentence in sentences:
        warn(f"{problem.config.name}: {sentence}")
    return study


def record_on_the_way(config: Config) -> Callable[[Any], None]:
    """A function of a study that hands over what has ended since this was called: its trials are in MLflow at once."""
    started, handed = time.time(), set[int]()

    def hand(study: Any) -> None:
        """The trials that ended since the last time."""
        trials = [trial for trial in summarize(study) if trial.ended >= started and trial.number not in handed]
        handed.update(trial.number for trial in trials)
        record = StageRecord(
            experiment=config.name,
            stage=config.stage,
            title=" ".join((config.stage, config.name, *config.overrides)),
            started=started,
            ended=time.time(),
            tags={"study": config.tuning.study},
            children=[record_trial(config.name, trial) for trial in trials],
            status=RUNNING,
        )
        if trials:
            hand_over(record, config.tracking)

    return hand


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


def run(analysis: Analysis) -> StageRecord:
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


def _report(config: Config, problem: StudyProblem, study: Any, searched: float) -> StageRecord:
    """The finalists, the choice, and the files of ``studies/NAME/``; nothing where they are up to date."""
    folder, trials, mark = Path(config.tuning.folder), summarize(study), hash_study(study, problem)
    before = read_json(folder / SUMMARY, AGAIN) if all((folder / name).exists() for name in STUDY_FILES) else {}
    if before.get("study_fingerprint") == mark:
        say(f"{config.name}: the study has its {len(trials)} trials, and '{folder}' is what came of them")
        return StageRecord(before)
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
    return StageRecord(
        summary | {"search_seconds": searched},
        {"data_fingerprint": problem.measurement.dataset.fingerprint, "study": config.tuning.study},
        written,
        children=[record_trial(config.name, trial) for trial in trials],
    )
