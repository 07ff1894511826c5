"""Figure of a comparison: a row a method, and how far each is off, for each set of sensors and number of speeds."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.comparison.cases import Case
from pipeline.methods.catalogue import METHODS
from pipeline.reporting.comparison_tables import SENSOR_TEXT, Comparison, describe_case
from pipeline.reporting.figures import BLUE, GREEN, GREY, LOOKS, ORANGE, open_figure

_LEAST = 1e-4
"""Percent; what is smaller is exact for every purpose, and drawn as a hollow marker on the edge."""
_NOISE_LOOKS = ((GREY, "o"), (BLUE, "s"), (ORANGE, "^"), (GREEN, "D"), *LOOKS[3:])


def draw_comparison(path: Path, comparison: Comparison) -> Path:
    """Median error of the worst coefficient: a row a method, best above, a marker a noise or a number of speeds.

    The number of speeds has a panel where there are several. A method without an answer has words in its row.
    """
    panels: list[tuple[str, list[Case], str]] = []
    noise = comparison.along("noise")
    for case in comparison.along("sensors"):
        cases = [Case(level.noise, case.sensors, case.speeds) for level in noise]
        panels.append((f"sensors: {SENSOR_TEXT[case.sensors]}, {case.speeds} speeds", cases, "noise"))
    main = comparison.main
    text = f"sensors: {SENSOR_TEXT[main.sensors]}, {100 * main.noise:g} % noise"
    if len(by_speeds := comparison.along("speeds")) > 1:
        panels.append((text, by_speeds, "speeds"))
    methods = _sort_methods(comparison)
    columns = 2 if len(panels) > 1 else 1
    rows = (len(panels) + columns - 1) // columns
    height = rows * (1.5 + 0.3 * len(methods))
    options: dict[str, Any] = {"sharey": True, "sharex": True}
    with open_figure(path, rows, columns, 3.2 + 4.3 * columns, height, **options) as axes:
        for ax, (title, cases, key) in zip(axes.flat, panels, strict=False):
            _draw_panel(ax, comparison, methods, cases, key)
            ax.set_title(title, loc="left")
        for ax in axes.flat[len(panels) :]:
            ax.set_visible(False)
    return path


def _sort_methods(comparison: Comparison) -> list[str]:
    """The methods by their error in the main case; those without an answer there last."""
    errors = {method: comparison.error(method, comparison.main) for method in comparison.methods}
    return sorted(errors, key=lambda method: (np.isnan(errors[method]), errors[method]))


def _draw_panel(ax: Any, comparison: Comparison, methods: Sequence[str], cases: Sequence[Case], key: str) -> None:
    for m, method in enumerate(methods):
        errors = np.array([comparison.error(method, case) for case in cases])
        if np.isnan(errors).all():
            ax.annotate("no answer", (0.02, m), xycoords=("axes fraction", "data"), va="center", fontsize=8, color=GREY)
            continue
        shown = np.maximum(errors[np.isfinite(errors)], _LEAST)
        ax.plot([shown.min(), shown.max()], [m, m], color=GREY, lw=0.8, zorder=1)
        for error, (colour, marker) in zip(errors, _NOISE_LOOKS, strict=False):
            fill = "white" if error < _LEAST else colour
            ax.plot(max(error, _LEAST), m, ls="", marker=marker, ms=7, color=colour, mfc=fill, clip_on=False)
    for case, (colour, marker) in zip(cases, _NOISE_LOOKS, strict=False):
        text = describe_case(case, key) + (" noise" if key == "noise" else "")
        ax.plot([], [], ls="", marker=marker, color=colour, label=text)
    ax.legend(loc="upper center", bbox_to_anchor=(0.5, -0.13), ncols=len(cases), fontsize=8, handletextpad=0.1)
    ax.set(xscale="log", yticks=range(len(methods)), ylim=(len(methods) - 0.5, -0.5))
    ax.set_yticklabels([METHODS[method].label for method in methods], fontsize=9)
    ax.set_xlim(left=_LEAST)
    ax.tick_params(labelbottom=True)
    ax.set_xlabel(f"median error of the worst coefficient (%); hollow: below {_LEAST:g}", fontsize=8)
