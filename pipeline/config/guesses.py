"""Physical numbers of bearing laws: a plain quantity is known, ``{guess, within}`` is unknown."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Field

from pipeline.config.quantities import to_si
from pipeline.config.section import Section


class GuessConfig(Section):
    """An unknown positive number; ``within`` is the factor that is one standard deviation about the guess."""

    guess: float = Field(gt=0)
    within: float = Field(default=3.0, gt=1)


CONDITION = "condition"
"""In place of a load: that of the operating condition ``load``."""


def _convert(value: Any, unit: str, example: str, or_condition: bool) -> Any:
    if isinstance(value, GuessConfig) or (or_condition and value == CONDITION):
        return value
    if not isinstance(value, Mapping):
        return convert_positive(value, unit, example)
    if "guess" not in value or (strangers := value.keys() - GuessConfig.model_fields.keys()):
        what = "no guess" if "guess" not in value else f"'{min(strangers)}'"
        raise ValueError(f"must be a quantity, or have a guess (such as {example}) and within, but has {what}")
    within = to_si(value.get("within", GuessConfig.model_fields["within"].default), "", "3")
    if within <= 1:
        raise ValueError(f"must have within above 1 (the factor that is one standard deviation), but got {within:g}")
    return GuessConfig(guess=convert_positive(value["guess"], unit, example), within=within)


def convert_positive(value: Any, unit: str, example: str) -> float:
    """A known quantity in ``unit``. Raises ValueError where it is not above zero."""
    number = to_si(value, unit, example)
    if number <= 0:
        raise ValueError(f"must be above zero (such as {example}), but got {value!r}")
    return number


def define_number(unit: str, example: str, or_condition: bool = False) -> Any:
    """The type of a positive number in ``unit`` that may be unknown, or :data:`CONDITION`."""
    extra: dict[str, Any] | None = {"unit": unit} if unit else None
    convert = BeforeValidator(lambda value: _convert(value, unit, example, or_condition))
    kinds: Any = float | GuessConfig | Literal["condition"] if or_condition else float | GuessConfig
    return Annotated[kinds, convert, Field(json_schema_extra=extra)]


LengthNumber = define_number("m", "0.1 mm")
ViscosityNumber = define_number("Pa * s", "20 mPa s")
SlopeNumber = define_number("1 / K", "0.03 1/K")
TemperatureNumber = define_number("K", "-95 degC")
DifferenceNumber = define_number("K", "900 K")
ForceNumber = define_number("N", "500 N")
AngleNumber = define_number("rad", "30 deg")
PureNumber = define_number("", "0.5")
LoadNumber = define_number("N", "500 N", or_condition=True)
"""A load may also be that of the operating condition ``load``."""


ModelledLoad = Annotated[
    float | Literal["condition"],
    BeforeValidator(lambda value: value if value == CONDITION else convert_positive(value, "N", "500 N")),
    Field(json_schema_extra={"unit": "N"}),
]
"""The static load of a modelled bearing: a number, or that of the operating condition ``load``."""


def middle(value: Any) -> float:
    """The known number, or the guess."""
    return float(value.guess if isinstance(value, GuessConfig) else value)
