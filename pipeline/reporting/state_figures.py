"""Coefficients over speed and operating conditions: a panel a coefficient, a line a state, cold to hot."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.coefficients import COEFFICIENTS, is_direct
from pipeline.data.noise import NOMINAL_95
from pipeline.data.operating import split_states
from pipeline.data.vibration_files import to_rpm
from pipeline.reporting.figures import BLACK, draw_markers, open_figure
from pipeline.reporting.identified_figure import UNITS
from pipeline.rotor.bearing_table import BearingTable

MOST_STATES = 8
"""Lines a panel; of more states, so many from the first to the last."""
_MARKERS = 12
_COLUMNS = 4


@dataclass(frozen=True, eq=False)
class _Drawn:
    """What a panel needs of all bearings."""

    identified: BearingTable
    modelled: BearingTable | None
    deviation: np.ndarray | None  # (B, S, 8)
    states: Sequence[tuple[str, np.ndarray]]
    colours: Sequence[str]


def pick_states(speeds: np.ndarray, operating: Mapping[str, np.ndarray]) -> list[tuple[str, np.ndarray]]:
    """The states of points (S,), or ``MOST_STATES`` of them where there are more."""
    states = split_states(speeds, operating)
    keep = np.unique(np.linspace(0, len(states) - 1, min(len(states), MOST_STATES)).round().astype(int))
    return [states[i] for i in keep]


def colour_states(count: int) -> list[str]:
    """Colours from cold (blue) over purple to hot (orange), told apart in black and white by their lightness."""
    from matplotlib import colormaps
    from matplotlib.colors import to_hex

    return [to_hex(colormaps["plasma"](share)) for share in np.linspace(0.05, 0.8, count)]


def draw_states(
    path: Path,
    identified: BearingTable,
    modelled: BearingTable | None,
    unknowns: Sequence[Sequence[str]],
    deviation: np.ndarray | None,
    letter: str | None = None,
) -> Path:
    """Every identified coefficient over the speed, at each state; ``unknowns`` are those of each bearing.

    Markers are identified, bands (of ``deviation``, (B, S, 8)) nominal 95 % intervals, thin lines the modelled truth.
    With a ``letter`` (k or c) it is those alone, with the error of each in percent below it; where none of them was
    identified, the direct ones as they are known.
    """
    names = [name for name in COEFFICIENTS if letter in (None, name[0])]
    places = [(b, name) for b, unknown in enumerate(unknowns) for name in names if name in unknown]
    if not places:
        places = [(b, name) for b in range(len(unknowns)) for name in names if is_direct(name)]
        modelled = deviation = None
    states = pick_states(identified.speeds, identified.operating)
    drawn = _Drawn(identified, modelled, deviation, states, colour_states(len(states)))
    below = letter is not None and modelled is not None
    columns = min(_COLUMNS, len(places))
    rows, each = -(-len(places) // columns), 2 if below else 1
    options: dict[str, Any] = {"sharex": True, "height_ratios": [2.0, 1.0] * rows if below else [1.0] * rows}
    width, height = max(3.6 * columns, 7.5), 1.0 + rows * (3.6 if below else 2.5)
    with open_figure(path, each * rows, columns, width, height, **options) as axes:
        for i, (b, name) in enumerate(places):
            row, column = each * (i // columns), i % columns
            known = "" if name in unknowns[b] else ", known"
            _draw_values(axes[row, column], drawn, b, name, f"{name}, node {identified.nodes[b]}{known}")
            if below:
                _draw_error(axes[row + 1, column], drawn, b, name)
        for ax in axes.flat:
            if not ax.lines:
                ax.set_axis_off()
        for ax in axes[-1]:
            ax.set_xlabel("rotor speed (rpm)")
        _place_legend(axes, drawn)
    return path


def _draw_values(ax: Any, drawn: _Drawn, b: int, name: str, title: str) -> None:
    c, (scale, unit) = COEFFICIENTS.index(name), UNITS[name[0]]
    rpm = to_rpm(drawn.identified.speeds)
    for (_, points), colour in zip(drawn.states, drawn.colours, strict=True):
        values = scale * drawn.identified.values[b, points, c]
        if drawn.deviation is not None:
            reach = NOMINAL_95 * scale * drawn.deviation[b, points, c]
            ax.fill_between(rpm[points], values - reach, values + reach, color=colour, alpha=0.3, lw=0)
        if drawn.modelled is not None:
            ax.plot(rpm[points], scale * drawn.modelled.values[b, points, c], color=BLACK, lw=0.8)
            draw_markers(ax, rpm[points], values, colour, count=_MARKERS)
        else:
            ax.plot(rpm[points], values, color=colour, lw=1.6, marker="o" if len(points) == 1 else None)
    ax.set_title(title, fontsize=10)
    ax.set_ylabel(f"{name} ({unit})")


def _draw_error(ax: Any, drawn: _Drawn, b: int, name: str) -> None:
    """The error in percent, and dotted the nominal 95 % interval."""
    assert drawn.modelled is not None
    c, rpm = COEFFICIENTS.index(name), to_rpm(drawn.identified.speeds)
    for (_, points), colour in zip(drawn.states, drawn.colours, strict=True):
        true = drawn.modelled.values[b, points, c]
        with np.errstate(divide="ignore", invalid="ignore"):
            error = 100.0 * np.abs(drawn.identified.values[b, points, c] / true - 1.0)
            ax.semilogy(rpm[points], np.maximum(error, 1e-14), color=colour, lw=1.1)
            if drawn.deviation is not None:
                stated = 100.0 * NOMINAL_95 * drawn.deviation[b, points, c] / np.abs(true)
                ax.semilogy(rpm[points], stated, color=colour, lw=1.0, ls=":")
    ax.set_ylabel("error (%)")


def _place_legend(axes: np.ndarray, drawn: _Drawn) -> None:
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    marked = drawn.modelled is not None
    look: dict[str, Any] = {"ls": "", "marker": "o", "mfc": "none"} if marked else {"lw": 1.6}
    handles: list[Any] = [Line2D([], [], color=colour, **look) for colour in drawn.colours]
    labels = [label for label, _ in drawn.states]
    if marked:
        handles.append(Line2D([], [], color=BLACK, lw=0.8))
        labels.append("modelled")
    if drawn.deviation is not None:
        handles.append(Patch(facecolor=BLACK, alpha=0.2))
        labels.append("nominal 95 %")
    axes[0, 0].figure.legend(handles, labels, loc="outside upper center", ncols=6)
