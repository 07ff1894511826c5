"""Figure of a multirun: what each job came to."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pipeline.reporting.figures import BLUE, ORANGE, open_figure

_PANELS = {
    "held_out_loss": ("loss on held-out speeds", BLUE),
    "loss": ("loss", BLUE),
    "worst_mean_error_percent": ("largest mean error, %", ORANGE),
}


def draw_jobs(path: Path, jobs: Mapping[str, Mapping[str, Any]]) -> Path:
    """Draw a row for each job, and a panel for its loss (of held-out speeds where there are some) and its error."""
    names = [name for name in _PANELS if any(_is_drawn(job.get(name)) for job in jobs.values())]
    names = [name for name in names if name != "loss" or "held_out_loss" not in names] or ["loss"]
    height = 1.4 + 0.35 * len(jobs)
    with open_figure(path, 1, len(names), 3.0 + 3.5 * len(names), height, sharey=True) as axes:
        for ax, name in zip(axes.flat, names, strict=True):
            label, colour = _PANELS[name]
            values = [(place, job[name]) for place, job in enumerate(jobs.values()) if _is_drawn(job.get(name))]
            ax.plot([value for _, value in values], [place for place, _ in values], "o", color=colour)
            if values:
                ax.set_xscale("log")
            ax.set_xlabel(label)
            ax.set_yticks(range(len(jobs)), list(jobs))
            ax.set_ylim(len(jobs) - 0.5, -0.5)
    return path


def _is_drawn(value: Any) -> bool:
    """On a logarithmic axis."""
    return isinstance(value, float) and value > 0
