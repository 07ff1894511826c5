"""Trials that were stopped: each is repeated with its parameters.

A trial whose worker died, was interrupted or met a bug is failed without a ``reason``, by Optuna's heartbeats or
by its worker. Its parameters go to the queue again, under a number of Optuna's own and with the attribute
``repeats``. Optuna's RetryHeartbeatStaleTrialCallback would do so for the first of the three alone, and hand on what
the dead worker had written on it. What a trial keeps is its *place*: its number among the trials that repeat none.
The sampler draws by the place, and reports count by it, so that a study that was stopped is told like one that was not.
"""

from __future__ import annotations

import warnings
from contextlib import suppress
from datetime import datetime, timedelta
from typing import TYPE_CHECKING

from pipeline.config.tuning import TuningConfig
from pipeline.tuning.storage import WORKER

if TYPE_CHECKING:
    import optuna
    from optuna.trial import FrozenTrial

REPEATS = "repeats"
REASON = "reason"
"""The attribute of a trial that failed by itself."""


def list_attempts(study: optuna.Study) -> list[FrozenTrial]:
    """The latest attempt at each place.

    Two workers may put one trial back to the queue at once: the first of its repeats counts, others have no place.
    """
    latest: dict[int, FrozenTrial] = {}  # number of the first attempt -> latest
    first: dict[int, int] = {}  # number of the latest attempt -> first
    for trial in study.get_trials(deepcopy=False):
        repeated = trial.user_attrs.get(REPEATS, trial.number)
        if repeated == trial.number or repeated in first:
            first[trial.number] = first.pop(repeated, repeated)
            latest[first[trial.number]] = trial
    return list(latest.values())


def list_results(study: optuna.Study) -> dict[int, FrozenTrial]:
    """Place -> finished trial; a trial that was stopped is not finished."""
    return {
        place: trial
        for place, trial in enumerate(list_attempts(study))
        if trial.state.is_finished() and not _was_stopped(trial)
    }


def repeat_stopped(study: optuna.Study, config: TuningConfig) -> list[FrozenTrial]:
    """The latest attempt at each place of the study's total, after those that stopped were put back to the queue."""
    from optuna.storages import fail_stale_trials

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # experimental, in Optuna's words
        fail_stale_trials(study)
    latest = list_attempts(study)[: config.n_trials]
    stopped = [trial for trial in latest if _was_stopped(trial) or _has_died_early(study, trial, config)]
    for trial in stopped:
        study.enqueue_trial(dict(trial.params), user_attrs={REPEATS: trial.number})
    return list_attempts(study)[: config.n_trials] if stopped else latest


def _was_stopped(trial: FrozenTrial) -> bool:
    return trial.state.name == "FAIL" and REASON not in trial.user_attrs


def _has_died_early(study: optuna.Study, trial: FrozenTrial, config: TuningConfig) -> bool:
    """Fail a trial that died before its first heartbeat, which Optuna doesn't notice; True if it was one."""
    from optuna.exceptions import UpdateFinishedTrialError
    from optuna.trial import TrialState

    silence = abs(datetime.now() - (trial.datetime_start or datetime.now()))
    told_or_young = WORKER in trial.user_attrs or silence < timedelta(seconds=config.silence_seconds)
    if trial.state != TrialState.RUNNING or told_or_young:
        return False
    with suppress(UpdateFinishedTrialError, ValueError):  # another worker did so
        study.tell(trial.number, state=TrialState.FAIL)
    return True
