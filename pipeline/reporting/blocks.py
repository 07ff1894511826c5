"""What is shown, as values: figures, tables and sentences, alike on the terminal, in Markdown, on the page, in the PDF.

A figure is panels of curves over axes with units, in colour-blind safe colours. Matplotlib draws it for PNG files and
the PDF (``matplotlib_figures``), plotly for the page (``report.files``). What is modelled is a line, what is identified
markers. What has no finite number is neither drawn nor named.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import KW_ONLY, dataclass, field, replace
from typing import NamedTuple, TypeAlias

import numpy as np

from pipeline.data.sensors import NOMINAL_95
from pipeline.write_numbers import write_number

# Okabe and Ito's palette.
BLUE, ORANGE, GREEN, PURPLE, SKY, GREY = "#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#555555"
YELLOW, BLACK = "#E69F00", "#000000"
LOOKS = ((BLUE, "o"), (ORANGE, "s"), (GREEN, "^"), (PURPLE, "D"), (SKY, "v"), (GREY, "x"), (YELLOW, "P"), (BLACK, "*"))
"""Colours and markers of the curves that share a panel."""
DASHES = ("solid", "dash", "dashdot", "dot")
RPM = "rotor speed (rpm)"
MICROMETRES = 1e6
"""What a place in m is multiplied by, unless the reader chooses another unit."""
MICROMETRES_PEAK_TO_PEAK = 2e6
"""What an amplitude in m, zero-to-peak, is multiplied by, unless the reader chooses another unit."""
NOTHING = np.empty(0)


@dataclass(frozen=True, eq=False)
class Curve:
    """Points (N,) that belong together, as a line, as markers or both; one without points is a key of the legend alone.

    ``deviation`` (N,) is the standard deviation of y, drawn as its nominal 95 % band. ``dash`` is solid, dash,
    longdash, dot, dashdot or none. A ``filled`` curve is the outline of an area; ``texts`` (N,) stand beside the
    points. Markers are open, or ``full``, one at each ``every`` points.
    """

    x: np.ndarray
    y: np.ndarray
    label: str = ""
    colour: str = BLUE
    dash: str = "solid"
    marker: str = ""
    _: KW_ONLY
    deviation: np.ndarray = field(default_factory=lambda: NOTHING)
    every: int = 1
    filled: bool = False
    full: bool = False
    texts: Sequence[str] = ()
    width: float = 1.6
    size: float = 4.0
    alpha: float = 1.0

    @property
    def shown(self) -> bool:
        """Whether there is a finite number to draw, or the curve is a key of the legend."""
        return not len(self.y) or bool(np.isfinite(self.y).any())

    def thin(self, most: int = 300) -> Curve:
        """The same line with at most about so many points, the highest and the last among them; all markers."""
        every = -(-len(self.x) // most)
        if every <= 1 or self.filled or self.dash == "none":
            return self
        keep = np.unique(np.r_[0 : len(self.x) : every, len(self.x) - 1, int(np.nanargmax(np.nan_to_num(self.y)))])
        deviation = self.deviation[keep] if len(self.deviation) else self.deviation
        return replace(self, x=self.x[keep], y=self.y[keep], deviation=deviation)

    def edges(self, logarithmic: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """x and both ends of the 95 % band where they are known; over a logarithmic axis never down to zero.

        The one place that makes a band of a deviation for the eye.
        """
        x, y = self.x[: len(self.deviation)], self.y[: len(self.deviation)]
        known = np.isfinite(self.deviation) & np.isfinite(y)
        x, y, half = x[known], y[known], NOMINAL_95 * self.deviation[known]
        return x, np.where(logarithmic & (y > 0) & (y <= half), 1e-3 * y, y - half), y + half


def reach(values: np.ndarray, share: float = 0.02) -> tuple[float, float]:
    """The least and the largest of the finite ``values``, but where few lie far off no farther than quantiles allow.

    Beyond a ``share`` of them at either end it is no farther than the others are wide.
    """
    finite = values[np.isfinite(values)] if np.isfinite(values).any() else np.zeros(1)
    low, high = np.quantile(finite, [share, 1 - share])
    return max(float(finite.min()), 2 * low - high), min(float(finite.max()), 2 * high - low)


def mark_beyond(curves: Sequence[Curve], low: float, high: float) -> list[Curve]:
    """A cross at the end of the axis, from ``low`` to ``high``, for each point of the curves that lies beyond it."""
    crosses = []
    for curve in curves:
        x, y = curve.x[:: curve.every], curve.y[:: curve.every]
        off = (y < low) | (y > high)
        if off.any():
            crosses.append(Curve(x[off], np.clip(y[off], low, high), "beyond the axis", curve.colour, "none", "x"))
    return crosses


def mark(
    x: np.ndarray,
    y: np.ndarray,
    label: str,
    colour: str,
    marker: str = "o",
    count: int = 30,
    deviation: np.ndarray = NOTHING,
) -> Curve:
    """About ``count`` open markers of a curve, as many as can be told apart, over its whole band."""
    return Curve(x, y, label, colour, "none", marker, deviation=deviation, every=max(1, len(x) // count))


def shade(x: np.ndarray, low: np.ndarray, high: np.ndarray, colour: str, label: str = "", alpha: float = 1.0) -> Curve:
    """The area over x (N,) between two lines."""
    return Curve(np.r_[x, x[::-1]], np.r_[high, low[::-1]], label, colour, "none", filled=True, alpha=alpha)


@dataclass(frozen=True, eq=False)
class Axes:
    """Curves over one pair of axes.

    ``scale`` is linear or log. ``quantity`` is ``amplitude`` (y is one, in m, zero-to-peak; in an orbit x and y
    are places, in m) or ``lag`` (y is one, in degrees): the page shows either in the reader's own unit. ``y_names``
    stand at 0, 1, ... from above to below; ``rules`` are vertical lines with words.
    """

    curves: Sequence[Curve]
    y_title: str
    _: KW_ONLY
    scale: str = "linear"
    quantity: str = ""
    y_range: Sequence[float] = ()
    y_names: Sequence[str] = ()
    rules: Sequence[tuple[float, str]] = ()


def count_decades(values: Sequence[np.ndarray]) -> float:
    """How many powers of ten the positive numbers among these span."""
    every = np.concatenate([NOTHING, *map(np.abs, values)])
    every = every[np.isfinite(every) & (every > 0)]
    return float(np.log10(every.max() / every.min())) if len(every) else 0.0


@dataclass(frozen=True, eq=False)
class HeatMap:
    """Levels z (Y, X) over x (X,) and y (Y,); ``colours`` is a colour map of matplotlib, ``reach`` its ends."""

    x: np.ndarray
    y: np.ndarray
    z: np.ndarray
    title: str
    colours: str = "cividis"
    reach: tuple[float | None, float | None] = (None, None)


@dataclass(frozen=True, eq=False)
class Panel:
    """Axes one above the other that share x; or an orbit (``equal``), a polar plot, or a map of levels.

    ``polar`` is the angle (deg, from x towards y) at which a lag of zero is drawn: curves are lag (deg) and amplitude.
    ``x_names`` stand at 0, 1, ...; ``legend`` says that the panel has one of its own.
    """

    title: str
    x_title: str
    axes: Sequence[Axes]
    _: KW_ONLY
    equal: bool = False
    polar: float = float("nan")
    wide: bool = False
    bare: bool = False  # no axes, as in a sketch
    heat: HeatMap | None = None
    log_x: bool = False
    x_range: Sequence[float] = ()
    x_names: Sequence[str] = ()
    legend: bool = False

    @property
    def round(self) -> bool:
        """Whether the panel is a polar plot."""
        return not np.isnan(self.polar)

    def scales(self, axes: Axes) -> tuple[float, float]:
        """What x and y of the ``axes`` are multiplied by, unless the reader chooses another unit."""
        place = MICROMETRES if self.equal else MICROMETRES_PEAK_TO_PEAK
        scale = place if axes.quantity == "amplitude" else 1.0
        return (scale if self.equal else 1.0), scale

    @property
    def bare_lag(self) -> float:
        """Where a polar plot has room for its scale, deg of lag: between two spokes, away from the curves."""
        lags = np.arange(22.5, 360, 45)
        near = [np.maximum(np.cos(np.radians(lags[:, None] - c.x)), 0) ** 4 @ c.y for c in self.axes[0].curves]
        return float(lags[np.sum(near, axis=0).argmin()])


def list_keys(panels: Sequence[Panel]) -> list[Curve]:
    """The curves of panels that a legend names, each label once, the first of them."""
    curves = [curve for panel in panels for axes in panel.axes for curve in axes.curves if curve.label and curve.shown]
    return list({curve.label: curve for curve in curves[::-1]}.values())[::-1]


@dataclass(frozen=True, eq=False)
class Figure:
    """Panels in ``columns``, with one legend and one caption."""

    name: str
    caption: str
    panels: Sequence[Panel]
    columns: int = 2

    def legend(self) -> list[Curve]:
        """What the legend of all panels names, but of those that have their own."""
        return list_keys([panel for panel in self.panels if not panel.legend])


@dataclass(frozen=True)
class Amplitude:
    """A cell with an amplitude in m, zero-to-peak, which the page shows in the reader's unit; else in µm pk-pk."""

    value: float
    deviation: float = 0.0

    def __str__(self) -> str:
        """In µm, peak-to-peak."""
        scale = MICROMETRES_PEAK_TO_PEAK
        return write_number(scale * self.value, scale * self.deviation or None)


