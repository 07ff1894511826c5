"""Operating conditions by name: what a column ``oil_temperature_degC`` or a key ``oil_temperature`` stands for.

A condition is a number beside the speed. The last word of its name says what it is a quantity of, and so its unit: SI
inside (temperatures in K), that of :data:`WRITTEN` in files. A condition of another name is called as its column, with
the unit: ``preheat_degC``.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, Annotated, Any

from pydantic import AfterValidator, BeforeValidator

from pipeline.config.quantities import base_of, from_base, is_number, to_base, to_si
from pipeline.config.section import Section, Text

if TYPE_CHECKING:
    import numpy as np

WRITTEN = {
    "temperature": "degC",
    "pressure": "Pa",
    "load": "N",
    "preload": "N",
    "thrust": "N",
    "torque": "N*m",
    "power": "W",
    "viscosity": "Pa*s",
    "clearance": "m",
    "flow": "m**3/s",
    "current": "A",
    "voltage": "V",
    "opening": "percent",
    "humidity": "percent",
}
"""The unit in which conditions are written, by the last word of their name."""
UNITS = (
    *("degC", "degF", "Pa", "kPa", "MPa", "mbar", "bar", "psi", "N", "kN", "lbf", "N*m", "W", "kW", "MW"),
    *("l/min", "l/h", "m**3/h", "kg/s", "kg/h", "percent"),
)
"""A column of any other name is a condition where it ends in one of these."""


class ConditionColumn(Section):
    """A column of a table with an operating condition in ``unit``."""

    column: Text
    unit: Text

    def to_si(self, values: np.ndarray) -> np.ndarray:
        """Values of the column in SI, temperatures in K."""
        base: np.ndarray = to_base(values.astype(float), self.unit)
        return base

    def from_si(self, values: np.ndarray, digits: int = 12) -> np.ndarray:
        """Values in SI in the unit of the column, of so many ``digits`` that 45 degC is written as 45."""
        written: np.ndarray = from_base(values.astype(float), self.unit)
        written[...] = [float(f"{value:.{digits}g}") for value in written]
        return written


def find_column(column: str) -> dict[str, ConditionColumn]:
    """The condition that a column has, by its name; none for a column of something else.

    Raises ValueError for a condition without a unit, or with one of another dimension.
    """
    name, _, unit = column.rpartition("_")
    word = name.split("_")[-1]
    if column.split("_")[-1] in WRITTEN:
        raise ValueError(f"must have its unit in the name of the column '{column}', but it has none: {_advise(column)}")
    if word not in WRITTEN:
        return {column: ConditionColumn(column=column, unit=unit)} if name and unit in UNITS else {}
    try:
        right = unit not in ("C", "F") and base_of(unit).dimensionality == base_of(WRITTEN[word]).dimensionality
    except ValueError:
        right = False
    if not right:
        raise ValueError(f"must have a unit of {word} at the end of '{column}', but got '{unit}': {_advise(name)}")
    return {name: ConditionColumn(column=column, unit=unit)}


def _advise(name: str) -> str:
    return f"call it {name}_{WRITTEN[name.split('_')[-1]]} (its unit may be another), or leave it out"


def find_columns(columns: Iterable[str], others: Sequence[str] = ()) -> dict[str, ConditionColumn]:
    """The conditions of a table by name, in the order of its ``columns`` and without those of the ``others``.

    Raises ValueError as :func:`find_column`, and for a condition that is there twice.
    """
    found: dict[str, ConditionColumn] = {}
    for column in columns:
        for name, condition in ({} if column in others else find_column(column)).items():
            if name in found:
                raise ValueError(
                    f"must have each condition once, but {name} is in '{found[name].column}' and '{column}': leave one "
                    "out"
                )
            found[name] = condition
    return found


def column_of(name: str) -> ConditionColumn:
    """The column that the condition ``name`` is written to. Raises ValueError for a name that is no condition's."""
    word = name.split("_")[-1]
    if word in WRITTEN:
        return ConditionColumn(column=f"{name}_{WRITTEN[word]}", unit=WRITTEN[word])
    column = find_column(name).get(name)
    if not column:
        raise ValueError(
            f"must name a condition by a last word that says what it is ({', '.join(WRITTEN)}) or by its unit "
            f"(preheat_degC), but got '{name}'"
        )
    return column


def to_quantity(name: str, value: Any, difference: bool = False, coldest: float = 150.0) -> float:
    """A value of the condition ``name``, such as ``45 degC``, in SI; a number is in SI already.

    A ``difference`` of temperatures in degC is one in K; a temperature below ``coldest`` (K), as a number alone, was
    meant in another unit. Raises ValueError for what is no such quantity.
    """
    unit = column_of(name).unit
    warm = unit in ("degC", "degF")
    example = "0.5 K" if difference and warm else f"45 {unit}"
    if difference and isinstance(value, str):
        value = re.sub(r"\bdeg(?=[CF]\b)", "delta_deg", value)
    try:
        number = to_si(value, base_of(unit), example)
    except ValueError as error:
        raise ValueError(f"{name} {error}") from None
    if warm and not difference and 0 < number < coldest and (not isinstance(value, str) or is_number(value)):
        raise ValueError(f"{name} must carry its unit (such as {example}): a number alone is in K, but got {value}")
    if (difference and number < 0) or (warm and not difference and number <= 0):
        law = "zero or more" if difference else "above absolute zero"
        raise ValueError(f"{name} must be {law} (such as {example}), but got {value!r}")
    return number


def _read_mapping(value: Any) -> dict[str, Any]:
    if not isinstance(value, Mapping | None):
        raise ValueError(f"must be conditions by name, such as {{oil_temperature: 45 degC}}, but got {value!r}")
    return {str(name): entry for name, entry in (value or {}).items()}


def _read_states(value: Any) -> dict[str, tuple[float, ...]]:
    states = {}
    for name, given in _read_mapping(value).items():
        several = given if isinstance(given, (list, tuple)) else [given]
        states[name] = tuple(to_quantity(name, level) for level in several)
        if not several or len(set(states[name])) < len(several):
            raise ValueError(f"{name} must have values that differ from each other, but got {list(several)}")
    return states


def _read_conditions(value: Any, difference: bool = False) -> dict[str, float]:
    return {name: to_quantity(name, given, difference) for name, given in _read_mapping(value).items()}


def _check_columns(columns: dict[str, ConditionColumn]) -> dict[str, ConditionColumn]:
    for name, column in columns.items():
        to_quantity(name, f"1000 {column.unit}")
    return columns


ConditionColumns = Annotated[dict[str, ConditionColumn], AfterValidator(_check_columns)]
"""Columns of a table by the name of the condition that they have."""
States = Annotated[dict[str, tuple[float, ...]], BeforeValidator(_read_states)]
"""Values of each condition by its name, SI: every combination is a state of the machine."""
Conditions = Annotated[dict[str, float], BeforeValidator(_read_conditions)]
"""One value of each condition by its name, SI."""
Differences = Annotated[dict[str, float], BeforeValidator(partial(_read_conditions, difference=True))]
"""By how much values of a condition may differ and still be the same, by its name, SI."""
