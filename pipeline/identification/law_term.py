"""Bearing laws in a fit: what few physical numbers make of the coefficients, and the network's correction of it.

A coefficient that must be positive is the law's times ``exp(output)``, another one the law's plus ``scale * output``:
an output of zero leaves the law as it is. Without laws the ``scale`` takes their place.

Legend: G data sets or starts, M members, S operating points, U unknowns, B bearings, Th numbers (theta, the logarithm
of each over its guess).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from pipeline.coefficients import COEFFICIENTS
from pipeline.errors import ConfigError
from pipeline.unknowns import UnknownSet

if TYPE_CHECKING:
    import torch

    from pipeline.identification.model import CoefficientModel
    from pipeline.identification.training import FitSetup
    from pipeline.laws.law_set import LawSet
    from pipeline.problem.measurement import Measurement


_FARTHEST = 5.0


class Corrected(NamedTuple):
    """Coefficients with the correction of a model, N/m and N s/m."""

    values: torch.Tensor  # (.., M, S, U)
    by_output: torch.Tensor  # likewise, derivative by the model's output
    by_numbers: torch.Tensor  # (.., M, S, U, Th) derivative by theta


@dataclass(frozen=True, eq=False)
class LawTerm:
    """The laws at the points of a measurement."""

    laws: LawSet
    points: Mapping[str, np.ndarray]  # name -> (S,) the speed in rad/s, operating conditions in SI
    leaders: tuple[int, ...]  # U indices of the coefficients that lead the unknowns

    @property
    def n_numbers(self) -> int:
        """Th."""
        return len(self.laws.parameters)

    def prior_precision(self) -> torch.Tensor:
        """(Th,) of theta: a guess is within its factor by one standard deviation of the logarithm."""
        import torch

        return torch.tensor([parameter.deviation**-2 for parameter in self.laws.parameters], dtype=torch.float64)

    def evaluate(self, theta: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """(G, M, S, U) unknowns of ``theta`` (G, Th), N/m and N s/m, and their slopes (G, M, S, U, Th).

        Beyond some prior deviations nothing changes any more: a step of a fit that leads there is none.
        """
        import torch

        limit = _FARTHEST * self.prior_precision().rsqrt()
        inside = (theta.abs() <= limit).to(theta.dtype)
        theta = torch.clamp(theta, -limit, limit)
        operating = {name: values for name, values in self.points.items() if name != "speed"}
        values, slopes = self.laws.coefficients(theta, self.points["speed"], operating)
        return values[..., list(self.leaders)], slopes[..., list(self.leaders), :] * inside[:, None, None, None]

    def correct(
        self, model: CoefficientModel, theta: torch.Tensor, outputs: torch.Tensor, scale: torch.Tensor
    ) -> Corrected:
        """The unknowns of ``theta`` (G, Th) with the model's ``outputs`` (G, M, S, U) and ``scale``."""
        import torch

        base, slopes = self.evaluate(theta)
        positive = torch.tensor(model.positive)
        growth = torch.where(positive, torch.where(positive, outputs, torch.zeros_like(outputs)).exp(), 1.0)
        values = torch.where(positive, base * growth, base + scale * outputs)
        by_output = torch.where(positive, values, scale.expand_as(values))
        return Corrected(values, by_output, slopes * growth[..., None])


def law_term(laws: LawSet, unknowns: UnknownSet, points: Mapping[str, np.ndarray]) -> LawTerm:
    """The laws for the members' unknowns. Raises ConfigError for bearings that share their coefficients."""
    if unknowns.shared:
        raise ConfigError(
            "identify.shared must be false where machine.laws gives each bearing its own, but it is true: leave it out"
        )
    return LawTerm(laws, points, tuple(COEFFICIENTS.index(name) for name in unknowns.names))


def for_model(measurement: Measurement, setup: FitSetup) -> Measurement:
    """The measurement as the configured model sees it: with bearing laws if it is made of them.

    Raises ConfigError where there are none, or for a loss that they don't go with.
    """
    if not setup.model.has_laws:
        return measurement if measurement.laws is None else measurement.without_laws()
    if measurement.laws is None:
        raise ConfigError(
            f"model={setup.model.kind} must have machine.laws (what is known of bearings and oil, and guesses of the "
            "rest), but the machine has none: write the section, or choose model=network_fluid_film"
        )
    kind, hidden = setup.loss.kind, setup.loss.hidden
    if kind != "response" or hidden != "drawn":
        came = f"loss.kind={kind}" if kind != "response" else f"loss.hidden={hidden}"
        raise ConfigError(
            f"model.kind={setup.model.kind} must go with loss.kind=response and loss.hidden=drawn, but got {came}: "
            "choose loss=response"
        )
    return measurement
