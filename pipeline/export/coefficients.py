"""What is exported: coefficients and deviations in the units of the reader, as columns and as JSON.

Each state of a machine with operating conditions is an answer of its own. Legend: B bearings, S speeds.
"""

from __future__ import annotations

import itertools
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np
from pydantic import BaseModel, Field

from pipeline.coefficients import COEFFICIENTS, is_stiffness
from pipeline.data.coefficient_files import tabulate_coefficients
from pipeline.data.operating import list_columns, name_state
from pipeline.data.vibration_files import to_rpm
from pipeline.problem.determination import judge_determined
from pipeline.rotor.bearing_table import BearingTable

Units = Literal["si", "us"]

POUND_PER_INCH = 4.4482216152605 / 0.0254
"""N/m of 1 lbf/in, and N s/m of 1 lbf s/in: the international pound and inch, exactly."""

SCALE = {"si": 1.0, "us": POUND_PER_INCH}
StiffnessUnit = Literal["N/m", "lb/in"]
DampingUnit = Literal["N-s/m", "lb-s/in"]
NAMES: dict[Units, tuple[StiffnessUnit, DampingUnit]] = {"si": ("N/m", "N-s/m"), "us": ("lb/in", "lb-s/in")}
"""Stiffness and damping, as XLTRC2 writes them (lb is a force)."""

CONVENTIONS = (
    "z runs along the shaft, x y z are right-handed, and the shaft turns from x towards y (about +z).",
    "kij is the force along i that a displacement along j takes: the force on the shaft is -K q - C dq/dt.",
    "1 is x, 2 is y. In a film kyx < 0 < kxy drives forward whirl. Coefficients belong to the rotor speed.",
    "Where the other program has x (or the load) in another direction, turn the tables: K' = R K R^T.",
    "Where its shaft turns from y towards x, mirror y: the signs of kxy, kyx, cxy and cyx change.",
)
BRIEF = "shaft turns from x to y (CCW), force on the shaft is -K q - C dq/dt"


@dataclass(frozen=True, eq=False)
class Exported:
    """The answer of an experiment, at one state of its operating conditions."""

    name: str
    table: BearingTable  # SI, with deviations where the fit states some
    identified: np.ndarray  # (B, 8) bool
    units: Units
    operating: Mapping[str, float] = field(default_factory=dict)  # SI; empty where the data have no conditions

    @property
    def state(self) -> str:
        """Such as ``45 degC``; no words without conditions."""
        return name_state(self.operating)

    @property
    def suffix(self) -> str:
        """What the state adds to the name of a file, such as ``_45_degC``."""
        return re.sub(r"[^A-Za-z0-9.+-]+", "_", f"_{self.state}") if self.operating else ""

    @property
    def title(self) -> str:
        """The experiment, and the state."""
        return f"{self.name}, {self.state}" if self.operating else self.name

    @property
    def rpm(self) -> np.ndarray:
        """(S,)."""
        return np.asarray(to_rpm(self.table.speeds))

    @property
    def values(self) -> np.ndarray:
        """(B, S, 8) in the units of the reader."""
        return self.tables[""]

    @property
    def tables(self) -> dict[str, np.ndarray]:
        """Each (B, S, 8) in the units of the reader: the values under no name, and deviations (if any) as ``std``."""
        tables = {"": self.table.values, "std": self.table.deviation}
        return {name: table / SCALE[self.units] for name, table in tables.items() if table is not None}

    def unit(self, name: str) -> str:
        """The unit of a coefficient."""
        return NAMES[self.units][0 if is_stiffness(name) else 1]

    @property
    def undetermined(self) -> list[str]:
        """A line on what these data do not determine, such as ``kxx at node 1 below 775 rpm``; none where all is."""
        judged = judge_determined(self.table)
        lost = ", ".join(f"{each.name} at node {each.node} {each.where}" for each in judged if each.lost)
        beside = f" ({self.state})" if self.operating else ""
        return [f"Not determined by these data, stated for completeness{beside}: {lost}."] if lost else []

    def conventions(self) -> list[str]:
        """Lines for the head of a file."""
        return [f"{self.title}: identified bearing coefficients, {' and '.join(NAMES[self.units])}", *CONVENTIONS]


