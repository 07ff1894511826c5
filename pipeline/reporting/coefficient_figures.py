"""Coefficients over the speed: modelled as a line, identified as markers with bands; of conditions a line a state.

Legend: B bearings, S operating points.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np

from pipeline.coefficients import COEFFICIENTS, is_direct, unit
from pipeline.data.operating import space_evenly, split_states
from pipeline.data.sensors import NOMINAL_95
from pipeline.data.vibration_files import to_rpm
from pipeline.evaluation.errors import measure_relative_errors
from pipeline.problem.determination import find_lost
from pipeline.reporting.blocks import BLACK, GREY, LOOKS, NOTHING, RPM, Axes, Curve, Figure, Panel, mark
from pipeline.reporting.matplotlib_figures import write_figure
from pipeline.rotor.bearing_table import BearingTable

KINDS = {"k": "stiffness", "c": "damping"}
BAND = "95 % band (alone: not determined)"
UNITS = {"k": (1e-6, "MN/m"), "c": (1e-3, "kN s/m")}
"""What SI is multiplied by, and the name of the unit."""


@dataclass(frozen=True, eq=False)
class Coefficients:
    """An answer and what is known beside it."""

    identified: BearingTable  # with deviations, where the fit states some
    modelled: BearingTable | None  # the truth, where there is one
    unknowns: Sequence[Sequence[str]]  # of each bearing

    @cached_property
    def truth(self) -> np.ndarray:
        """(B, S, 8) N/m and N s/m; NaN where none is modelled."""
        return np.full_like(self.identified.values, np.nan) if self.modelled is None else self.modelled.values

    @property
    def compared(self) -> bool:
        """Whether the truth is known."""
        return bool(np.isfinite(self.truth).any())

    @property
    def stated(self) -> bool:
        """Whether the fit states deviations."""
        return bool(np.isfinite(self.identified.spread).any())

    @cached_property
    def lost(self) -> np.ndarray:
        """(B, S, 8) bool: where the data do not determine it."""
        return find_lost(self.identified)

    @property
    def rpm(self) -> np.ndarray:
        """(S,)."""
        return to_rpm(self.identified.speeds)

    def at(self, points: np.ndarray) -> Coefficients:
        """The same at these points."""
        return replace(self, identified=self.identified.at(points), modelled=self.modelled and self.modelled.at(points))

    def choose(self, letters: str) -> list[str]:
        """The coefficients of these letters (k, c) that are identified of any bearing."""
        named = {name for unknown in self.unknowns for name in unknown}
        return [name for name in COEFFICIENTS if name[0] in letters and name in named]

    def draw(
        self, b: int, name: str, label: str, look: tuple[str, str], scale: float, count: int = 15, line: bool = False
    ) -> list[Curve]:
        """The truth as a line, identified values with their nominal 95 % band as markers (or a ``line``).

        Where the data do not determine the coefficient the band is drawn alone, since the prior made what is in it.
        """
        c, (colour, marker) = COEFFICIENTS.index(name), look
        values, known = scale * self.identified.values[b, :, c], name not in self.unknowns[b]
        if known:
            return [Curve(self.rpm, values, f"{name} known, not identified", colour, "dash")] if values.any() else []
        deviation = scale * self.identified.spread[b, :, c]
        lost = self.lost[b, :, c]
        given = np.where(lost, np.nan, values)
        drawn = Curve(self.rpm, given, label, colour) if line else mark(self.rpm, given, label, colour, marker, count)
        if lost.all():
            drawn = Curve(NOTHING, NOTHING, label, colour, filled=True)  # with no marker, its key is the band
        key = [Curve(NOTHING, NOTHING, BAND, GREY, filled=True)] if np.isfinite(deviation).any() else []
        return [
            Curve(self.rpm, values, "", colour, "none", deviation=deviation),
            Curve(self.rpm, scale * self.truth[b, :, c], "modelled", BLACK, width=1.2),
            replace(drawn, marker="o" if len(values) == 1 else drawn.marker),
            *key,
        ]

    def measure_errors(self, b: int, name: str) -> np.ndarray:
        """(S,) percent of the modelled coefficient; NaN where that is zero or not known."""
        return measure_relative_errors(self.identified, replace(self.identified, values=self.truth), name)[b]

    def draw_errors(self, b: int, name: str, colour: str) -> list[Curve]:
        """The error in percent, and dotted the nominal 95 % interval."""
        c, error = COEFFICIENTS.index(name), self.measure_errors(b, name)
        with np.errstate(divide="ignore", invalid="ignore"):
            stated = 100 * NOMINAL_95 * self.identified.spread[b, :, c] / np.abs(self.truth[b, :, c])
        return [
            Curve(self.rpm, np.maximum(error, 1e-14), "", colour, width=1.2),
            Curve(self.rpm, stated, "", colour, "dot", width=1.2),
        ]


def draw_bearing(shown: Coefficients, b: int, letter: str, si: bool = False) -> Panel:
    """Every stiffness (``letter`` k) or damping (c) of a bearing; in SI with its error below where that is known."""
    scale, measured_in = (1.0, unit(letter)) if si else UNITS[letter]
    looks = dict(zip((name for name in COEFFICIENTS if name[0] == letter), LOOKS, strict=False))
    drawn = [name for name in looks if name in shown.unknowns[b] or is_direct(name)]
    curves = [curve for n in drawn for curve in shown.draw(b, n, f"{n} identified", looks[n], scale)]
    errors = [curve for n in drawn if n in shown.unknowns[b] for curve in shown.draw_errors(b, n, looks[n][0])]
    values = np.concatenate([curve.y for curve in curves] or [np.zeros(1)])
    scaled = "log" if si and np.nanmin(values, initial=np.inf) > 0 else "linear"
    axes = [Axes(curves, f"{KINDS[letter]} ({measured_in})", scale=scaled, y_range=clip_bands(curves, scaled == "log"))]
    if si and shown.compared and errors:
        stated = ", and nominal\n95 % (dotted)" if shown.stated else ""
        axes.append(Axes(errors, f"error{stated} (%)", scale="log"))
    return Panel(f"bearing at node {shown.identified.nodes[b]}", RPM, axes)


def clip_bands(curves: Sequence[Curve], logarithmic: bool) -> tuple[float, ...]:
    """Ends of an axis where bands of what is not determined would rule it: twice as wide as the values; else none."""
    values = np.concatenate([NOTHING, *(curve.y[np.isfinite(curve.y)] for curve in curves)])
    bands = np.concatenate([NOTHING, *(edge for curve in curves for edge in curve.edges(logarithmic)[1:])])
    low, high = (float(end(values, initial=start)) for end, start in ((np.min, np.inf), (np.max, -np.inf)))
    span = max(high - low, abs(low), abs(high))
    ends = (low / 10, 10 * high) if logarithmic else (low - span, high + span)
    return ends if (bands < ends[0]).any() or (bands > ends[1]).any() else ()


def draw_coefficients(path: Path, shown: Coefficients, letter: str = "") -> Path:
    """Every identified coefficient over the speed; with a ``letter`` (k or c) those alone, with their errors below.

    Markers are identified, bands nominal 95 % intervals, thin lines the modelled truth. With operating conditions it is
    a panel a coefficient and a line a state; else a row for stiffness and one for damping, a column a bearing, and with
    a ``letter`` Figures 3 (k) and 4 (c) of the paper, in SI. A direct coefficient that was not identified is drawn as
    the known line that it is.
    """
    bearings, columns = range(len(shown.identified.nodes)), 2
    if shown.identified.operating:
        panels = draw_state_panels(list_states(shown), letter or "kc", bool(letter))
        columns = min(4, len(panels))
    elif letter:
        panels = [draw_bearing(shown, b, letter, si=True) for b in bearings]
    else:
        panels, columns = [draw_bearing(shown, b, k) for k in "kc" if shown.choose(k) for b in bearings], len(bearings)
    return write_figure(path, Figure(letter or "identified", "", panels, columns))


def pick_states(speeds: np.ndarray, operating: Mapping[str, np.ndarray], most: int = 8) -> list[tuple[str, np.ndarray]]:
    """The states of points (S,); of more than ``most``, so many from the first to the last."""
    states = split_states(speeds, operating)
    return [states[i] for i in space_evenly(len(states), most)]


def colour_states(count: int) -> list[str]:
    """Colours from cold (blue) over purple to hot (orange), told apart in black and white by their lightness."""
    from matplotlib import colormaps
    from matplotlib.colors import to_hex

    return [to_hex(colormaps["plasma"](share)) for share in np.linspace(0.05, 0.8, count)]


def list_states(shown: Coefficients) -> list[tuple[str, Coefficients]]:
    """Name of each measured state, and the answer at its points."""
    return [
        (label, shown.at(points)) for label, points in pick_states(shown.identified.speeds, shown.identified.operating)
    ]


def draw_state_panels(
    states: Sequence[tuple[str, Coefficients]], letters: str, compared: bool, beside: str = ""
) -> list[Panel]:
    """A panel a coefficient of each bearing, a line a state; the last has the colour ``beside`` where that is given.

    ``compared`` adds the errors below. Where none of the ``letters`` was identified, the direct ones as they are known.
    """
    shown, colours = states[0][1], colour_states(len(states) - bool(beside)) + [beside] * bool(beside)
    names, compared = shown.choose(letters), compared and shown.compared
    known = [name for name in COEFFICIENTS if name[0] in letters and is_direct(name)] * (not names)
    panels = []
    for b, node in enumerate(shown.identified.nodes):
        for name in known or [name for name in names if name in shown.unknowns[b]]:
            (scale, measured_in), curves, errors = UNITS[name[0]], [], []
            for (label, state), colour in zip(states, colours, strict=True):
                answer = Coefficients(state.identified, None, [[name]] * (b + 1)) if known else state
                curves += answer.draw(b, name, label, (colour, "o"), scale, 12, line=not answer.compared)
                errors += answer.draw_errors(b, name, colour)
            axes = [Axes(curves, f"{name} ({measured_in})")]
            axes += [Axes(errors, "error (%)", scale="log")] if compared and not known else []
            panels.append(Panel(f"{name}, node {node}{', known' if known else ''}", RPM, axes))
    return panels
