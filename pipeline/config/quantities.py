"""Units at the edge: a quantity in a config is a number in SI or a text such as ``150 mm``.

Everything inside the package is SI and radians; this is the one place where a config's units are
converted, by pint.
"""

from __future__ import annotations

import math
from functools import cache
from typing import Annotated, Any

from pydantic import BeforeValidator, Field


@cache
def _registry() -> Any:
    import pint

    return pint.UnitRegistry()


def to_si(value: Any, unit: str, example: str) -> float:
    """``value`` in ``unit``: numbers are SI already, texts carry their unit.

    Raises ValueError (which pydantic reports with the key) where the unit is unknown or of another dimension.
    """
    if isinstance(value, bool) or not isinstance(value, (int, float, str)):
        raise ValueError(f"must be a quantity (such as {example}), but got {value!r}")
    if isinstance(value, str):
        value = _parse(value, unit, example)
    if not math.isfinite(value):
        raise ValueError(f"must be finite (such as {example}), but got {value!r}")
    return float(value)


def _parse(text: str, unit: str, example: str) -> float:
    import pint

    try:
        return float(text)
    except ValueError:
        pass
    try:
        quantity = _registry().Quantity(text)
    except pint.UndefinedUnitError as error:
        raise ValueError(f"must have a known unit (such as {example}), but got {text!r}: {error}") from None
    except Exception:  # pint's parser raises many kinds (tokenize, syntax, assertion errors) for other text
        raise ValueError(f"must be a quantity (such as {example}), but got {text!r}") from None
    try:
        return float(quantity.to(unit).magnitude)
    except pint.DimensionalityError:
        raise ValueError(f"must convert to {unit} (such as {example}), but got {text!r}") from None


def _quantity(unit: str, example: str, **bounds: Any) -> Any:
    return Annotated[float, BeforeValidator(lambda value: to_si(value, unit, example)), Field(**bounds)]


Length = _quantity("m", "150 mm", gt=0)
Bore = _quantity("m", "0 mm", ge=0)
Deviation = _quantity("m", "0.1 um", ge=0)
Angle = _quantity("rad", "30 deg")
Mass = _quantity("kg", "12 kg", gt=0)
Inertia = _quantity("kg * m**2", "0.2 kg m^2", gt=0)
Density = _quantity("kg / m**3", "7810 kg/m^3", gt=0)
Pressure = _quantity("Pa", "211 GPa", gt=0)
Force = _quantity("N", "500 N", gt=0)
Viscosity = _quantity("Pa * s", "0.05 Pa s", gt=0)
Stiffness = _quantity("N / m", "1e7 N/m", gt=0)
Damping = _quantity("N * s / m", "1e4 N s/m", gt=0)
UnbalanceMagnitude = _quantity("kg * m", "100 g mm", gt=0)
