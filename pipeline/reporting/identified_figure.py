"""One picture of what was identified: stiffness and damping of every bearing over speed, with their bands."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.coefficients import COEFFICIENTS
from pipeline.data.noise import NOMINAL_95
from pipeline.data.vibration_files import to_rpm
from pipeline.reporting.figures import BLACK, KINDS, LOOKS, draw_markers, open_figure
from pipeline.rotor.bearing_table import BearingTable

UNITS = {"k": (1e-6, "MN/m"), "c": (1e-3, "kN s/m")}
"""What SI is multiplied by, and the name of the unit."""
_MARKERS = 14


def draw_identified(
    path: Path,
    identified: BearingTable,
    modelled: BearingTable | None,
    unknowns: Sequence[Sequence[str]],
    deviation: np.ndarray | None,
) -> Path:
    """A row for stiffness and one for damping, a column a bearing; ``unknowns`` are those of each bearing.

    Markers are identified, bands (of ``deviation``, (B, S, 8)) nominal 95 % intervals, thin lines the modelled truth.
    """
    named = {name for unknown in unknowns for name in unknown}
    rows = [letter for letter in "kc" if any(name[0] == letter for name in named)]
    width = max(5.4 * len(identified.nodes), 7.0)
    with open_figure(path, len(rows), len(identified.nodes), width, 1.1 + 3.3 * len(rows), sharex=True) as axes:
        for r, letter in enumerate(rows):
            names = [name for name in COEFFICIENTS if name[0] == letter]
            for b, node in enumerate(identified.nodes):
                for name, look in zip(names, LOOKS, strict=False):
                    if name in unknowns[b]:
                        _draw(axes[r, b], b, name, look, (identified, modelled, deviation))
                axes[0, b].set_title(f"bearing at node {node}")
                axes[-1, b].set_xlabel("rotor speed (rpm)")
            axes[r, 0].set_ylabel(f"{KINDS[letter]} ({UNITS[letter][1]})")
        _place_legend(axes, modelled is not None, deviation is not None)
    return path


def _draw(
    ax: Any,
    b: int,
    name: str,
    look: tuple[str, str],
    tables: tuple[BearingTable, BearingTable | None, np.ndarray | None],
) -> None:
    identified, modelled, deviation = tables
    c, scale, rpm = COEFFICIENTS.index(name), UNITS[name[0]][0], to_rpm(identified.speeds)
    values = scale * identified.values[b, :, c]
    if modelled is not None:
        ax.plot(rpm, scale * modelled.values[b, :, c], color=BLACK, lw=0.9)
    if deviation is not None:
        reach = NOMINAL_95 * scale * deviation[b, :, c]
        ax.fill_between(rpm, values - reach, values + reach, color=look[0], alpha=0.3, lw=0)
    draw_markers(ax, rpm, values, look[0], name, look[1], _MARKERS)


def _place_legend(axes: np.ndarray, modelled: bool, band: bool) -> None:
    """One legend for all: kxx and cxx share their look, and so on."""
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    together: dict[Any, list[str]] = {}
    for ax in axes.flat:
        for handle, name in zip(*ax.get_legend_handles_labels(), strict=True):
            names = together.setdefault((handle.get_markeredgecolor(), handle.get_marker()), [])
            names += [name] if name not in names else []
    handles: list[Any] = [Line2D([], [], ls="", marker=look[1], mfc="none", mec=look[0]) for look in together]
    labels = [", ".join(sorted(names, reverse=True)) for names in together.values()]
    if modelled:
        handles.append(Line2D([], [], color=BLACK, lw=0.9))
        labels.append("modelled")
    if band:
        handles.append(Patch(facecolor=BLACK, alpha=0.2))
        labels.append("nominal 95 %")
    axes[0, 0].figure.legend(handles, labels, loc="outside upper center", ncols=6)
