"""The unbalance of every condition in each plane, polar, as a balancing engineer draws it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.balance.unbalance import Estimates
from pipeline.ingest.source_units import GRAM_MILLIMETRE, SourceUnits
from pipeline.reporting.figures import BLUE, GREY, ORANGE, open_figure

_NAMED = 12
"""Most conditions that carry their names in the figure."""


def draw_balance(path: Path, method: str, estimates: Estimates, planes: Sequence[int], source: SourceUnits) -> Path:
    """A panel a plane: estimates with the circle that holds 95 %, and lines from the known weights to them.

    Conditions that no unbalance explains, or that contradict their weights, have another colour.
    """
    values, known = source.weights(estimates.unbalance), source.weights(estimates.readings.unbalance)
    radius, remarked = estimates.radius / GRAM_MILLIMETRE, estimates.inconsistent | estimates.contradicted
    finite = np.where(np.isnan(known), 0.0, np.abs(known))
    reach = 1.15 * max(float(np.abs(values).max()), float(finite.max()), 1e-9)
    with open_figure(path, 1, len(planes), 6.2 * len(planes), 6.4) as axes:
        for n, node in enumerate(planes):
            ax = axes[0, n]
            _draw_grid(ax, reach)
            for c, name in enumerate(estimates.readings.names):
                colour = ORANGE if remarked[c] else BLUE
                _draw_circle(ax, values[c, n], min(radius[c, n], 4 * reach), colour)
                if not np.isnan(known[c, n]):
                    pair = np.array([known[c, n], values[c, n]])
                    ax.plot(pair.real, pair.imag, color=colour, lw=0.8)
                    ax.plot(known[c, n].real, known[c, n].imag, "+", color=GREY, ms=7)
                ax.plot(values[c, n].real, values[c, n].imag, "o", color=colour, ms=3.5)
                if remarked[c] or len(estimates.readings.names) <= _NAMED:
                    ax.annotate(name, (values[c, n].real, values[c, n].imag), (4, 4), textcoords="offset points")
            ax.set_title(f"plane at node {node}: g mm and angle on the shaft", loc="left")
        _describe(axes[0, 0], method, bool(remarked.any()), not np.isnan(known).all())
    return path


def _draw_grid(ax: Any, reach: float) -> None:
    ax.set(xlim=(-reach, reach), ylim=(-reach, reach), aspect="equal")
    ax.grid(False)
    ax.set_axis_off()
    turn = np.linspace(0, 2 * np.pi, 181)
    step = 10 ** np.floor(np.log10(reach / 2))
    step *= next(k for k in (1, 2, 5, 10) if reach / (k * step) <= 5)
    for size in np.arange(step, reach, step):
        ax.plot(size * np.cos(turn), size * np.sin(turn), color=GREY, lw=0.4, alpha=0.5)
        ax.annotate(f"{size:g}", (0, size), color=GREY, fontsize=8)
    for angle in np.radians(np.arange(0, 360, 45)):
        ax.plot([0, reach * np.cos(angle)], [0, reach * np.sin(angle)], color=GREY, lw=0.4, alpha=0.5)
        place = 0.97 * reach * np.array([np.cos(angle), np.sin(angle)])
        ax.annotate(f"{np.degrees(angle):.0f}°", place, color=GREY, fontsize=8, ha="center", va="center")


def _draw_circle(ax: Any, centre: complex, radius: float, colour: str) -> None:
    from matplotlib.patches import Circle

    ax.add_patch(Circle((centre.real, centre.imag), radius, facecolor=colour, edgecolor=colour, alpha=0.18, lw=0.6))


def _describe(ax: Any, method: str, remarked: bool, known: bool) -> None:
    ax.plot([], [], "o", color=BLUE, ms=3.5, label=f"from the vibration ({method}), 95 %")
    if known:
        ax.plot([], [], "+", color=GREY, ms=7, label="known weight")
    if remarked:
        ax.plot([], [], "o", color=ORANGE, ms=3.5, label="inconsistent, or contradicts its label")
    ax.figure.legend(loc="outside lower center", ncols=3)