@dataclass(frozen=True)
class Mark:
    """Text with a look: a cell is ``good``, ``with care`` or ``no``, a paragraph a ``warning`` (or none)."""

    kind: str
    text: str

    def __str__(self) -> str:
        """The words alone."""
        return self.text


Cell = str | Amplitude | Mark


class Table(NamedTuple):
    """Rows below a header; ``caption`` says what they are, and their units where the header does not."""

    caption: str
    header: Sequence[str]
    rows: Sequence[Sequence[Cell]]

    def without_blank(self) -> Table:
        """The same without the columns in which nothing stands; all of them where there is no row."""
        keep = [c for c in range(len(self.header)) if not self.rows or any(str(row[c]) for row in self.rows)]
        return Table(self.caption, [self.header[c] for c in keep], [[row[c] for c in keep] for row in self.rows])


def format_markdown(header: Sequence[str], rows: Sequence[Sequence[Cell]]) -> str:
    """Write a table as Markdown, for a file."""
    lines = ["| " + " | ".join(map(str, cells)) + " |\n" for cells in (header, *rows)]
    return "".join([lines[0], "|" + "---|" * len(header) + "\n", *lines[1:]])


Block: TypeAlias = str | Mark | Table | Figure
"""A paragraph is one or more sentences."""
Section: TypeAlias = tuple[str, str, Sequence[Block]]
"""A part of the report: its name in links, its title, and what stands in it."""


def typeset(text: object) -> str:
    """What the terminal says, as a page prints it."""
    return re.sub(r"\bum\b", "µm", str(text).replace("+-", "±"))
