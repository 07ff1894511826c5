"""Units at the edge: a quantity in a config is a number in SI or a text such as ``150 mm``.

Everything inside the package is SI and radians; this is the one place where a config's units are
converted, by pint. A physical number of a bearing law is known as a plain quantity, and unknown as ``{guess, within}``.
"""

from __future__ import annotations

import contextlib
import math
import re
from collections.abc import Iterator, Mapping
from functools import cache, lru_cache
from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Field

from pipeline.coefficients import COEFFICIENTS, is_stiffness
from pipeline.config.section import Section


@cache
def _load_units() -> Any:
    import pint

    return pint.UnitRegistry()


def to_si(value: Any, unit: Any, example: str) -> float:
    """``value`` in ``unit`` (a name, or pint's own): numbers are SI already, texts carry their unit.

    Raises ValueError (which pydantic reports with the key) where the unit is unknown or of another dimension.
    """
    if isinstance(value, bool) or not isinstance(value, (int, float, str)):
        raise ValueError(f"must be a quantity (such as {example}), but got {value!r}")
    if isinstance(value, str):
        value = _parse(value, unit, example)
    if not math.isfinite(value):
        raise ValueError(f"must be finite (such as {example}), but got {value!r}")
    return float(value)


_POWER = r"(?:\*\*|\^)\s*"
_TOWER = re.compile(rf"{_POWER}(?![-+(]*\d{{1,2}}\b)|{_POWER}[-+(]*\w+\)*\s*{_POWER}")
"""A power of more than two digits, or of a power: such a number has no end."""


@lru_cache(10_000)
def _parse(text: str, unit: Any, example: str, longest: int = 100) -> float:
    import pint

    if is_number(text):
        return float(text)
    if len(text) > longest or _TOWER.search(text):
        raise ValueError(f"must be a quantity (such as {example}), but got {text[:longest]!r}")
    units = _load_units()
    temperature = re.fullmatch(r"\s*([-+]?[\d.]+(?:[eE][-+]?\d+)?)\s*(deg[CF]|°[CF])\s*", text)
    try:
        if temperature:  # pint takes no product with a unit whose zero is elsewhere
            quantity = units.Quantity(float(temperature[1]), temperature[2])
        else:
            # pint's mil is an angle; a probe's is a length. A degree in a product is a difference.
            differences = re.sub(r"(?:\bdeg|°)([CF])\b", r"delta_deg\1", text)
            quantity = units.Quantity(re.sub(r"\bmils?\b", "thou", differences))
    except pint.UndefinedUnitError as error:
        raise ValueError(f"must have a known unit (such as {example}), but got {text!r}: {error}") from None
    except Exception:  # pint's parser raises many kinds (tokenize, syntax, assertion errors) for other text
        raise ValueError(f"must be a quantity (such as {example}), but got {text!r}") from None
    try:
        return float(quantity.to(unit).magnitude)
    except pint.DimensionalityError:
        raise ValueError(f"must convert to {unit} (such as {example}), but got {text!r}") from None


def is_number(text: str) -> bool:
    """True for a text without a unit."""
    with contextlib.suppress(ValueError):
        float(text)
        return True
    return False


def to_base(values: Any, unit: str) -> Any:
    """``values`` (a number or an array) of ``unit`` in SI, temperatures in K. Raises ValueError for an unknown unit."""
    return _load_units().Quantity(values, _find_unit(unit)).to_base_units().magnitude


def from_base(values: Any, unit: str) -> Any:
    """SI ``values`` (a number or an array) in ``unit``. Raises ValueError for an unknown unit."""
    return _load_units().Quantity(values, base_of(unit)).to(unit).magnitude


def base_of(unit: str) -> Any:
    """The unit of SI, K for temperatures, as pint has it. Raises ValueError for an unknown unit."""
    return _load_units().Quantity(1.0, _find_unit(unit)).to_base_units().units


def _find_unit(unit: str) -> Any:
    try:
        return _load_units().parse_units(unit)
    except Exception:  # pint's parser raises many kinds for other text
        raise ValueError(f"'{unit}' is no known unit") from None


