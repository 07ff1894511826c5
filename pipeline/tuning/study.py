"""A study and what it was made from: one that fits goes on, one that does not is refused; and what it minimises.

A fit is judged by how badly it predicts the speeds that it did not see, whatever its loss is: the residual's losses by
the residual over the bearing force, the output error by the readings' deviations over their noise, which come down to
1 where nothing but the stated noise is left.
"""

from __future__ import annotations

import hashlib
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from pipeline.config.schema import Config
from pipeline.errors import ConfigError, without_password
from pipeline.files import hash_json
from pipeline.identification.fit import loss_of
from pipeline.identification.identified import IdentifiedModel
from pipeline.identification.training import FitSetup, Outcome, minimise, phases
from pipeline.problem.identifiability import require_identifiable
from pipeline.problem.measurement import Measurement
from pipeline.tuning.space import find_default, make_pruner, make_sampler
from pipeline.tuning.storage import open_storage

if TYPE_CHECKING:
    import optuna
    import torch

OBJECTIVE = "log10 of the held-out loss"
INPUTS = "made_from"


@dataclass(frozen=True, eq=False)
class StudyProblem:
    """What a study searches on: the same in every worker."""

    config: Config
    measurement: Measurement

    def fingerprints(self) -> dict[str, dict[str, str]]:
        """Parts and the fingerprints of their pieces; a study of other ones is another study."""
        config, tuning = self.config, self.config.tuning
        sections = ("identify", "model", "loss", "optimizer", "training")
        return {
            "the search space": {name: _hash(d.model_dump(mode="json")) for name, d in tuning.space.items()}
            | {"its order": _hash(list(tuning.space))},
            "the data": {
                "vibration, excitation and rotor": self.measurement.dataset.fingerprint,
                "known coefficients": _hash(self.measurement.known.values.tobytes().hex()),
                "equations": _hash(np.round(self._sizes(), 12).tolist()),
            },
            "the configuration": {name: _hash(getattr(config, name).model_dump(mode="json")) for name in sections}
            | {"seed": str(config.seed)},
            "the sampler": {name: str(getattr(tuning, name)) for name in ("sampler", "sampler_seed", "startup_trials")}
            | {"pruner": tuning.pruner},
            "the program": _hash_program(),
        }

    def _sizes(self) -> np.ndarray:
        """The rotor, in one number a bearing, or a block of runs where the sensors may be anywhere."""
        if loss_of(self.config.loss).weighs_noise:
            sizes = [np.abs(block.forced_sensors).mean() for block in self.measurement.response.blocks]
            return np.log(np.array(sizes))
        force = np.abs(self.measurement.equations.free_residual)
        return np.asarray(np.log(force.mean(axis=tuple(range(1, force.ndim)))))


_hash = partial(hash_json, length=12)


@cache
def _hash_program() -> dict[str, str]:
    """Fingerprints of the sources that a trial's loss depends on, and Optuna's version."""
    import optuna

    package = Path(__file__).parents[1]
    sources = {
        folder: b"".join(path.read_bytes() for path in sorted((package / folder).glob("*.py")))
        for folder in ("problem", "identification")
    }
    hashes = {f"pipeline/{folder}": hashlib.sha256(text).hexdigest()[:12] for folder, text in sources.items()}
    return {"optuna": optuna.__version__} | hashes


def open_study(problem: StudyProblem) -> optuna.Study:
    """The configured study, made where there is none.

    :raises StorageError: where its storage can't be used
    :raises ConfigError: where the space lacks the default, or a study of this name was made from something else
    """
    import optuna

    config = problem.config.tuning
    default = find_default(problem.config)
    optuna.logging.set_verbosity(optuna.logging.ERROR)
    storage = open_storage(config)
    for restart in (config.changed == "restart", False):
        study = optuna.create_study(
            study_name=config.study,
            direction="minimize",
            load_if_exists=True,
            storage=storage,
            sampler=make_sampler(config, default),
            pruner=make_pruner(config),
        )
        if INPUTS not in study.user_attrs:
            _describe(study, problem)
            study.set_user_attr(INPUTS, problem.fingerprints())
        changes = _list_changes(study.user_attrs[INPUTS], problem.fingerprints())
        if not changes:
            return study
        if restart:
            optuna.delete_study(study_name=config.study, storage=storage)
    raise ConfigError(
        f"the study '{config.study}' in '{without_password(config.storage)}' must have been made from the same inputs, "
        f"but it was not: {changes}. Begin another with tuning.study=NAME, or delete this one and begin again with "
        "tuning.changed=restart"
    )


