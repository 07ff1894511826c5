"""The schema of the fit: loss, optimiser and training."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated, Literal

from pydantic import Field, PositiveFloat, PositiveInt

from pipeline.config.operating import Conditions
from pipeline.config.quantities import RotorSpeed, Stiffness
from pipeline.config.section import NonNegativeInt, Section, Share, ascending, rule


class LossConfig(Section):
    """What training minimises.

    ``residual``: the residual of the equation of motion (paper, eq. 6), per speed divided by its size or not.
    ``preconditioned``: the same, multiplied at each speed by the regularised pseudo-inverse of its derivative by
    the unknowns; ``regularisation`` is relative to the largest singular value.
    ``response``: predicted less measured displacements over the sensors' noise, which is as ``stated_noise`` says or of
    that shape and ``estimated`` size; ``robust`` gives readings far off less weight. It keeps the hidden layers of a
    network as ``drawn`` (random features), or has them ``trained`` in so many ``networks``, whose mean is the answer.
    ``beyond_trend`` is the prior standard deviation of a coefficient from a power law and a straight line over the
    speed, of the model's output: its logarithm, or its share of the coefficient's size.
    """

    kind: Literal["residual", "preconditioned", "response"]
    scaling: Literal["per_speed", "none"]
    regularisation: Share
    noise: Literal["stated", "estimated"] = "stated"
    robust: bool = True
    beyond_trend: PositiveFloat = 0.3
    hidden: Literal["drawn", "trained"] = "drawn"
    networks: Annotated[int, Field(ge=4, le=200, multiple_of=2)] = 8

    @rule
    def _trains_hidden(self) -> Iterator[str]:
        if self.hidden == "trained" and self.kind != "response":
            yield f"hidden: trained must come with kind: response (others train all layers), got {self.kind}"

    @property
    def preconditioned(self) -> bool:
        """True where the residual is multiplied by the pseudo-inverse of its derivative."""
        return self.kind == "preconditioned"


class _PhaseConfig(Section):
    """Ends after ``steps``, or when the loss fell by less than ``training.tolerance`` in ``patience`` steps."""

    steps: NonNegativeInt
    patience: PositiveInt


class AdamConfig(_PhaseConfig):
    """Adam with the learning rate falling to ``final_rate_fraction`` of itself along a cosine."""

    learning_rate: PositiveFloat
    final_rate_fraction: Annotated[float, Field(gt=0, le=1)]


class LBFGSConfig(_PhaseConfig):
    """L-BFGS with a strong Wolfe line search."""

    history: PositiveInt


class LevenbergMarquardtConfig(_PhaseConfig):
    """Damped Gauss-Newton steps, each member of a batch with its own damping."""

    initial_damping: PositiveFloat


class OptimizerConfig(Section):
    """Phases run in this order; a phase of 0 steps is left out."""

    adam: AdamConfig
    lbfgs: LBFGSConfig
    levenberg_marquardt: LevenbergMarquardtConfig

    @rule
    def _some_steps(self) -> Iterator[str]:
        if self.adam.steps + self.lbfgs.steps + self.levenberg_marquardt.steps == 0:
            yield "must have a phase with steps > 0, but adam, lbfgs and levenberg_marquardt all have 0"


class TrainingConfig(Section):
    """Stopping and model selection, on held-out speeds."""

    holdout_every: NonNegativeInt
    holdout_runs: tuple[str, ...] = ()
    holdout_range: tuple[RotorSpeed, RotorSpeed] | None = None  # rad/s, speeds that are predicted, not fitted
    holdout_operating: Conditions = Field(default_factory=dict)  # SI, conditions that are predicted, not fitted
    tolerance: Share
    device: Literal["cpu", "cuda"] = "cpu"  # what is trained at once by a loss without a start of its own

    @rule
    def _leaves_training_speeds(self) -> Iterator[str]:
        if self.holdout_every == 1:
            yield "must have holdout_every = 0 (none) or at least 2, but got 1, which leaves no speed to train on"
        if self.holdout_range and self.holdout_range[0] > self.holdout_range[1]:
            low, high = self.holdout_range
            yield f"must have holdout_range = [from, to] with from <= to, but got {low:g} and {high:g} rad/s"


class RobustnessConfig(Section):
    """What is varied: initial guesses (log-spaced, for every unknown stiffness), seeds, the noise of modelled data, or
    (``refit``) all that differs from one measurement of the modelled machine to the next.
    """

    over: Literal["initial_guess", "seed", "refit"]
    lowest_stiffness: Stiffness
    highest_stiffness: Stiffness
    count: Annotated[int, Field(ge=2, le=1000)]
    seeds: tuple[NonNegativeInt, ...] = Field(min_length=1)
    workers: PositiveInt = 1  # processes of refits

    _span = ascending("lowest_stiffness", "highest_stiffness", strictly=True)
