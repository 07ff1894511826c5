"""What the stages of a study share: the problem that is posed, its progress, its interrupt and its records."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from pipeline.config.schema import Config
from pipeline.errors import ConfigError
from pipeline.identification.fit import loss_of
from pipeline.problem.measurement import Measurement
from pipeline.reporting.console import count_progress, warn
from pipeline.tracking import RUNNING, StageRecord, hand_over
from pipeline.tuning.finalists import TrialSummary, summarize
from pipeline.tuning.storage import list_results
from pipeline.tuning.study import StudyProblem
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


@contextmanager
def say_interrupt(what: str) -> Iterator[None]:
    """Ctrl-C in the block ends the command with 130, and a sentence says that ``what`` goes on where it was."""
    try:
        yield
    except KeyboardInterrupt:
        warn(f"{what} interrupted; no finished trial is lost, and the same command goes on")
        raise SystemExit(130) from None


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
            parameters={},
            tags={"study": config.tuning.study},
            metrics={},
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
