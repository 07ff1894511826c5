"""Figure of methods on conditions that they have not seen: predicted vibration, and weights read from it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.reporting.blocks import GREY, LOOKS, Axes, Curve, Figure, Panel, shade
from pipeline.reporting.matplotlib_figures import write_figure

_PANELS = {
    "forward_median_relative_error": "relative error of predicted vibration (-)",
    "inverse_magnitude_error_g_mm": "error of weights read from it (g mm)",
}


def draw_folds(path: Path, rows: Sequence[dict[str, Any]], floor: Sequence[float]) -> Path:
    """Both errors a task and method: filled without the conditions that contradict their labels, open with them.

    ``floor`` (lowest, median, highest) is what drift alone leaves of the relative error in folds.
    """
    tasks = list(dict.fromkeys(row["task"] for row in rows))
    methods = list(dict.fromkeys(row["method"] for row in rows))
    ends, (low, _, high) = np.array([-0.5, len(tasks) - 0.5]), floor
    drift = shade(ends, np.full(2, low), np.full(2, high), GREY, "drift alone, in folds (90 %)")
    panels: list[Panel] = []
    for quantity, label in _PANELS.items():
        curves = [] if panels else [drift]
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
