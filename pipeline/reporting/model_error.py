"""What the model may be wrong in: its fitted parameters, and what their tolerances do to the coefficients."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pipeline.identification.identified import FittedParameter
from pipeline.reporting.console import table
from pipeline.reporting.figures import open_figure
from pipeline.rotor.parameters import UNITS


def print_parameters(name: str, fitted: Sequence[FittedParameter]) -> None:
    """Stated tolerance and fitted value of every model parameter."""
    rows = []
    for parameter in fitted:
        kind, prior = parameter.parameter.kind, parameter.parameter.deviation
        told = "" if parameter.deviation < TOLD else "as stated: the data do not tell"
        text = f"{_format(kind, parameter.value * prior)} +- {_format(kind, parameter.deviation * prior)}"
        rows.append([parameter.parameter.name, f"0 +- {_format(kind, prior)}", text, told])
    table(f"{name}: model parameters, against what is stated", ["parameter", "stated", "found", ""], rows)


TOLD = 0.9
"""Posterior over prior deviation, above which the data tell nothing."""


def _format(kind: str, value: float) -> str:
    """In an engineer's units."""
    unit = UNITS[kind]
    if not unit:
        return f"{100 * value:.2g} %"
    shown, factor = {"rad": ("deg", float(np.degrees(1))), "m": ("mm", 1e3)}.get(unit, (unit, 1.0))
    return f"{factor * value:.3g} {shown}"


@dataclass(frozen=True)
class Budget:
    """What the tolerance of each assumed quantity does to each coefficient."""

    tolerances: Mapping[str, float]  # by kind, in its unit
    coefficients: Sequence[str]  # such as "kxx node 1"
    percent: Mapping[str, np.ndarray]  # by kind, (A,) percent of the coefficient

    @property
    def rows(self) -> list[str]:
        """Each kind with its tolerance."""
        return [f"{kind} ({_format(kind, self.tolerances[kind])})" for kind in self.percent]


def print_budget(name: str, budget: Budget) -> None:
    """Coefficients down, tolerances across."""
    rows = [
        [coefficient, *(f"{values[a]:.2g}" for values in budget.percent.values())]
        for a, coefficient in enumerate(budget.coefficients)
    ]
    title = f"{name}: systematic budget, what each tolerance does to a coefficient in percent (medians over speed)"
    table(title, ["coefficient", *budget.rows], rows)


def draw_budget(path: Path, budget: Budget) -> Path:
    """A map of tolerances against coefficients: darker for more percent, with the numbers."""
    values = np.array(list(budget.percent.values()))
    height, width = 1.8 + 0.4 * len(values), 3.2 + 0.62 * values.shape[1]
    with open_figure(path, 1, 1, width, height) as axes:
        ax = axes[0, 0]
        ax.grid(False)
        shade = np.log10(np.clip(values, 0.1, 100.0))
        ax.imshow(shade, cmap="Blues", vmin=-1, vmax=2, aspect="auto")
        for i, j in np.ndindex(values.shape):
            colour = "white" if shade[i, j] > 1 else "black"
            ax.text(j, i, f"{values[i, j]:.2g}", ha="center", va="center", fontsize=7, color=colour)
        ax.set_xticks(range(values.shape[1]), budget.coefficients, rotation=60, ha="right", fontsize=8)
        ax.set_yticks(range(len(values)), budget.rows, fontsize=8)
        ax.set_title("change of the coefficient by the tolerance in brackets (%, median over speed)", fontsize=9)
    return path
