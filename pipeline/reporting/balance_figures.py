"""Figures of balancing: unbalances in each plane, and errors of methods on conditions that they have not seen."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.reporting.figure import BLUE, GREY, LOOKS, NOTHING, ORANGE, Axes, Curve, Figure, Panel
from pipeline.reporting.matplotlib_figures import write_figure

if TYPE_CHECKING:
    from pipeline.balance.estimates import Estimates
    from pipeline.ingest.source_units import SourceUnits


def draw_balance(
    path: Path, method: str, estimates: Estimates, planes: Sequence[int], source: SourceUnits, most_names: int = 12
) -> Path:
    """The unbalance of every condition in each plane, polar, as a balancing engineer draws it.

    A panel a plane: estimates with the circle that holds 95 %, and lines from the known weights to them. Conditions
    that no unbalance explains, or that contradict their weights, have another colour, and always their names; the
    others have them where there are at most ``most_names``.
    """
    values, known = source.weights(estimates.unbalance), source.weights(estimates.readings.unbalance)
    radius, remarked = 1e6 * estimates.radius, estimates.inconsistent | estimates.contradicted
    names = estimates.readings.names
    reach = 1.15 * float(np.nanmax(np.abs([*values.ravel(), *known.ravel(), 1e-9])))
    turn, panels = np.exp(2j * np.pi * np.linspace(0, 1, 181)), []
    for n, node in enumerate(planes):
        curves = _draw_grid(reach)
        for c, name in enumerate(names):
            colour = ORANGE if remarked[c] else BLUE
            label = "inconsistent, or contradicts its label" if remarked[c] else f"from the vibration ({method}), 95 %"
            circle = values[c, n] + min(radius[c, n], 4 * reach) * turn
            pair = np.array([known[c, n], values[c, n]])
            texts = [name] if remarked[c] or len(names) <= most_names else []
            curves += [
                Curve(circle.real, circle.imag, "", colour, filled=True, width=0.8),
                Curve(pair.real, np.where(np.isnan(known[c, n]), np.nan, pair.imag), "", colour, width=1.0),
                Curve(pair[:1].real, pair[:1].imag, "known weight", GREY, "none", "+", size=7),
                Curve(pair[1:].real, pair[1:].imag, label, colour, "none", "o", full=True, texts=texts),
            ]
        title = f"plane at node {node}: g mm and angle on the shaft"
        panels.append(Panel(title, "", [Axes(curves, "")], equal=True, bare=True, wide=True))
    return write_figure(path, Figure("balance", "", panels, columns=1))


def _draw_grid(reach: float) -> list[Curve]:
    """Circles of equal size with their numbers, and rays every 45 degrees."""
    step = 10 ** np.floor(np.log10(reach / 2))
    step *= next(k for k in (1, 2, 5, 10) if reach / (k * step) <= 5)
    turn = np.exp(2j * np.pi * np.linspace(0, 1, 181))
    sizes, rays = np.arange(step, reach, step), reach * np.exp(0.25j * np.pi * np.arange(8))[:, None] * [0, 1]
    lines = (*(size * turn for size in sizes), *rays)
    curves = [Curve(line.real, line.imag, "", GREY, width=0.5, alpha=0.5) for line in lines]
    ends = 0.97 * rays[:, 1]
    angles = Curve(ends.real, ends.imag, "", GREY, "none", texts=[f"{angle}°" for angle in range(0, 360, 45)])
    return [*curves, angles, Curve(0 * sizes, sizes, "", GREY, "none", texts=[f"{size:g}" for size in sizes])]


_FOLDS = {
    "forward_median_relative_error": "relative error of predicted vibration (-)",
    "inverse_magnitude_error_g_mm": "error of weights read from it (g mm)",
}


def draw_folds(path: Path, rows: Sequence[dict[str, Any]], floor: Sequence[float]) -> Path:
    """Both errors a task and method: filled without the conditions that contradict their labels, open with them.

    ``floor`` (lowest, median, highest) is what drift alone leaves of the relative error in folds.
    """
    tasks = list(dict.fromkeys(row["task"] for row in rows))
    methods = list(dict.fromkeys(row["method"] for row in rows))
    ends, half = np.array([-0.5, len(tasks) - 0.5]), (floor[2] - floor[0]) / 2
    drift = Curve(ends, np.full(2, floor[0] + half), "", GREY, "none", band=np.full(2, half))
    key = Curve(NOTHING, NOTHING, "drift alone, in folds (90 %)", GREY, filled=True)
    panels: list[Panel] = []
    for quantity, label in _FOLDS.items():
        curves = [] if panels else [drift, key]
        for m, (method, (colour, marker)) in enumerate(zip(methods, LOOKS, strict=False)):
            for chosen in ("consistent", "all"):
                some = [row for row in rows if row["method"] == method and row["conditions"] == chosen]
                places = np.array([tasks.index(row["task"]) + 0.12 * (m - (len(methods) - 1) / 2) for row in some])
                look: dict[str, Any] = {"size": 6, "full": chosen == "consistent"}
                errors = np.array([row[quantity] for row in some], dtype=float)
                curves.append(Curve(places, errors, method if look["full"] else "", colour, "none", marker, **look))
        names = [task.replace("_", "\n") for task in tasks]
        panels.append(Panel("", "", [Axes(curves, label, scale="log")], x_names=names))
    return write_figure(path, Figure("folds", "", panels))
