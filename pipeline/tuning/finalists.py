"""What a study found: its trials, the finalists over several seeds, and which of them is promoted."""

from __future__ import annotations

import json
import math
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.config.promotion import apply_values
from pipeline.config.tuning import TuningConfig, Value
from pipeline.files import hash_json
from pipeline.identification.identified import IdentifiedModel
from pipeline.identification.training import Outcome, setup_of
from pipeline.processes import run_all
from pipeline.tuning.space import translate
from pipeline.tuning.storage import WORKER, list_results
from pipeline.tuning.study import Judged, StudyProblem, judge
from pipeline.tuning.worker import ROUNDING
from pipeline.write_numbers import write_number

if TYPE_CHECKING:
    import optuna
    from optuna.trial import FrozenTrial

TRIALS = "trials.jsonl"
"""A study as text that is kept beside its report: a line on the study, then a line for each finished trial."""


@dataclass(frozen=True, kw_only=True)
class TrialSummary:
    """A trial, as the tables and figures have it. Losses are held-out losses, not their logarithms."""

    number: int  # its place: a repeated trial keeps it
    state: str  # complete, pruned or failed
    loss: float | None = None
    seconds: float | None = None
    epochs: int | None = None
    outcome: str = ""
    reason: str = ""
    parameters: Mapping[str, Value]
    curve: Mapping[int, float]  # percent of the last phase -> loss
    started: float = 0.0  # seconds since 1970
    ended: float = 0.0


@dataclass(frozen=True, eq=False)
class Finalist:
    """A trial's values, trained with every seed. ``losses`` (G,) are per-speed held-out losses."""

    trial: int
    values: Mapping[str, Value]
    losses: np.ndarray
    models: Sequence[IdentifiedModel]  # of each seed, as are the outcomes
    outcomes: Sequence[Outcome]
    seconds: float  # of all seeds

    @property
    def median(self) -> float:
        """The median loss; infinite where most seeds diverged."""
        return float(np.median(np.nan_to_num(self.losses, nan=math.inf, posinf=math.inf)))

    @property
    def highest(self) -> float:
        """The loss of the unluckiest seed; infinite where one diverged."""
        return float(np.nan_to_num(self.losses, nan=math.inf, posinf=math.inf).max())


def summarize(study: optuna.Study) -> list[TrialSummary]:
    """The study's finished trials; a trial that was stopped is there by its repeat alone."""
    return [
        TrialSummary(
            number=place,
            state={"FAIL": "failed"}.get(trial.state.name, trial.state.name.lower()),
            loss=trial.user_attrs.get("held_out_loss", None if trial.value is None else 10**trial.value),
            seconds=trial.user_attrs.get("training_seconds"),
            epochs=trial.user_attrs.get("epochs"),
            outcome=trial.user_attrs.get("outcome", ""),
            reason=trial.user_attrs.get("reason", ""),
            parameters=dict(trial.params),
            curve={step: 10**value for step, value in sorted(trial.intermediate_values.items())},
            started=trial.datetime_start.timestamp() if trial.datetime_start else 0.0,
            ended=trial.datetime_complete.timestamp() if trial.datetime_complete else 0.0,
        )
        for place, trial in list_results(study).items()
    ]


def train_finalists(
    study: optuna.Study, problem: StudyProblem, show: Callable[[int, str], None] = lambda *_: None
) -> list[Finalist]:
    """The default, then the best other trials, each trained with every seed of ``tuning.seeds``; ``show`` is told how
    many trainings are done, and of what."""
    import torch

    config = problem.config.tuning
    results = list_results(study)
    complete = [(trial.value, place) for place, trial in results.items() if trial.state.name == "COMPLETE"]
    chosen: dict[int, dict[str, Value]] = {0: {}}
    for _, place in sorted(complete):
        values = translate(config.space, results[place].params)
        if place and len(chosen) <= config.finalists and values not in chosen.values():
            chosen[place] = values
    # One training at a time, as in `stage=train`: a batch would go on until its slowest seed is done.
    each = [(problem, place, values, seed) for place, values in chosen.items() for seed in config.seeds]
    trained: dict[int, Judged] = {}
    for i, run in run_all(_train_seed, each, config.workers, problem.config.threads, "tuning.workers=1"):
        trained[i], (_, place, _, seed) = run, each[i]
        show(len(trained), f"trainings of finalists, trial {place} with seed {seed}: loss {write_number(run.loss)}")
    batches = [[trained[i + s] for s in range(len(config.seeds))] for i in range(0, len(each), len(config.seeds))]
    return [
        Finalist(
            trial=place,
            values=values,
            losses=np.array([run.loss for run in runs]),
            models=[replace(run.model, parameters=torch.as_tensor(run.model.parameters)) for run in runs],
            outcomes=[run.outcome for run in runs],
            seconds=sum(run.seconds for run in runs),
        )
        for (place, values), runs in zip(chosen.items(), batches, strict=True)
    ]


