"""The numbers of bearing laws in an engineer's units, and what a fit says for and against its law."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from pipeline.config.schema import Config
from pipeline.data.operating import write_condition
from pipeline.evaluation.physical_numbers import find_contradiction, list_contradicted
from pipeline.reporting.console import print_table
from pipeline.reporting.tables import Table
from pipeline.write_numbers import write_number

_ZERO_CELSIUS = 273.15
_UNITS = {
    "radial_clearance": ("um", 1e6, 0.0),
    "journal_diameter": ("mm", 1e3, 0.0),
    "ball_diameter": ("mm", 1e3, 0.0),
    "length": ("mm", 1e3, 0.0),
    "viscosity": ("mPa s", 1e3, 0.0),
    "slope": ("1/K", 1.0, 0.0),
    "b": ("K", 1.0, 0.0),
    "c": ("degC", 1.0, -_ZERO_CELSIUS),
    "contact_angle": ("deg", 180.0 / np.pi, 0.0),
}
"""By the last part of a number's name: the unit that is shown, what SI is multiplied by, and what is added."""


@dataclass(frozen=True)
class EngineersNumber:
    """A number of a bearing law as an engineer writes it."""

    name: str  # such as 8.radial_clearance
    label: str  # such as "node 8 radial clearance"
    value: float
    deviation: float
    unit: str
    guess: float
    determined: bool

    @property
    def percent(self) -> float:
        """Standard deviation over the value."""
        return 100.0 * abs(self.deviation / self.value) if self.value else np.inf


def list_numbers(found: Mapping[str, Mapping[str, Any]], config: Config) -> list[EngineersNumber]:
    """The ``physical_numbers`` (SI) of ``training.json`` or ``metrics.json`` in an engineer's units."""
    oil = None if config.machine.laws is None else config.machine.laws.oil
    reference = getattr(oil, "reference", None)
    numbers = []
    for name, number in found.items():
        where, _, what = name.partition(".")
        unit, factor, shift = _UNITS.get(what, (number["unit"].replace(" * ", " ").replace(" / ", "/"), 1.0, 0.0))
        place = where if where == "oil" else f"node {where}"
        label = f"{place} {what.replace('_', ' ')}"
        if what == "viscosity" and reference is not None:
            label += f" at {write_condition('oil_temperature', reference)}"
        value, guess = (factor * number[key] + shift for key in ("value", "guess"))
        numbers.append(
            EngineersNumber(name, label, value, factor * number["deviation"], unit, guess, number["determined"])
        )
    return numbers


def print_numbers(name: str, numbers: Sequence[EngineersNumber]) -> None:
    """A row a number; nothing of a fit without bearing laws."""
    print_table(tabulate_numbers(f"{name}: numbers of the bearing laws (+- standard deviation)", numbers))


def tabulate_numbers(caption: str, numbers: Sequence[EngineersNumber]) -> Table:
    """A row a number."""
    rows = [
        [
            number.label,
            write_number(number.value, number.deviation),
            number.unit,
            write_number(number.percent, digits=2),
            write_number(number.guess),
            "" if number.determined else "the data do not tell it",
        ]
        for number in numbers
    ]
    return Table(caption, ["number", "found", "unit", "+- %", "guess", ""], rows)


def describe_law(quality: Mapping[str, Any], kind: str) -> list[str]:
    """Sentences for and against the bearing laws of a fit of model ``kind``; empty without any."""
    contradiction = find_contradiction(quality, kind)
    phrases = [] if contradiction is None else [" ".join(contradiction)]
    phrases += [_describe_correction(node, correction) for node, correction in quality.get("correction", {}).items()]
    law = quality.get("law", {})
    for node, share in law.get("outside_table", {}).items():
        if share > 0:
            phrases.append(
                f"At {write_number(100 * share, digits=2)} % of the points the bearing of node {node} lies beyond the "
                "end of its table, whose last coefficients are continued there: give a table that goes further."
            )
    if law.get("starts", 1) > 1:
        phrases.append(
            f"{law['starts_at_this_answer']} of {law['starts']} guesses of the numbers ended at this answer."
        )
    return phrases


def _describe_correction(
    node: str, coefficients: Mapping[str, Mapping[str, float]], least_percent: float = 0.01
) -> str:
    """How much a network corrects the law of a bearing: what stands out of its own deviation speaks against the law."""
    if all(max(entry["percent"], entry["deviation_percent"]) < least_percent for entry in coefficients.values()):
        return f"The network corrects nothing of the law of node {node}: the readings do not ask for it."
    shown = ", ".join(
        f"{name} {write_number(entry['percent'], digits=2)} +- {write_number(entry['deviation_percent'], digits=2)} %"
        for name, entry in coefficients.items()
    )
    out = list_contradicted(coefficients)
    against = f"That of {', '.join(out)} speaks against the law" if out else "None of it speaks against the law"
    return f"The network corrects the law of node {node} by {shown} (root mean square). {against}."
