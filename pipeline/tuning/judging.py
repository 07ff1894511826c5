"""What a study minimises: how badly a fit predicts the speeds that it did not see, whatever its loss is.

The residual's losses are judged by the residual over the bearing force, the output error by the readings' deviations
over their noise, which come down to 1 where nothing but the stated noise is left.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from pipeline.identification.fit import loss_of
from pipeline.identification.identified import IdentifiedModel
from pipeline.identification.training import FitSetup, Outcome, minimise, phases
from pipeline.problem.identifiability import require_identifiable
from pipeline.problem.measurement import Measurement

if TYPE_CHECKING:
    import torch

    from pipeline.config.schema import Config

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

    def watch(phase: str, number: int, total: int, best: torch.Tensor) -> None:
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
