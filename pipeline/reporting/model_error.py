"""What the model may be wrong in: its fitted parameters, and what their tolerances do to the coefficients."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pipeline.identification.identified import FittedParameter
from pipeline.reporting.console import print_table
from pipeline.reporting.figure import BLACK, Axes, Curve, Figure, HeatMap, Panel
from pipeline.reporting.matplotlib_figures import write_figure
from pipeline.reporting.tables import Table
from pipeline.rotor.parameters import UNITS
from pipeline.write_numbers import write_number


def print_parameters(name: str, fitted: Sequence[FittedParameter]) -> None:
    """Stated tolerance and fitted value of every model parameter."""
    rows = [(p.parameter.name, p.parameter.kind, p.parameter.deviation, p.value, p.deviation) for p in fitted]
    print_table(list_parameters(f"{name}: model parameters, against what is stated", rows))


def list_parameters(caption: str, fitted: Sequence[tuple[str, str, float, float, float]], told: float = 0.9) -> Table:
    """A row a parameter: name, kind, prior deviation in its unit, value and posterior deviation over the prior's.

    Where the posterior is more than ``told`` of the prior, the data tell nothing.
    """
    rows = []
    for label, kind, prior, value, deviation in fitted:
        unit, factor = _choose_unit(kind)
        found = write_number(factor * prior * value, factor * prior * deviation)
        remark = "" if deviation < told else "as stated: the data do not tell"
        stated = f"0 +- {write_number(factor * prior, digits=3)}"
        rows.append([label, unit, stated, found, write_number(value, digits=2), remark])
    return Table(caption, ["parameter", "unit", "stated", "found", "over its tolerance", ""], rows)


def _choose_unit(kind: str) -> tuple[str, float]:
    """An engineer's unit, and what the parameter's is multiplied by."""
    unit = UNITS[kind]
    if kind in ("bow", "runout"):
        return "um", 1e6
    return {"": ("%", 100.0), "rad": ("deg", float(np.degrees(1))), "m": ("mm", 1e3)}.get(unit, (unit, 1.0))


@dataclass(frozen=True)
class Budget:
    """What the tolerance of each assumed quantity does to each coefficient."""

    tolerances: Mapping[str, float]  # by kind, in its unit
    coefficients: Sequence[str]  # such as "kxx node 1"
    percent: Mapping[str, np.ndarray]  # by kind, (A,) percent of the coefficient

    @property
    def rows(self) -> list[str]:
        """Each kind with its tolerance."""
        units = {kind: _choose_unit(kind) for kind in self.percent}
        sizes = {kind: write_number(factor * self.tolerances[kind], digits=3) for kind, (_, factor) in units.items()}
        return [f"{kind} ({sizes[kind]} {units[kind][0]})" for kind in self.percent]


def print_budget(name: str, budget: Budget) -> None:
    """Coefficients down, tolerances across."""
    rows = [
        [coefficient, *(write_number(float(values[a]), digits=2) for values in budget.percent.values())]
        for a, coefficient in enumerate(budget.coefficients)
    ]
    title = f"{name}: systematic budget, what each tolerance does to a coefficient in percent (medians over speed)"
    print_table(Table(title, ["coefficient", *budget.rows], rows))


def draw_budget(path: Path, budget: Budget) -> Path:
    """A map of tolerances against coefficients: darker for more percent, with the numbers."""
    values = np.array(list(budget.percent.values()))
    shade = np.log10(np.clip(values, 0.1, 100.0))
    down, across = np.meshgrid(*map(np.arange, values.shape), indexing="ij")
    numbers = []
    for colour, chosen in (("#ffffff", shade > 1), (BLACK, shade <= 1)):
        texts = [write_number(float(value), digits=2) for value in values[chosen]]
        numbers.append(Curve(across[chosen], down[chosen] + 0.12, "", colour, "none", texts=texts))
    heat = HeatMap(np.arange(values.shape[1]), np.arange(values.shape[0]), shade, "", "Blues", (-1.0, 2.0))
    title = "change of the coefficient by the tolerance in brackets (%, median over speed)"
    axes = Axes(numbers, "", y_names=budget.rows)
    panel = Panel(title, "", [axes], heat=heat, x_names=budget.coefficients, wide=True)
    return write_figure(path, Figure("budget", "", [panel], columns=1))
