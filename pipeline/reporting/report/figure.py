"""A figure of the report as a value, which the page draws with plotly and the PDF with matplotlib.

Amplitudes are in m, zero-to-peak, and phases are lags in degrees: the page shows either in the reader's own unit.
"""

from __future__ import annotations

from dataclasses import KW_ONLY, dataclass

import numpy as np

from pipeline.reporting.figures import BLUE

MICROMETRES_PEAK_TO_PEAK, MICROMETRES = 2e6, 1e6
"""What an amplitude in m, zero-to-peak, and a place in m, are multiplied by, unless the reader chooses another unit."""
_MOST_POINTS = 300


@dataclass(frozen=True, eq=False)
class Curve:
    """Points (N,) that belong together, as a line, as markers or both.

    ``band`` (N,) is half the width of a filled band. ``dash`` is solid, dash, longdash, dot, dashdot or none. A
    ``filled`` curve is the outline of an area; ``words`` (N,) stand beside the points.
    """

    x: np.ndarray
    y: np.ndarray
    label: str = ""
    colour: str = BLUE
    dash: str = "solid"
    marker: str = ""
    _: KW_ONLY
    band: np.ndarray | None = None
    filled: bool = False
    words: tuple[str, ...] = ()
    width: float = 1.6
    named: bool = True  # in the legend

    def thin(self) -> Curve:
        """The same with at most about 300 points."""
        from dataclasses import replace

        every = -(-len(self.x) // _MOST_POINTS)
        if every <= 1 or self.filled:
            return self
        keep = np.unique(np.r_[0 : len(self.x) : every, len(self.x) - 1, int(np.nanargmax(np.nan_to_num(self.y)))])
        return replace(self, x=self.x[keep], y=self.y[keep], band=None if self.band is None else self.band[keep])


@dataclass(frozen=True, eq=False)
class Axes:
    """Curves over one pair of axes.

    ``amplitude``: y is one, in m (in an orbit x and y are places, in m); ``lag``: y is one, in degrees.
    """

    curves: tuple[Curve, ...]
    y_title: str
    _: KW_ONLY
    log: bool = False
    amplitude: bool = False
    lag: bool = False
    y_range: tuple[float, float] | None = None


@dataclass(frozen=True, eq=False)
class HeatMap:
    """Levels z (Y, X) over x (X,) and y (Y,)."""

    x: np.ndarray
    y: np.ndarray
    z: np.ndarray
    title: str


@dataclass(frozen=True, eq=False)
class Panel:
    """Axes one above the other that share x; or an orbit (``equal``), a polar plot, or a map of levels.

    ``polar`` is the angle (deg, from x towards y) at which a lag of zero is drawn: curves are lag (deg) and amplitude.
    """

    title: str
    x_title: str
    axes: tuple[Axes, ...]
    _: KW_ONLY
    equal: bool = False
    polar: float | None = None
    wide: bool = False
    bare: bool = False  # no axes, as in a sketch
    heat: HeatMap | None = None
    log_x: bool = False


@dataclass(frozen=True, eq=False)
class Figure:
    """Panels with one legend and one caption."""

    name: str
    caption: str
    panels: tuple[Panel, ...]

    def legend(self) -> list[Curve]:
        """The curves that the legend names, each label once."""
        every = [c for panel in self.panels for axes in panel.axes for c in axes.curves if c.label and c.named]
        return list({curve.label: curve for curve in every[::-1]}.values())[::-1]
