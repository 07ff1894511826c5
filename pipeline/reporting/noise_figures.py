"""Figure of a study over noise: the error of each data set, and how often the intervals hold."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from pipeline.reporting.figures import BLUE, GREY, ORANGE, figure

if TYPE_CHECKING:
    import pandas as pd


def noise_figure(path: Path, rows: pd.DataFrame) -> Path:
    """Above, the median error over speed of every data set; below, the share of speeds inside the 95 % interval."""
    groups = list(rows.groupby(["bearing_node", "coefficient"], sort=False))
    labels = [f"{name}\nnode {node}" for (node, name), _ in groups]
    generator = np.random.default_rng(0)
    with figure(path, 2, 1, max(6.0, 0.75 * len(groups) + 2), 6.0, sharex=True) as axes:
        for i, (_, group) in enumerate(groups):
            aside = i + generator.uniform(-0.25, 0.25, len(group))
            axes[0, 0].semilogy(aside, group["median_error_percent"], ls="", marker="o", ms=3, color=BLUE, alpha=0.5)
            axes[0, 0].semilogy(
                i, group["median_error_percent"].median(), ls="", marker="_", ms=18, mew=2, color=ORANGE
            )
            axes[1, 0].plot(i, group["within_95_percent_interval"].mean(), ls="", marker="s", ms=7, color=BLUE)
        axes[1, 0].axhspan(90, 98, color=GREY, alpha=0.15, lw=0)
        axes[1, 0].axhline(95, color=GREY, lw=1.0, ls="--")
        axes[1, 0].set_ylim(80, 100)
        axes[0, 0].set_ylabel("median error over speed (%)\none dot a data set")
        axes[1, 0].set_ylabel("inside the nominal\n95 % interval (%)")
        axes[1, 0].set_xticks(range(len(groups)), labels)
    return path