def _train_seed(given: tuple[StudyProblem, int, Mapping[str, Value], int]) -> Judged:
    """A training whose model has an array of parameters: torch's tensors do not come back from another process."""
    problem, place, values, seed = given
    setup = replace(setup_of(apply_values(problem.config, values, f"trial {place}")), seed=seed)
    trained = judge(problem.measurement, setup, lambda *_: None)
    if trained.outcome is Outcome.INTERRUPTED:
        raise KeyboardInterrupt
    parameters: Any = trained.model.parameters.numpy()
    return replace(trained, model=replace(trained.model, parameters=parameters))


def choose(finalists: Sequence[Finalist], config: TuningConfig) -> Finalist:
    """The finalist whose unluckiest seed has the lowest loss, or the default, which is the first.

    Training has one seed: values that need a lucky one are no good. The median must be better by ``least_gain``, more
    than the sampler's path and the processor's kernels give, and every seed below the default's luckiest one.
    """
    default, *others = finalists
    best = min(others, key=lambda f: max(f.highest, ROUNDING), default=default)  # of equals the better trial
    gained = max(default.median, ROUNDING) >= config.least_gain * max(best.median, ROUNDING)
    luckiest = np.nanmin(default.losses) if np.isfinite(default.median) else np.inf
    return best if gained and best.highest < luckiest else default


def measure_importances(study: optuna.Study) -> dict[str, float]:
    """Share of each parameter in what sets the best trials apart, largest first (Optuna's PED-ANOVA).

    Empty where there are too few trials to tell.
    """
    from optuna.importance import get_param_importances

    try:
        with warnings.catch_warnings(action="ignore"):
            return {name: float(value) for name, value in get_param_importances(study).items()}
    except (RuntimeError, ValueError):
        return {}


def hash_study(study: optuna.Study, problem: StudyProblem) -> str:
    """Identity of everything that a report is made from: the trials, and how finalists are chosen."""
    tuning = problem.config.tuning
    trials = [(place, t.state.name, t.value, sorted(t.params.items())) for place, t in list_results(study).items()]
    choice = (tuning.finalists, tuning.seeds, tuning.least_gain, tuning.n_trials, tuning.study)
    return hash_json([problem.fingerprints(), trials, choice])


# --- as text -----------------------------------------------------------------------------------------


def format_trials(study: optuna.Study) -> str:
    """The study with its note and attributes, and every finished trial with all that the dashboard shows."""
    from optuna_dashboard import get_note

    with warnings.catch_warnings(action="ignore"):  # experimental, in Optuna's words
        note, metrics = get_note(study), study.metric_names
    lines = [
        {"study": study.study_name, "metrics": metrics, "note": note, "attributes": study.user_attrs},
        *(_describe(trial) for trial in study.get_trials(deepcopy=False) if trial.state.is_finished()),
    ]
    return "".join(json.dumps(line) + "\n" for line in lines)


def _describe(trial: FrozenTrial) -> dict[str, Any]:
    from optuna.distributions import distribution_to_json

    return {
        "state": trial.state.name,
        "value": trial.value,
        "parameters": trial.params,
        "ranges": {
            name: json.loads(distribution_to_json(distribution)) for name, distribution in trial.distributions.items()
        },
        "curve": {str(step): value for step, value in trial.intermediate_values.items()},
        "attributes": {name: value for name, value in trial.user_attrs.items() if name != WORKER},
        "started": trial.datetime_start and trial.datetime_start.isoformat(),
        "ended": trial.datetime_complete and trial.datetime_complete.isoformat(),
    }
