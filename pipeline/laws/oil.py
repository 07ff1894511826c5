"""Viscosity of an oil over its temperature: sections of a configuration, and the law of a fit with its derivatives.

Legend: G members, S operating points, Th unknown numbers. SI units, temperatures in K.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

import numpy as np
from pydantic import AfterValidator, BeforeValidator, Discriminator, Field, Tag

from pipeline.config.quantities import (
    DifferenceNumber,
    GuessConfig,
    SlopeNumber,
    Temperature,
    TemperatureNumber,
    ViscosityNumber,
    convert_positive,
    middle,
)
from pipeline.config.section import Section, rule
from pipeline.errors import ConfigError
from pipeline.laws.numbers import OIL_TEMPERATURE, Number, Recorded, add_slope

if TYPE_CHECKING:
    import torch

_NUMBERS = ("viscosity", "slope", "b", "c")


class _OilConfig(Section):
    """An oil of a configuration."""

    law: Literal["constant", "exponential", "vogel"]

    inputs: ClassVar[tuple[str, ...]] = (OIL_TEMPERATURE,)

    @abstractmethod
    def viscosity_at(self, temperature: np.ndarray) -> np.ndarray:
        """(S,) Pa s of an oil with known numbers at ``temperature`` (S,) K. Raises ConfigError."""

    def make(self, number: Callable[[Section, str], Number], alone: float = 293.15) -> Oil:
        """The oil as a fit has it, its numbers made by ``number(section, name)``; one without reference is at ``alone``
        (K), room temperature."""
        given = {name: number(self, name) for name in _NUMBERS if name in type(self).model_fields}
        return Oil(self.law, getattr(self, "reference", alone), **{name: Number(1.0) for name in _NUMBERS} | given)


class ConstantOilConfig(_OilConfig):
    """The same viscosity at every temperature."""

    law: Literal["constant"]
    viscosity: ViscosityNumber

    inputs: ClassVar[tuple[str, ...]] = ()

    def viscosity_at(self, temperature: np.ndarray) -> np.ndarray:
        """(S,) Pa s of an oil with known numbers."""
        return np.full(len(temperature), middle(self.viscosity))


class ExponentialOilConfig(_OilConfig):
    """``viscosity exp(-slope (T - reference))`` (Reynolds)."""

    law: Literal["exponential"]
    reference: Temperature
    viscosity: ViscosityNumber
    slope: SlopeNumber

    def viscosity_at(self, temperature: np.ndarray) -> np.ndarray:
        """(S,) Pa s of an oil with known numbers at ``temperature`` (S,) K."""
        return np.asarray(middle(self.viscosity) * np.exp(-middle(self.slope) * (temperature - self.reference)))


class VogelOilConfig(_OilConfig):
    """``viscosity exp(b / (T - c) - b / (reference - c))`` (Vogel 1921)."""

    law: Literal["vogel"]
    reference: Temperature
    viscosity: ViscosityNumber
    b: DifferenceNumber
    c: TemperatureNumber

    @rule
    def _is_above_the_pole(self) -> Iterator[str]:
        if middle(self.c) >= self.reference:
            yield f"must have c below reference, but got {middle(self.c):g} K and {self.reference:g} K"

    def viscosity_at(self, temperature: np.ndarray) -> np.ndarray:
        """(S,) Pa s of an oil with known numbers at ``temperature`` (S,) K. Raises ConfigError at or below ``c``."""
        b, c = middle(self.b), middle(self.c)
        if (temperature <= c).any():
            raise ConfigError(
                f"an oil must be above Vogel's c of {c:g} K, but it is at {temperature.min():g} K: correct c, or the "
                "temperature"
            )
        return np.asarray(middle(self.viscosity) * np.exp(b / (temperature - c) - b / (self.reference - c)))


OilConfig = Annotated[ConstantOilConfig | ExponentialOilConfig | VogelOilConfig, Field(discriminator="law")]


def _convert(value: Any) -> Any:
    return value if isinstance(value, (Mapping, Section)) else convert_positive(value, "Pa * s", "0.05 Pa s")


def _require_known(value: Any) -> Any:
    for name, number in value if isinstance(value, Section) else ():
        if isinstance(number, GuessConfig):
            raise ValueError(f"must have known numbers for a modelled bearing, but {name} is a guess: give it alone")
    return value


ModelledViscosity = Annotated[
    Annotated[float, Tag("number")] | Annotated[OilConfig, Tag("law")],
    BeforeValidator(_convert),
    AfterValidator(_require_known),
    Field(
        discriminator=Discriminator(lambda value: "number" if isinstance(value, float) else "law"),
        json_schema_extra={"unit": "Pa * s"},
    ),
]
"""The viscosity of a modelled bearing's oil: a number, or a law of the temperature with known numbers."""


@dataclass(frozen=True)
class Oil(Recorded):
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

    def log_viscosity(
        self, theta: torch.Tensor, temperature: torch.Tensor, nearest: float = 1.0
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """(G, S) ln of the viscosity in Pa s at ``temperature`` (S,) K, and (G, S, Th) its slopes by ``theta``.

        A fit that puts Vogel's pole nearer than ``nearest`` K to a temperature meets this distance.
        """
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
            above, above_reference = (temperature - c).clamp(min=nearest), (self.reference - c).clamp(min=nearest)
            change = b / above - b / above_reference
            add_slope(slopes, self.b, change)
            turn = (temperature - c > nearest) / above**2 - (self.reference - c > nearest) / above_reference**2
            add_slope(slopes, self.c, b * c * turn)
            result = result + change
        return result, slopes
