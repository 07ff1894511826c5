"""Figure of what the data determine before a fit: the deviation of each coefficient, and condition numbers."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np

from pipeline.coefficients import COEFFICIENTS
from pipeline.data.vibration_files import to_rpm
from pipeline.problem.determination import WEAKLY_BELOW, WELL_BELOW
from pipeline.problem.identifiability import Identifiability, Solvability
from pipeline.reporting.figures import BLUE, GREEN, GREY, LOOKS, ORANGE, YELLOW, open_figure

_LARGEST_CONDITION = 1e16
"""Where an infinite condition number is drawn."""
_LARGEST_DEVIATION = 1e5
"""Percent; what is larger is off the figure."""


def draw_diagnosis(
    path: Path,
    reports: Sequence[Identifiability],
    relative: Callable[[int], Mapping[str, np.ndarray]],
    noise: str,
) -> Path:
    """Deviation of each coefficient over speed that the ``noise`` implies; below it the condition number.

    ``relative`` gives, for the node of a bearing, the standard deviation (S,) over the coefficient by its name. Shades
    are the limits of well, weakly and not determined. A speed with several operating conditions has their median.
    """
    ratios = {"height_ratios": [1.8, 1.0]}
    width = 5.4 * len(reports)
    with open_figure(path, 2, len(reports), width, 7.0, sharex=True, sharey="row", gridspec_kw=ratios) as axes:
        for above, below, report in zip(*axes, reports, strict=True):
            speeds, groups = np.unique(report.speeds, return_inverse=True)
            rpm, several = to_rpm(speeds), len(speeds) < len(groups)
            known = " without noise" if report.verdict is not Solvability.NOT_IDENTIFIABLE else ""
            above.set_title(f"{report.where}:\n{report.verdict.value}{known}")
            for name, values in relative(report.nodes[0]).items():
                colour = LOOKS[COEFFICIENTS.index(name) % 4][0]
                drawn = _take_medians(np.where(np.isfinite(values), 100 * values, np.nan), groups)
                if not np.isnan(drawn).all():
                    above.semilogy(rpm, drawn, color=colour, ls="-" if name[0] == "k" else "--", lw=1.6, label=name)
            if not above.lines:
                above.text(0.5, 0.5, "free: no finite deviation", transform=above.transAxes, ha="center", color=GREY)
            for condition, look in ((report.condition, (BLUE, "-")), (report.orbit_condition, (GREY, "--"))):
                label = "of the equations for the coefficients" if look[0] == BLUE else "of the orbits"
                drawn = _take_medians(np.minimum(condition, _LARGEST_CONDITION), groups)
                below.semilogy(rpm, drawn, color=look[0], ls=look[1], label=label)
            below.set_xlabel("rotor speed (rpm)")
        _shade_verdicts(axes[0])
        over = "\nmedian over the operating conditions" if several else ""
        axes[0, 0].set_ylabel(f"standard deviation at\n{noise} (% of the coefficient){over}")
        axes[1, 0].set_ylabel("condition number (-)")
        axes[1, 0].legend(fontsize=8)
        handles = {label: line for ax in axes[0] for line, label in zip(*ax.get_legend_handles_labels(), strict=True)}
        axes[0, 0].figure.legend(handles.values(), handles.keys(), loc="outside upper center", ncols=8)
    return path


def _take_medians(values: np.ndarray, groups: np.ndarray) -> np.ndarray:
    """(U,) medians of the ``values`` (S,) at each different speed; ``of`` (S,) says which it is."""
    order, counts = np.argsort(groups, kind="stable"), np.bincount(groups)
    return np.array([np.median(group) for group in np.split(values[order], np.cumsum(counts)[:-1])])


def _shade_verdicts(axes: np.ndarray) -> None:
    """Shades behind the deviations (%): well determined, weakly, and not; what no reading tells is cut off above."""
    low, high = axes[0].get_ylim()
    low, high = min(low, 1.0), min(max(high, 100.0), _LARGEST_DEVIATION)
    edges = (low, 100 * WELL_BELOW, 100 * WEAKLY_BELOW, high)
    shades = (("well determined", GREEN), ("weakly", YELLOW), ("not determined", ORANGE))
    for ax in axes:
        for (verdict, colour), start, stop in zip(shades, edges, edges[1:], strict=False):
            ax.axhspan(start, stop, color=colour, alpha=0.10, lw=0, zorder=0)
            place = {"transform": ax.get_yaxis_transform(), "ha": "right", "va": "top", "fontsize": 8, "color": GREY}
            ax.text(0.99, 0.9 * stop, verdict, **place)
        ax.set_ylim(low, high)
