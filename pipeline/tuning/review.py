"""What a study found: its trials, the finalists over several seeds, and which of them is promoted."""

from __future__ import annotations

import hashlib
import json
import math
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.config.promotion import with_values
from pipeline.config.tuning import TuningConfig, Value
from pipeline.identification.identified import IdentifiedModel
from pipeline.identification.outcome import Outcome
from pipeline.identification.residual_loss import ResidualTraining, initial_parameters, prepare_residual
from pipeline.identification.training import FitSetup, Minimum, minimise, setup_of
from pipeline.tuning.parallel import pool
from pipeline.tuning.space import values_of
from pipeline.tuning.study import StudyProblem

if TYPE_CHECKING:
    import optuna


@dataclass(frozen=True)
class TrialAccount:
    """A trial, as the tables and figures have it. Losses are held-out losses, not their logarithms."""

    number: int
    state: str  # complete, pruned, failed, ...
    loss: float | None
    seconds: float | None
    epochs: int | None
    outcome: str
    reason: str
    parameters: Mapping[str, Value]
    curve: Mapping[int, float]  # percent of the last phase -> loss
    started: float | None  # seconds since 1970
    ended: float | None


@dataclass(frozen=True, eq=False)
class Finalist:
    """A trial's values, trained with every seed. ``losses`` (G,) are per-speed held-out losses."""

    trial: int
    values: Mapping[str, Value]
    losses: np.ndarray
    training: ResidualTraining
    minimum: Minimum  # of all seeds

    def identified(self, g: int) -> IdentifiedModel:
        """The model of seed g."""
        return self.training.identified(self.minimum.parameters[g])

    @property
    def median(self) -> float:
        """The median loss; infinite where most seeds diverged."""
        return float(np.median(np.where(np.isfinite(self.losses), self.losses, math.inf)))


def accounts(study: optuna.Study) -> list[TrialAccount]:
    """The study's finished trials by number: workers that asked for the last one at once leave more in the queue."""
    return [_account(trial) for trial in study.get_trials(deepcopy=False) if trial.state.is_finished()]


def _account(trial: optuna.trial.FrozenTrial) -> TrialAccount:
    attributes = trial.user_attrs
    loss = None if trial.value is None or not trial.state.is_finished() else 10**trial.value
    return TrialAccount(
        trial.number,
        {"FAIL": "failed"}.get(trial.state.name, trial.state.name.lower()),
        attributes.get("held_out_loss", loss),
        attributes.get("training_seconds"),
        attributes.get("epochs"),
        attributes.get("outcome", ""),
        attributes.get("reason", ""),
        dict(trial.params),
        {step: 10**value for step, value in sorted(trial.intermediate_values.items())},
        trial.datetime_start.timestamp() if trial.datetime_start else None,
        trial.datetime_complete.timestamp() if trial.datetime_complete else None,
    )


def finalists(study: optuna.Study, problem: StudyProblem) -> tuple[Finalist, list[Finalist]]:
    """The default, and the best other trials, each trained with every seed of ``tuning.seeds``."""
    config = problem.config.tuning
    best = sorted(
        (t for t in study.get_trials(deepcopy=False) if t.state.name == "COMPLETE" and t.number),
        key=lambda t: (t.value, t.number),
    )
    chosen: list[tuple[int, dict[str, Value]]] = [(0, {})]
    for trial in best:
        values = values_of(config.space, trial.params)
        if len(chosen) <= config.finalists and values not in [other for _, other in chosen]:
            chosen.append((trial.number, values))
    trained = _trained(problem, chosen)
    return trained[0], trained[1:]


def _trained(problem: StudyProblem, chosen: Sequence[tuple[int, Mapping[str, Value]]]) -> list[Finalist]:
    """Each of the ``chosen`` trained with every seed, in as many processes as the study had workers.

    One training at a time, as in ``stage=train``: a batch would go on until its slowest seed is done.
    """
    seeds = problem.config.tuning.seeds
    each = [(problem, number, values, seed) for number, values in chosen for seed in seeds]
    with pool(min(problem.config.tuning.workers, len(each)), problem.config.threads) as run_all:
        answers = list(run_all(_train_seed, each))
    return [
        _finalist(problem, number, values, answers[i * len(seeds) : (i + 1) * len(seeds)])
        for i, (number, values) in enumerate(chosen)
    ]


