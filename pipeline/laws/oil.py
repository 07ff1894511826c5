"""Viscosity of an oil over its temperature, with derivatives by its unknown numbers.

Legend: G members, S operating points, Th unknown numbers. SI units, temperatures in K.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from pipeline.config.guesses import middle
from pipeline.config.oil import ConstantOilConfig, ExponentialOilConfig, VogelOilConfig
from pipeline.errors import ConfigError
from pipeline.laws.numbers import Number, add_slope

if TYPE_CHECKING:
    import torch

_NEAREST = 1.0
"""K: a fit that puts Vogel's pole nearer to an oil's temperature meets this distance."""


def viscosity_at(oil: ConstantOilConfig | ExponentialOilConfig | VogelOilConfig, temperature: np.ndarray) -> np.ndarray:
    """(S,) Pa s of an oil with known numbers at ``temperature`` (S,) K."""
    change = np.zeros_like(temperature)
    if isinstance(oil, ExponentialOilConfig):
        change = -middle(oil.slope) * (temperature - oil.reference)
    elif isinstance(oil, VogelOilConfig):
        b, c = middle(oil.b), middle(oil.c)
        if (temperature <= c).any():
            raise ConfigError(
                f"an oil must be above Vogel's c of {c:g} K, but it is at {temperature.min():g} K: correct c, or the "
                "temperature"
            )
        change = b / (temperature - c) - b / (oil.reference - c)
    return np.asarray(middle(oil.viscosity) * np.exp(change))


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
