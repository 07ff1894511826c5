"""The schema of an oil: its dynamic viscosity as a law of the temperature. SI, temperatures in K."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, model_validator

from pipeline.config.guesses import DifferenceNumber, SlopeNumber, TemperatureNumber, ViscosityNumber, middle
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