def _list_changes(then: Mapping[str, Mapping[str, str]], now: Mapping[str, Mapping[str, str]]) -> str:
    """The parts that differ, with their pieces; empty where none does."""
    sentences = []
    for key in dict.fromkeys([*now, *then]):
        before, after = then.get(key, {}), now.get(key, {})
        pieces = [name for name in dict.fromkeys([*before, *after]) if before.get(name) != after.get(name)]
        if pieces:
            sentences.append(f"{key} changed ({', '.join(pieces)})")
    return "; ".join(sentences)


def _describe(study: optuna.Study, problem: StudyProblem) -> None:
    """What the dashboard shows beside the trials."""
    from optuna_dashboard import save_note

    config = problem.config
    lines = [
        f"**Question:** which hyperparameters identify {', '.join(config.identify.named())} of `{config.name}` best?",
        f"({config.description})",
        "",
        f"**Objective:** {OBJECTIVE}: {describe_objective(config)}, at the speeds that training did not see (every "
        f"{config.training.holdout_every}th). No modelled coefficient is used.",
        "**Trial 0** is the configured default. Intermediate values are the same loss at percents of the last phase's "
        "epochs; a trial worse than the median there is pruned. A trial that diverges is failed, with its reason.",
        f"**User attributes:** training_seconds, epochs, outcome, held_out_loss. **Sampler:** {config.tuning.sampler}.",
        "",
        f"**Go on:** `python -m pipeline stage=tune {config.chosen} tuning.n_trials=N`, N being the total.",
    ]
    with warnings.catch_warnings(action="ignore"):  # experimental, in Optuna's words
        study.set_metric_names([OBJECTIVE])
        save_note(study, "\n".join(lines))


# --- what it minimises --------------------------------------------------------------------------------

Step = Callable[[str, int, int, "Callable[[], float] | None"], None]
"""(phase, step, its steps, held-out loss of the best state so far or None where none is known on the way)."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Judged:
    """A training and its held-out loss."""

    loss: float
    outcome: Outcome
    steps: int
    seconds: float
    training_loss: float
    model: IdentifiedModel


def judge(measurement: Measurement, setup: FitSetup, step: Step) -> Judged:
    """Train, and judge by the held-out speeds; ``step`` is called at every step of it.

    Raises ConfigError, DataError and IdentifiabilityError as :func:`pipeline.identification.fit.fit`.
    """
    from pipeline.identification.residual_loss import initial_parameters, prepare_residual

    loss = loss_of(setup.loss)
    if loss.weighs_noise:
        fitted = loss.fit(measurement, setup, lambda phase, number, total, _: step(phase, number, total, None))
        return Judged(
            loss=float(np.sqrt(fitted.quality.summary["fit"]["held_out_speeds"]["mean_square_over_noise"])),
            outcome=fitted.outcome,
            steps=fitted.steps,
            seconds=fitted.seconds,
            training_loss=fitted.loss,
            model=fitted.model,
        )
    training, last = prepare_residual(measurement, setup), phases(setup.optimizer)[-1]

    def watch(_: torch.Tensor, best: torch.Tensor, phase: str, number: int, total: int) -> None:
        # Phases before the last have curves of another shape.
        known = (lambda: float(training.per_speed_held_out_loss(best)[0])) if phase == last else None
        step(phase, number, total, known)

    start = initial_parameters(training, setup, setup.seed)
    minimum = minimise(training.problem, start, setup, held_out=training.held_out, watch=watch)
    return Judged(
        loss=float(training.per_speed_held_out_loss(minimum.parameters)[0]),
        outcome=minimum.outcomes[0],
        steps=minimum.steps,
        seconds=minimum.seconds,
        training_loss=float(minimum.loss[0]),
        model=training.identified(minimum.parameters[0]),
    )


def require_study(measurement: Measurement, setup: FitSetup) -> None:
    """Raise IdentifiabilityError where the data do not determine the unknowns: that needs no study."""
    if not setup.force:
        require_identifiable(loss_of(setup.loss).diagnose(measurement, setup).reports)


def describe_objective(config: Config) -> str:
    """What the loss on held-out speeds is, for a reader."""
    if loss_of(config.loss).weighs_noise:
        return "what the readings deviate by from the predicted ones, over their noise, root mean square (1 is noise)"
    return "the residual of the equation of motion divided by the bearing force of its speed, root mean square"
