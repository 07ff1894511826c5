"""The schema of the comparison of methods. SI; noise as a share of the reading."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated, Literal

from pydantic import Field, PositiveInt

from pipeline.config.identification import LossConfig, OptimizerConfig, TrainingConfig
from pipeline.config.models import ModelConfig
from pipeline.config.quantities import Damping, Deviation, Stiffness
from pipeline.config.section import NonNegativeInt, Once, Section, Share, ascending, rule

MethodName = Literal[
    "least_squares",
    "least_squares_expanded",
    "smoothed",
    "tikhonov",
    "total_least_squares",
    "multi_frequency",
    "kalman",
    "kriging",
    "critical_speeds",
    "spline",
    "paper",
    "paper_scaling",
    "paper_logarithm",
    "paper_second_order",
    "residual",
    "preconditioned",
    "response",
    "trained",
    "law",
]
SensorSet = Literal["all", "bearings", "location"]
"""x and y at every node, at the bearings, or at one node."""


class PriorConfig(Section):
    """Between which bounds the direct coefficients are known to lie before anything is measured."""

    lowest_stiffness: Stiffness
    highest_stiffness: Stiffness
    lowest_damping: Damping
    highest_damping: Damping

    _stiffness = ascending("lowest_stiffness", "highest_stiffness", strictly=True)
    _damping = ascending("lowest_damping", "highest_damping", strictly=True)


class FitConfig(Section):
    """The training of a network in the comparison."""

    model: ModelConfig
    loss: LossConfig
    optimizer: OptimizerConfig
    training: TrainingConfig


class ComparisonConfig(Section):
    """The methods, and the cases that each is tried on.

    ``noise`` is the root mean square of each complex displacement's noise as a share of it; ``speeds`` how many of the
    experiment's speeds are measured; ``floor`` is noise that every reading of a noisy case has beside it. Every noise
    is tried with every sensor set at all speeds; fewer speeds with the sensors at the bearings (else the first set) and
    the largest noise. That case at all speeds has ``data_sets`` of other noise, the others with noise have
    ``other_data_sets``; a method named in ``most_data_sets`` has so many at most, because it is slow. ``location`` is
    the node of the sensor set of that name, null for the middle one.
    """

    methods: Annotated[tuple[MethodName, ...], Field(min_length=1), Once]
    noise: Annotated[tuple[Share, ...], Field(min_length=1), Once]
    sensors: Annotated[tuple[SensorSet, ...], Field(min_length=1), Once]
    speeds: Annotated[tuple[Annotated[int, Field(ge=2)], ...], Field(min_length=1), Once]
    location: NonNegativeInt | None = None
    floor: Deviation
    data_sets: PositiveInt
    other_data_sets: PositiveInt
    most_data_sets: dict[MethodName, PositiveInt]
    workers: PositiveInt
    prior: PriorConfig
    paper: FitConfig
    residual: FitConfig
    preconditioned: FitConfig
    response: FitConfig
    trained: FitConfig
    law: FitConfig

    @rule
    def _fits_by_its_loss(self) -> Iterator[str]:
        for name in ("paper", "residual", "preconditioned", "response"):
            got, wanted = getattr(self, name).loss.kind, "residual" if name == "paper" else name
            if got != wanted:
                yield f"{name} must have loss={wanted}, but got {got}"
        if (self.trained.loss.kind, self.trained.loss.hidden) != ("response", "trained"):
            yield "trained must have loss=response with hidden: trained"
        if (self.law.loss.kind, self.law.model.kind) != ("response", "law"):
            yield "law must have loss=response and model=law"
