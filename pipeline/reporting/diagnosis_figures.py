"""Figures of what the data determine."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np

from pipeline.coefficients import COEFFICIENTS
from pipeline.data.vibration_files import to_rpm
from pipeline.problem.identifiability import Identifiability
from pipeline.reporting.figures import BLUE, GREEN, GREY, ORANGE, PURPLE, figure

_CEILING = 1e16
"""Where an infinite condition number is drawn."""


def diagnosis_figure(
    path: Path,
    reports: Sequence[Identifiability],
    relative: Callable[[int], Mapping[str, np.ndarray]],
    noise: str,
) -> Path:
    """Condition number over speed, and below it the deviation of each coefficient that the stated noise implies."""
    with figure(path, 2, len(reports), 5.4 * len(reports), 6.6, sharex=True, sharey="row") as axes:
        for a, report in enumerate(reports):
            rpm = to_rpm(report.speeds)
            above, below = axes[0, a], axes[1, a]
            above.semilogy(rpm, np.minimum(report.condition, _CEILING), color=BLUE, label="unknowns")
            above.semilogy(rpm, np.minimum(report.orbit_condition, _CEILING), color=GREY, ls="--", label="orbits")
            above.set_title(f"{report.where}:\n{report.verdict.value}")
            for name, values in relative(report.nodes[0]).items():
                colour = (BLUE, ORANGE, GREEN, PURPLE)[COEFFICIENTS.index(name) % 4]
                drawn = np.where(np.isfinite(values), 100 * values, np.nan)
                if not np.isnan(drawn).all():
                    below.semilogy(rpm, drawn, color=colour, ls="-" if name[0] == "k" else ":", lw=1.4, label=name)
            if not below.lines:
                below.text(0.5, 0.5, "free: no finite deviation", transform=below.transAxes, ha="center", color=GREY)
            below.axhline(100.0, color=GREY, lw=0.8)
            below.set_xlabel("rotor speed (rpm)")
        axes[0, 0].set_ylabel("condition number (-)")
        axes[0, 0].legend()
        axes[1, 0].set_ylabel(f"standard deviation at\n{noise} (% of the coefficient)")
        if axes[1, 0].lines[:-1]:
            axes[1, 0].legend(ncols=2, fontsize=8)
    return path
