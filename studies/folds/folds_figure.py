"""Figure of methods on conditions that they have not seen: predicted vibration, and weights read from it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.reporting.figures import GREY, LOOKS, open_figure

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
    with open_figure(path, 1, 2, 11.0, 4.6) as axes:
        for ax, (key, label) in zip(axes[0], _PANELS.items(), strict=True):
            for m, (method, (colour, marker)) in enumerate(zip(methods, LOOKS, strict=False)):
                for chosen, face in (("all", "none"), ("consistent", colour)):
                    chosen_rows = [row for row in rows if row["method"] == method and row["conditions"] == chosen]
                    places = [tasks.index(row["task"]) + 0.12 * (m - (len(methods) - 1) / 2) for row in chosen_rows]
                    look = {"marker": marker, "mec": colour, "mfc": face, "ls": "", "ms": 7}
                    ax.plot(
                        places,
                        [row[key] for row in chosen_rows],
                        label=method if chosen == "consistent" else None,
                        **look,
                    )
            ax.set_xticks(np.arange(len(tasks)), [task.replace("_", "\n") for task in tasks])
            ax.set_yscale("log")
            ax.set_ylabel(label)
        axes[0, 0].axhspan(floor[0], floor[2], color=GREY, alpha=0.2, lw=0, label="drift alone, in folds (90 %)")
        entries = axes[0, 0].get_legend_handles_labels()
        axes[0, 0].figure.legend(*entries, loc="outside upper center", ncols=4)
    return path
