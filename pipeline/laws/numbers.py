"""Physical numbers that a law is made of: known, or unknown and then ``guess exp(theta_i)``.

Legend: G members (bearings, or fits beside each other), Th unknown numbers. SI units.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import torch


@dataclass(frozen=True)
class LawParameter:
    """An unknown number of a law: its logarithm is normal about that of the guess."""

    name: str  # such as oil.viscosity, 8.radial_clearance
    unit: str  # SI
    guess: float
    within: float  # the factor that is one standard deviation
    member: int | None  # index of its bearing; None where all share it

    @property
    def deviation(self) -> float:
        """One standard deviation of theta."""
        return math.log(self.within)


@dataclass(frozen=True)
class Number:
    """A known value, or the guess of the unknown number ``index`` of theta."""

    value: float
    index: int | None = None

    def of(self, theta: torch.Tensor) -> torch.Tensor:
        """(G, 1) values of ``theta`` (G, Th)."""
        import torch

        if self.index is None:
            return torch.full((len(theta), 1), self.value, dtype=theta.dtype)
        return self.value * torch.exp(theta[:, self.index, None])

    def log(self, theta: torch.Tensor) -> torch.Tensor:
        """(G, 1) their logarithms."""
        return self.of(theta).log()


def add_slope(slopes: torch.Tensor, number: Number, slope: torch.Tensor) -> None:
    """Add ``slope`` (G, S, ..) by the logarithm of a number to ``slopes`` (G, S, .., Th), where it is unknown."""
    if number.index is not None:
        slopes[..., number.index] += slope
