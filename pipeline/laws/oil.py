"""Viscosity of an oil over its temperature, with derivatives by its unknown numbers.

Legend: G members, S operating points, Th unknown numbers. SI units, temperatures in K.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any, Literal

from pipeline.laws.numbers import Number, add_slope

if TYPE_CHECKING:
    import torch

_NEAREST = 1.0
"""K: a fit that puts Vogel's pole nearer to an oil's temperature meets this distance."""


@dataclass(frozen=True)
class Oil:
    """``ln eta = ln viscosity - slope (T - T_ref)``; ``+ b / (T - c) - b / (T_ref - c)``; or the first term alone."""

    law: Literal["constant", "exponential", "vogel"]
    reference: float  # K
    viscosity: Number  # Pa s
    slope: Number  # 1/K; of `exponential`
    b: Number  # K; of `vogel`
    c: Number  # K

    @property
    def needs_temperature(self) -> bool:
        """True for a viscosity that depends on it."""
        return self.law != "constant"

    def log_viscosity(self, theta: torch.Tensor, temperature: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """(G, S) ln of the viscosity in Pa s at ``temperature`` (S,) K, and (G, S, Th) its slopes by ``theta``."""
        import torch

        members, points = len(theta), len(temperature)
        slopes = torch.zeros(members, points, theta.shape[1], dtype=theta.dtype)
        result = self.viscosity.log(theta).expand(members, points)
        add_slope(slopes, self.viscosity, torch.ones_like(result))
        if self.law == "exponential":
            change = -self.slope.of(theta) * (temperature - self.reference)
            add_slope(slopes, self.slope, change)
            result = result + change
        elif self.law == "vogel":
            b, c = self.b.of(theta), self.c.of(theta)
            here = (temperature - c).clamp(min=_NEAREST)
            there = (self.reference - c).clamp(min=_NEAREST)
            change = b / here - b / there
            add_slope(slopes, self.b, change)
            moved = (temperature - c > _NEAREST) / here**2 - (self.reference - c > _NEAREST) / there**2
            add_slope(slopes, self.c, b * c * moved)
            result = result + change
        return result, slopes

    def to_record(self) -> dict[str, Any]:
        """A JSON-able twin."""
        return asdict(self)

    @classmethod
    def from_record(cls, record: dict[str, Any]) -> Oil:
        """The oil of :meth:`to_record`."""
        numbers = {name: Number(**record[name]) for name in ("viscosity", "slope", "b", "c")}
        return cls(law=record["law"], reference=float(record["reference"]), **numbers)
