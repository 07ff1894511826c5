"""The schema of balancing: where weights can be put, what is tolerated, and which records are asked about."""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Field, PositiveFloat

from pipeline.config.quantities import Length, Mass, ShaftAngle
from pipeline.config.section import NonNegativeInt, Section, rule
from pipeline.units import RAD_S_PER_RPM

ANY = "any"
"""In place of a list of masses: a weight can have any mass."""


class BalancePlaneConfig(Section):
    """The holes of one plane, evenly spaced on a circle.

    ``first_angle`` is that of hole 1, measured as the angles of known weights are (``machine.recordings.shaft_angle``;
    from x at the pulse where there is none). ``numbering`` is the sense in which the numbers of the holes rise.
    """

    node: NonNegativeInt
    holes: Annotated[int, Field(ge=3, le=360)]
    first_angle: ShaftAngle
    numbering: Literal["with_rotation", "against_rotation"]
    radius: Length


def _parse_masses(value: Any) -> Any:
    if isinstance(value, str) and value != ANY:
        raise ValueError(f"must be a list of masses (such as [0.5 g, 1 g]), or {ANY}, but got {value!r}")
    return value


def _parse_grade(value: Any) -> str:
    text = str(value).replace(" ", "")
    if not re.fullmatch(r"G\d+(\.\d+)?", text) or float(text[1:]) == 0:
        raise ValueError(f"must be a grade of ISO 21940-11 such as G2.5 or G6.3, but got {value!r}")
    return text


class ToleranceConfig(Section):
    """A balance quality grade of ISO 21940-11 at the service speed: what may remain of a rotor's unbalance."""

    grade: Annotated[str, BeforeValidator(_parse_grade)]
    service_speed_rpm: PositiveFloat
    rotor_mass: Mass | None = None

    def permissible(self, mass: float) -> float:
        """kg m, of a rotor of ``mass`` (kg) where no other is configured: U = m G / W, G in mm/s at the speed W."""
        return 1e-3 * float(self.grade[1:]) * (self.rotor_mass or mass) / (self.service_speed_rpm * RAD_S_PER_RPM)


class WeightsConfig(Section):
    """Where weights can be put, which there are, how many a plane at most, and what may remain."""

    planes: tuple[BalancePlaneConfig, ...] = Field(min_length=1)
    masses: Annotated[Literal["any"] | tuple[Mass, ...], BeforeValidator(_parse_masses)]
    most: Annotated[int, Field(ge=1, le=3)] = 2
    tolerance: ToleranceConfig | None = None

    @rule
    def _lawful(self) -> Iterator[str]:
        nodes = [plane.node for plane in self.planes]
        if len(set(nodes)) != len(nodes):
            yield f"must give every plane once, but planes has the nodes {nodes}"
        if not self.masses:
            yield f"must have at least one mass, or {ANY}, but masses is empty"


class PredictConfig(Section):
    """``records``: a table whose known weights' vibration is predicted, by ``method`` or the first that there is.

    ``reference`` is a condition among them that shows what their day adds.
    """

    records: str | None = None
    reference: str | None = None
    method: str | None = None

    @rule
    def _names_records(self) -> Iterator[str]:
        if self.reference and not self.records:
            yield f"must name records where reference is {self.reference}, but records is null"


class BalanceConfig(PredictConfig):
    """What ``stage=balance`` is asked: whose unbalance, and what the correction weights are to take away.

    ``residual`` is what the machine has without known weights; with a ``condition``, that of its record or both.
    """

    condition: str | None = None
    remove: Literal["residual", "condition", "both"] = "residual"
    minimise: Literal["unbalance", "vibration"] = "unbalance"
    speeds_rpm: tuple[PositiveFloat, ...] = ()

    @rule
    def _named(self) -> Iterator[str]:
        if self.remove != "residual" and not self.condition:
            yield f"must name a condition where remove is {self.remove}, but condition is null"
