"""The schema of an oil: its dynamic viscosity as a law of the temperature. SI, temperatures in K."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BeforeValidator, Discriminator, Field, Tag, model_validator

from pipeline.config.guesses import (
    DifferenceNumber,
    GuessConfig,
    SlopeNumber,
    TemperatureNumber,
    ViscosityNumber,
    convert_positive,
    middle,
)
from pipeline.config.quantities import Temperature
from pipeline.config.section import Section


class ConstantOilConfig(Section):
    """The same viscosity at every temperature."""

    law: Literal["constant"]
    viscosity: ViscosityNumber


class ExponentialOilConfig(Section):
    """``viscosity exp(-slope (T - reference))`` (Reynolds)."""

    law: Literal["exponential"]
    reference: Temperature
    viscosity: ViscosityNumber
    slope: SlopeNumber


class VogelOilConfig(Section):
    """``viscosity exp(b / (T - c) - b / (reference - c))`` (Vogel 1921)."""

    law: Literal["vogel"]
    reference: Temperature
    viscosity: ViscosityNumber
    b: DifferenceNumber
    c: TemperatureNumber

    @model_validator(mode="after")
    def _is_above_the_pole(self) -> VogelOilConfig:
        if middle(self.c) >= self.reference:
            raise ValueError(f"must have c below reference, but got {middle(self.c):g} K and {self.reference:g} K")
        return self


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
