"""Units of what a probe measures: a displacement, velocity or acceleration, or the voltage that stands for one of them.

A vector U at the frequency w is the displacement V = U / (j w)^k, with the order k 0 for displacements, 1 for
velocities and 2 for accelerations.
"""

from __future__ import annotations

import contextlib
import math
import re
from collections.abc import Sequence
from typing import Annotated, Any

from pydantic import BeforeValidator, Field, ValidationInfo, field_validator

from pipeline.config.quantities import is_number, to_si
from pipeline.config.section import Section

KINDS = ("length", "velocity", "acceleration")
"""By the order k."""
_SI = ("m", "m / s", "m / s**2")
_EXAMPLES = {
    "length": "um, mil or mm",
    "velocity": "mm/s or in/s",
    "acceleration": "g or m/s^2",
    "voltage": "V or mV",
    "signal_unit": "V, mV, um, mm/s or g",
}
_SCALES = "7.87 V/mm, 200 mV/mil, 4 mV/(mm/s) or 100 mV/g"


def find_motion(unit: str) -> tuple[int, float] | None:
    """Order and size (m, m/s, m/s^2) of a unit such as um, mm/s or g; None where it is none of these."""
    return _find_order(f"1 {unit}", _SI)


def _find_order(quantity: str, units: Sequence[str]) -> tuple[int, float] | None:
    """Order and size of a quantity that has one of the ``units``, which are by the order; g is not the gram here."""
    # As pint would have it.
    spelt = re.sub(r"\bips\b", "(inch/s)", re.sub(r"\bg\b", "g_0", quantity.replace("²", "**2")))
    spelt = re.sub(r"/ ?(s|sec)2\b", r"/s**2", spelt)
    for order, unit in enumerate(units):
        with contextlib.suppress(ValueError):
            return order, to_si(spelt, unit, unit)
    return None


def find_volts(unit: str) -> float | None:
    """Size of a unit such as mV in V; None where it is no voltage."""
    volts = _find_order(f"1 {unit}", ("V",))
    return volts[1] if volts else None


def to_motion(unit: str, scale: str | None) -> tuple[int, float]:
    """Order k, and size in m/s^k, of one ``unit``; of a voltage by the sensitivity ``scale``."""
    if scale:
        order, sensitivity = _find_sensitivity(scale)
        return order, (find_volts(unit) or math.nan) / sensitivity
    motion = find_motion(unit)
    assert motion, unit  # the schema has seen to it
    return motion


def _find_sensitivity(scale: str) -> tuple[int, float]:
    """Order, and V s^k/m. Raises ValueError."""
    if sensitivity := _find_order(scale, [f"V / ({unit})" for unit in _SI]):
        return sensitivity
    raise ValueError(f"must be a voltage per length, velocity or acceleration (such as {_SCALES}), but got {scale!r}")


def find_floor(value: Any) -> list[float]:
    """m, m/s and m/s^2 of a noise floor such as ``0.1 m/s^2``: one of them, the others are zero. Raises ValueError."""
    floor = None if is_number(str(value)) else _find_order(str(value), _SI)
    if not floor or floor[1] < 0:
        raise ValueError(f"must be a size in the probe's own quantity (such as 0.1 m/s^2 or 2 um), but got {value!r}")
    return [floor[1] * (floor[0] == order) for order in range(len(_SI))]


def _check_scale(value: Any) -> str:
    if not isinstance(value, str) or is_number(value):
        raise ValueError(f"must carry its unit (such as {_SCALES}), but got {value!r}")
    if _find_sensitivity(value)[1] == 0:
        raise ValueError(f"must not be zero (such as {_SCALES}), but got {value!r}")
    return value


def _check_name(value: Any, info: ValidationInfo) -> str:
    """A unit that the key can take."""
    key = str(info.field_name)
    examples = _EXAMPLES[key]
    if not isinstance(value, str) or not re.fullmatch(r"[^\W\d_]+( ?/ ?(s|sec)(2|²|\^2|\*\*2)?)?", value):
        raise ValueError(f"must be a unit (such as {examples}), but got {value!r}")
    motion, volts = find_motion(value), find_volts(value)
    is_ = "voltage" if volts else KINDS[motion[0]] if motion else ""
    if is_ == key or (key == "signal_unit" and is_):
        return value
    units = {"voltage": "V", "signal_unit": f"V or {' or '.join(_SI)}"} | dict(zip(KINDS, _SI, strict=True))
    instead = f": give {is_}: {value} in its place" if is_ else ""
    raise ValueError(f"must be a unit of {units[key]} (such as {examples}), but got {value!r}{instead}")


Unit = Annotated[str, BeforeValidator(_check_name)]
"""A unit of what its key says: length, velocity, acceleration or voltage, or any of these (``signal_unit``)."""
Floor = Annotated[str, BeforeValidator(lambda value: find_floor(value) and value)]
"""Noise that is constant in what a probe measures."""
Sensitivity = Annotated[str, BeforeValidator(_check_scale)]
"""A probe of voltages has it; negative where the voltage falls when the shaft comes nearer."""


class MotionConfig(Section):
    """The unit of amplitudes: one of ``length``, ``velocity``, ``acceleration`` and ``voltage``."""

    velocity: Unit | None = None
    acceleration: Unit | None = None
    voltage: Unit | None = None
    length: Unit | None = Field(default=None, validate_default=True)

    @property
    def unit(self) -> str:
        """The one that was given."""
        return next(unit for name in (*KINDS, "voltage") if (unit := getattr(self, name)))

    @field_validator("length", mode="after")
    @classmethod
    def _one(cls, value: str | None, info: ValidationInfo) -> str | None:
        others = [name for name in ("velocity", "acceleration", "voltage") if info.data.get(name)]
        wrong = {"velocity", "acceleration", "voltage"} - info.data.keys()  # and that is told
        given = [*(["length"] if value else []), *others]
        if not given and not wrong:
            raise ValueError(
                "must be given (um, mil ...), or velocity (mm/s ...), acceleration (g ...) or voltage (mV ...) in its "
                "place, but is missing"
            )
        if len(given) > 1:
            text = " and ".join(given)
            raise ValueError(f"must be the one unit of the amplitudes, but got {text}: leave out all but one")
        return value
