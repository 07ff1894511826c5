"""Figure of a comparison: error against noise for each set of sensors, and against the number of speeds."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import cycle
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.comparison.cases import Case
from pipeline.methods.catalogue import METHODS
from pipeline.reporting.comparison_tables import SENSOR_TEXT, Comparison, describe_case
from pipeline.reporting.figures import BLACK, BLUE, GREEN, GREY, ORANGE, PURPLE, SKY, YELLOW, open_figure

_LEAST = 1e-4
"""Percent; what is smaller is exact for every purpose, and drawn as a hollow marker on the edge."""
_LOOKS: dict[str, tuple[str, str, str]] = {
    "least_squares": (GREY, "-", "o"),
    "least_squares_expanded": (GREY, ":", "<"),
    "smoothed": (GREEN, "--", "D"),
    "tikhonov": (GREY, "--", "s"),
    "total_least_squares": (SKY, "-", "^"),
    "multi_frequency": (GREEN, "-", "P"),
    "kalman": (PURPLE, "-", "v"),
    "kriging": (YELLOW, "-", "D"),
    "critical_speeds": (YELLOW, "--", "X"),
    "spline": (BLUE, "--", "s"),
    "paper": (ORANGE, "-.", "x"),
    "paper_scaling": (ORANGE, "-.", "1"),
    "paper_logarithm": (ORANGE, "-.", "2"),
    "paper_second_order": (ORANGE, "-.", "3"),
    "residual": (ORANGE, ":", "<"),
    "preconditioned": (ORANGE, "--", ">"),
    "response": (BLACK, "-", "o"),
    "trained": (BLACK, "--", "s"),
}
"""Colour, line and marker: methods of one family share the colour."""


def draw_comparison(path: Path, comparison: Comparison) -> Path:
    """Median error of the worst coefficient, one line a method; those that give no answer are named below.

    The number of speeds has a panel where there are several.
    """
    panels: list[tuple[str, list[Case], str]] = []
    noise = comparison.along("noise")
    for case in comparison.along("sensors"):
        cases = [Case(one.noise, case.sensors, case.speeds) for one in noise]
        panels.append((f"sensors: {SENSOR_TEXT[case.sensors]}, {case.speeds} speeds", cases, "noise"))
    text = f"sensors: {SENSOR_TEXT[comparison.main.sensors]}, {100 * comparison.main.noise:g} % noise"
    if len(by_speeds := comparison.along("speeds")) > 1:
        panels.append((text, by_speeds, "speeds"))
    columns = 2 if len(panels) > 1 else 1
    rows = (len(panels) + columns - 1) // columns
    with open_figure(path, rows, columns, 6.0 * columns, 1.2 + 3.9 * rows, sharey=True) as axes:
        for ax, (title, cases, key) in zip(axes.flat, panels, strict=False):
            _draw_panel(ax, comparison, cases, key)
            ax.set_title(title)
        for ax in axes.flat[len(panels) :]:
            ax.set_visible(False)
        for row in axes:
            row[0].set_ylabel(f"median error, worst coefficient (%)\nhollow: below {_LEAST:g} %")
        entries: dict[str, Any] = {}
        for ax in axes.flat:
            entries |= dict(zip(*ax.get_legend_handles_labels()[::-1], strict=True))
        axes[0, 0].figure.legend(entries.values(), entries.keys(), loc="outside upper center", ncols=3)
    return path


def _draw_panel(ax: Any, comparison: Comparison, cases: Sequence[Case], key: str) -> None:
    places, silent = np.arange(len(cases)), []
    joined = np.array([case.noise > 0 for case in cases])  # no noise is no place on a logarithmic axis
    for method, shift in zip(comparison.methods, cycle((-0.06, -0.03, 0.0, 0.03, 0.06)), strict=False):
        errors = np.array([comparison.error(method, case) for case in cases])
        if np.isnan(errors).all():
            silent.append(METHODS[method].label)
            continue
        colour, line, marker = _LOOKS[method]
        width = 2.2 if method == "response" else 1.3
        look: dict[str, Any] = {"color": colour, "marker": marker, "ms": 6, "lw": width, "zorder": 2 + width}
        shown = np.where(joined, errors, np.nan)
        ax.semilogy(places + shift, np.maximum(shown, _LEAST), ls=line, label=METHODS[method].label, **look)
        for place, error in zip(places[~joined], errors[~joined], strict=True):
            fill = "white" if error < _LEAST else colour
            ax.semilogy(place + 3 * shift, max(error, _LEAST), ls="", mfc=fill, clip_on=False, **look)
    ax.set_xticks(places, [describe_case(case, key) for case in cases])
    ax.set_ylim(bottom=_LEAST)
    lines = {"noise": "noise of each reading", "speeds": "number of speeds"}[key]
    if silent:
        lines += "".join(
            f"\n{', '.join(silent[i : i + 3])}{',' * (i + 3 < len(silent))}" for i in range(0, len(silent), 3)
        )
        lines = lines.replace("\n", "\nno answer: ", 1)
    ax.set_xlabel(lines, fontsize=8)