@dataclass(frozen=True, eq=False)
class _Answer:
    """What comes back from another process: torch's tensors don't outlive theirs."""

    parameters: np.ndarray  # (1, M, P)
    outcomes: tuple[Outcome, ...]
    loss: np.ndarray
    held_out_loss: np.ndarray | None
    steps: int
    seconds: float


def _train_seed(given: tuple[StudyProblem, int, Mapping[str, Value], int]) -> _Answer:
    problem, number, values, seed = given
    setup = _setup(problem, number, values)
    training = prepare_residual(problem.measurement, setup)
    start = initial_parameters(training, setup, seed)
    found = minimise(training.problem, start, setup, held_out=training.held_out)
    if Outcome.INTERRUPTED in found.outcomes:
        raise KeyboardInterrupt
    state = found.parameters.numpy()
    return _Answer(state, found.outcomes, found.loss, found.held_out_loss, found.steps, found.seconds)


def _finalist(problem: StudyProblem, number: int, values: Mapping[str, Value], answers: Sequence[_Answer]) -> Finalist:
    import torch

    training = prepare_residual(problem.measurement, _setup(problem, number, values))
    held_out = [answer.held_out_loss for answer in answers if answer.held_out_loss is not None]
    found = Minimum(
        parameters=torch.from_numpy(np.concatenate([answer.parameters for answer in answers])),
        outcomes=tuple(outcome for answer in answers for outcome in answer.outcomes),
        loss=np.concatenate([answer.loss for answer in answers]),
        held_out_loss=np.concatenate(held_out) if held_out else None,
        steps=max(answer.steps for answer in answers),
        seconds=sum(answer.seconds for answer in answers),
        history=(),
        trajectory=(),
    )
    return Finalist(number, dict(values), training.per_speed_held_out_loss(found.parameters), training, found)


def _setup(problem: StudyProblem, number: int, values: Mapping[str, Value]) -> FitSetup:
    return setup_of(with_values(problem.config, values, f"trial {number}"))


def promoted(default: Finalist, others: Sequence[Finalist], config: TuningConfig, rounding: float) -> Finalist:
    """The finalist with the lowest median loss, or the default.

    A finalist must be better by ``least_gain``, more than the sampler's path and the processor's kernels give, and by
    more than the luck of seeds: its median below the default's luckiest seed.
    """
    best = min(others, key=lambda f: max(f.median, rounding), default=default)  # of equals the better trial
    gained = max(default.median, rounding) >= config.least_gain * max(best.median, rounding)
    luckiest = np.nanmin(default.losses) if np.isfinite(default.median) else np.inf
    return best if gained and best.median < luckiest else default


def importances(study: optuna.Study) -> dict[str, float]:
    """Share of each parameter in what sets the best trials apart, largest first (Optuna's PED-ANOVA).

    Empty where there are too few trials to tell.
    """
    from optuna.importance import get_param_importances

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            found: dict[str, Any] = get_param_importances(study)
    except (RuntimeError, ValueError):
        return {}
    return {name: float(value) for name, value in found.items()}


def sampler_study(problem: StudyProblem, sampler: str, seed: int) -> StudyProblem:
    """The same problem as a study of its own with another sampler."""
    tuning = problem.config.tuning.model_copy(
        update={
            "sampler": sampler,
            "sampler_seed": seed,
            "study": f"{problem.config.tuning.study} · {sampler} {seed}",
            "pruner": "none",  # what is pruned depends on the trials before, which differ
        }
    )
    config = problem.config.model_copy(update={"tuning": tuning})
    return StudyProblem(config, problem.measurement)


def fingerprint(study: optuna.Study, problem: StudyProblem) -> str:
    """Identity of everything that a report is made from: the trials, and how finalists are chosen."""
    tuning = problem.config.tuning
    trials = [(t.number, t.state.name, t.value, sorted(t.params.items())) for t in study.get_trials(deepcopy=False)]
    choice = (tuning.finalists, tuning.seeds, tuning.least_gain, tuning.n_trials, tuning.study)
    text = json.dumps([problem.made_from(), trials, choice], sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:16]
