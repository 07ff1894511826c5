"""What a fit hands on: the trained model, its uncertainty, and how well it explains the readings.

An answer is that model together with the measurement that it is of: what everything behind a fit takes.

Legend: M members, B bearings, S speeds, U unknowns, Q parameters, Th numbers of bearing laws, N balance planes.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from pipeline.identification.blocks import law_term
from pipeline.identification.inputs import points_of
from pipeline.identification.model import CoefficientModel
from pipeline.identification.training import Outcome
from pipeline.laws.law_set import NO_LAWS, LawSet
from pipeline.parameters.kind import ModelParameter
from pipeline.rotor.bearing_table import BearingTable
from pipeline.unknowns import UnknownSet

if TYPE_CHECKING:
    import torch

    from pipeline.identification.quality import Quality
    from pipeline.identification.uncertainty import Uncertainty
    from pipeline.problem.measurement import Measurement


def _no_numbers() -> torch.Tensor:
    import torch

    return torch.zeros(0, dtype=torch.float64)


@dataclass(frozen=True, eq=False)
class IdentifiedModel:
    """A coefficient model with its trained numbers."""

    model: CoefficientModel
    unknowns: UnknownSet
    bearing_nodes: tuple[int, ...]
    parameters: torch.Tensor  # (M, Q)
    laws: LawSet = NO_LAWS  # of the bearings, which the model corrects
    theta: torch.Tensor = field(default_factory=_no_numbers)  # (Th,) their numbers, as logarithms over the guesses

    def values(self, speeds: np.ndarray, operating: Mapping[str, np.ndarray] | None = None) -> np.ndarray:
        """(B, S, U) unknowns at ``speeds`` (S,) rad/s and ``operating`` conditions (name -> (S,) SI), N/m and N s/m."""
        import torch

        with torch.no_grad():
            values = self.corrected(points_of(speeds, operating))[0].numpy()
        return np.broadcast_to(values, (len(self.bearing_nodes), *values.shape[1:])).copy()

    def corrected(self, points: Mapping[str, np.ndarray]) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """(M, S, U) unknowns at ``points`` (name -> (S,)), and their derivatives by outputs and theta: (M, S, U, U) and
        (M, S, U, Th).
        """
        raw = self.model.raw(self.parameters, self.model.scaled_inputs(points))[None]  # (1, M, S, U)
        term, scale = law_term(self.laws, self.unknowns, points), self.model.scale_tensor()
        values, by_outputs, by_numbers = term.correct(self.model, self.theta[None], raw, scale)
        return values[0], by_outputs[0], by_numbers[0]

    def table(self, known: BearingTable) -> BearingTable:
        """All eight coefficients: the identified ones, and the known ones from ``known``."""
        return known.with_unknowns(self.unknowns, self.values(known.speeds, known.operating))


@dataclass(frozen=True, eq=False, kw_only=True)
class Fit:
    """The answer of a fit, of whatever loss."""

    model: IdentifiedModel
    outcome: Outcome
    loss: float
    held_out_loss: float | None
    steps: int
    seconds: float
    history: tuple[Mapping[str, float | str], ...]
    uncertainty: Uncertainty | None  # None for a loss that states no deviations
    quality: Quality
    parameters: tuple[ModelParameter, ...] = ()  # uncertain ones of the model, at their fitted values

    def table(self, known: BearingTable) -> BearingTable:
        """All eight coefficients at the speeds of ``known``, N/m and N s/m."""
        return self.model.table(known)

    def deviation(self, speeds: np.ndarray, operating: Mapping[str, np.ndarray] | None = None) -> np.ndarray | None:
        """(B, S, 8) standard deviations, see :meth:`pipeline.identification.uncertainty.Uncertainty.deviation`."""
        return None if self.uncertainty is None else self.uncertainty.deviation(speeds, operating)


@dataclass(frozen=True, eq=False)
class Answer:
    """The trained model, and the measurement at the model parameters that the fit found; see :func:`answer_of`."""

    measurement: Measurement
    model: IdentifiedModel
    uncertainty: Uncertainty | None  # None for a loss that states no deviations

    @cached_property
    def table(self) -> BearingTable:
        """All eight coefficients at the points of the data."""
        return self.model.table(self.measurement.updated_known)

    @cached_property
    def stated(self) -> BearingTable:
        """The same with their standard deviations."""
        return self.state(self.table)

    def state(self, table: BearingTable) -> BearingTable:
        """The ``table`` with the standard deviations at its points, where the fit states some."""
        return self.uncertainty.state(table) if self.uncertainty else table

    @property
    def tags(self) -> dict[str, str]:
        """What records and reports know the data by."""
        return {"data_fingerprint": self.measurement.dataset.fingerprint}

    @property
    def names(self) -> tuple[tuple[str, ...], ...]:
        """What is identified, bearing by bearing."""
        return self.model.unknowns.by_bearing

    @property
    def unbalance(self) -> np.ndarray | None:
        """(N,) complex residual unbalance, kg m."""
        return None if self.uncertainty is None else self.uncertainty.residual_unbalance


def answer_of(measurement: Measurement, model: IdentifiedModel, uncertainty: Uncertainty | None) -> Answer:
    """The answer of a fit to ``measurement``, which is as it was stated before."""
    if uncertainty is None:
        return Answer(measurement, model, uncertainty)
    floor, share = map(float, uncertainty.noise[:2])
    floors = tuple(map(tuple, uncertainty.noise[2:].reshape(-1, 3).tolist()))
    noise = replace(measurement.noise, additive=floor, multiplicative=share, floors=floors)
    return Answer(replace(measurement.update(uncertainty.parameters), noise=noise), model, uncertainty)