def list_conventions(states: Sequence[Exported]) -> list[str]:
    """Lines for the head of what holds every state."""
    names = "; ".join(state.state for state in states if state.operating)
    beside = [f"States: {names}."] if names else []
    lost = [line for state in states for line in state.undetermined]
    return [*replace(states[0], operating={}).conventions(), *beside, *lost]


def tabulate(*states: Exported) -> dict[str, Any]:
    """Columns of ``coefficients.csv``: a row a state, bearing and speed, deviations as ``kxx_std``.

    In SI they are those of ``known_coefficients.csv``; in US units the names say so (``kxx_lb_per_in``), which no one
    takes for SI. Conditions have columns of their own, such as ``oil_temperature_degC``.
    """
    parts = [
        tabulate_coefficients(replace(state.table, values=state.values, deviation=state.tables.get("std")))
        for state in states
    ]
    columns = {name: np.concatenate([piece[name] for piece in parts]) for name in parts[0]}
    if states[0].units == "si":
        return columns
    units = {name: "_lb_per_in" if is_stiffness(name) else "_lb_s_per_in" for name in COEFFICIENTS}
    return {name[:3] + units.get(name[:3], "") + name[3:]: values for name, values in columns.items()}


class Coefficient(BaseModel, extra="forbid"):
    """One coefficient over the speed."""

    identified: bool = Field(description="false: it was known, and is repeated here")
    value: list[float] = Field(description="one a speed, in the unit of its kind")
    std: list[float] | None = Field(description="standard deviations; null where there are none")


class Bearing(BaseModel, extra="forbid"):
    """One bearing, at one state of the operating conditions."""

    node: int = Field(ge=0, description="node of the rotor, counted from 0")
    operating: dict[str, float] = Field(description="conditions by name with their unit")
    speed_rpm: list[float]
    coefficients: dict[str, Coefficient] = Field(description=f"by name: {', '.join(COEFFICIENTS)}")


class Number(BaseModel, extra="forbid"):
    """A number of a bearing law."""

    name: str = Field(description="such as node 8 radial clearance")
    value: float
    std: float | None
    unit: str


class Document(BaseModel, extra="forbid"):
    """Identified bearing coefficients of a rotor."""

    schema_version: Literal[1] = 1
    experiment: str
    stiffness_unit: StiffnessUnit
    damping_unit: DampingUnit
    conventions: list[str]
    bearings: list[Bearing]
    physical_numbers: list[Number] = Field(description="of bearing laws, where they were fitted")


def document(*states: Exported, numbers: Sequence[Number] = ()) -> Document:
    """The same as JSON."""
    (stiffness, damping), bearings = NAMES[states[0].units], []
    for exported, (b, node) in itertools.product(states, enumerate(states[0].table.nodes)):
        beside = list_columns({name: np.array([value]) for name, value in exported.operating.items()})
        identified = exported.identified[b].tolist()
        value, *std = (table[b].T.tolist() for table in exported.tables.values())
        coefficients = {
            name: Coefficient(
                identified=identified[c], value=value[c], std=std[0][c] if std and identified[c] else None
            )
            for c, name in enumerate(COEFFICIENTS)
        }
        operating, rpm = {name: float(levels[0]) for name, levels in beside.items()}, exported.rpm.tolist()
        bearings.append(Bearing(node=int(node), operating=operating, speed_rpm=rpm, coefficients=coefficients))
    return Document(
        experiment=states[0].name,
        stiffness_unit=stiffness,
        damping_unit=damping,
        conventions=list(CONVENTIONS),
        bearings=bearings,
        physical_numbers=list(numbers),
    )