def _convert_angle(value: Any) -> float:
    angle = to_si(value, "rad", "45 deg")
    if isinstance(value, str) and not is_number(value):
        return math.remainder(angle, 2 * math.pi)
    if abs(angle) > 2 * math.pi:  # 45 stands for degrees, but a number alone is in radians
        raise ValueError(f"must carry its unit (such as 45 deg) where it is beyond a turn in radians, but got {value}")
    return angle


def _define_quantity(unit: str, example: str, **bounds: Any) -> Any:
    field = Field(json_schema_extra={"unit": unit}, **bounds)
    return Annotated[float, BeforeValidator(lambda value: to_si(value, unit, example)), field]


def _convert_weight(value: Any, most: float = 0.01) -> float:
    """A number alone above ``most`` kg m, 10,000 g mm, is meant in another unit."""
    magnitude = to_si(value, "kg * m", "100 g mm")
    if magnitude > most and is_number(str(value)):
        raise ValueError(f"must carry its unit (such as 100 g mm), since a number alone is in kg m, but got {value}")
    return magnitude


Length = _define_quantity("m", "150 mm", gt=0)
Velocity = _define_quantity("m / s", "0.5 mm/s", gt=0)
Acceleration = _define_quantity("m / s**2", "0.1 m/s^2", gt=0)
Bore = _define_quantity("m", "0 mm", ge=0)
Deviation = _define_quantity("m", "0.1 um", ge=0)
Angle = _define_quantity("rad", "30 deg")
PositiveAngle = _define_quantity("rad", "2 deg", gt=0, lt=math.pi / 2)
Mass = _define_quantity("kg", "12 kg", gt=0)
Inertia = _define_quantity("kg * m**2", "0.2 kg m^2", gt=0)
Density = _define_quantity("kg / m**3", "7810 kg/m^3", gt=0)
Pressure = _define_quantity("Pa", "211 GPa", gt=0)
Force = _define_quantity("N", "500 N", gt=0)
Temperature = _define_quantity("K", "45 degC", gt=0)
Stiffness = _define_quantity("N / m", "1e7 N/m", gt=0)
Damping = _define_quantity("N * s / m", "1e4 N s/m", gt=0)
AnyStiffness = _define_quantity("N / m", "0 N/m")
AnyDamping = _define_quantity("N * s / m", "0 N s/m")
WeightLaw = _define_quantity("1 / (kg * m)", "0.003 / (g mm)", gt=0)
UnbalanceMagnitude = _define_quantity("kg * m", "100 g mm", gt=0)
RotorSpeed = _define_quantity("rad / s", "2000 rpm", gt=0)
Frequency = _define_quantity("Hz", "5120 Hz", gt=0)
ShaftAngle = Annotated[float, BeforeValidator(_convert_angle), Field(json_schema_extra={"unit": "rad"})]
"""rad, between -pi and pi where it had a unit; a number that can only be degrees is refused."""

WeightMagnitude = Annotated[float, BeforeValidator(_convert_weight), Field(json_schema_extra={"unit": "kg * m"}, gt=0)]
"""kg m, of a weight that somebody put on; a number that can only be in another unit is refused."""


def define_coefficients(default: float | None) -> dict[str, Any]:
    """A key for each of the eight coefficients, with a ``default``: null may stand for it where that is null."""
    kinds = {name: AnyStiffness if is_stiffness(name) else AnyDamping for name in COEFFICIENTS}
    return {name: (kind | None if default is None else kind, default) for name, kind in kinds.items()}


# --- numbers that may be unknown -------------------------------------------------------------------------


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
    converted = {key: convert_positive(value[key], unit, example) for key in ("guess",) if key in value}
    return GuessConfig.model_validate(dict(value) | converted)  # which tells its own errors


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


def check_clearance(journal: Any) -> Iterator[str]:
    """A sentence where the radial clearance of a ``journal`` bearing is no smaller than its journal's radius."""
    radius, clearance = middle(journal.journal_diameter) / 2, middle(journal.radial_clearance)
    if clearance >= radius:
        yield (
            f"radial_clearance must be smaller than the journal's radius, but it is {1e3 * clearance:g} mm and the "
            f"radius {1e3 * radius:g} mm: correct the unit of the one that is wrong"
        )
