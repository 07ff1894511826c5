"""Physical numbers that a law is made of: known, or unknown and then ``guess exp(theta_i)``; where a law is asked.

Legend: G members (bearings, or fits beside each other), S operating points, Th unknown numbers. SI units.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any, Self

import numpy as np

from pipeline.laws.table import FilmTable

if TYPE_CHECKING:
    import torch

LOAD = "load"
OIL_TEMPERATURE = "oil_temperature"


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


@dataclass(frozen=True, eq=False)
class Recorded:
    """A law of numbers, words and a table, as JSON."""

    def to_record(self) -> dict[str, Any]:
        """A JSON-able twin."""
        return {
            name: asdict(value)
            if isinstance(value, Number)
            else value.to_record()
            if isinstance(value, FilmTable)
            else value
            for name, value in vars(self).items()
        }

    @classmethod
    def from_record(cls, record: Mapping[str, Any]) -> Self:
        """The law of :meth:`to_record`."""
        numbers = {name: Number(**entry) for name, entry in record.items() if isinstance(entry, dict)}
        tables = {name: FilmTable.from_record(entry) for name, entry in record.items() if isinstance(entry, list)}
        return cls(**{**record, **numbers, **tables})


@dataclass(frozen=True, eq=False)
class Points:
    """Speeds, operating conditions, and the oil's viscosity there (of laws without oil: zeros)."""

    speeds: torch.Tensor  # (S,) rad/s
    operating: Mapping[str, torch.Tensor]  # name -> (S,) SI, temperatures in K
    log_viscosity: torch.Tensor  # (G, S) of Pa s
    viscosity_slopes: torch.Tensor  # (G, S, Th)


def turn_axes(angle: float) -> np.ndarray:
    """(8, 8) that makes coefficients in x and y of those whose first axis points ``angle`` rad from x towards y."""
    cos, sin = np.cos(angle), np.sin(angle)
    turn = np.array([[cos, -sin], [sin, cos]])
    return np.kron(np.eye(2), np.kron(turn, turn))


def scale_film(pure: np.ndarray, load: np.ndarray, clearance: np.ndarray | float, speeds: np.ndarray) -> np.ndarray:
    """(.., S, 8) N/m and N s/m of a film's dimensionless coefficients: ``k = Kbar W / C``, ``c = Bbar W / (w C)``.

    ``load`` in N and ``clearance`` in m are (.., S), or of one point; ``speeds`` (S,) are in rad/s.
    """
    size = (load / clearance)[..., None]
    return np.concatenate([pure[..., :4] * size, pure[..., 4:] * size / speeds[:, None]], axis=-1)
