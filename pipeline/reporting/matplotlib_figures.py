"""Figures drawn by matplotlib: a PNG of all panels, or a row of them for a page. Axes are placed by hand, for speed."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from textwrap import wrap
from typing import Any

import numpy as np

from pipeline.files import write_beside
from pipeline.reporting.blocks import (
    GREY,
    MICROMETRES_PEAK_TO_PEAK,
    Axes,
    Curve,
    Figure,
    HeatMap,
    Panel,
    count_decades,
    list_keys,
)
from pipeline.write_numbers import write_number

PANEL_WIDTH = 3.66  # inches
_DASHES: dict[str, Any] = {"longdash": (0, (8, 3)), "solid": "-", "dash": "--", "dashdot": "-.", "dot": ":", "none": ""}
_STYLE: dict[Any, Any] = {
    "font.size": 7.5,
    "axes.grid": True,
    "grid.alpha": 0.3,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "legend.frameon": False,
}


def write_figure(path: Path, figure: Figure, dots_an_inch: int = 160) -> Path:
    """Write a PNG of all panels, with legend and caption above. Raises StorageError."""
    from matplotlib import rc_context

    with rc_context(_STYLE):
        drawing = draw_panels(figure.panels, figure.legend(), figure.columns, dots_an_inch, figure.caption)
        return write_beside(path, drawing.savefig)


def write_panel(path: Path, panel: Panel) -> Path:
    """Write a PNG of one panel. Raises StorageError."""
    return write_figure(path, Figure("", "", [panel], columns=1))


def draw_image(panels: Sequence[Panel], legend: Sequence[Curve], columns: int, dots_an_inch: int) -> Any:
    """The picture of panels."""
    from matplotlib import rc_context
    from PIL import Image

    with rc_context(_STYLE):
        drawing = draw_panels(panels, legend, columns, dots_an_inch)
        drawing.canvas.draw()
        return Image.fromarray(np.asarray(drawing.canvas.buffer_rgba())[..., :3].copy())


def draw_panels(
    panels: Sequence[Panel], legend: Sequence[Curve], columns: int, dots_an_inch: int, caption: str = ""
) -> Any:
    """Matplotlib's figure of panels in so many ``columns``; a single column is as wide as two.

    Words are measured once: for the ``dots_an_inch`` that they are drawn with.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure as Drawing

    width = PANEL_WIDTH * max(columns, 2)
    each, lines = width / columns, wrap(caption, int(18 * width))
    above, edge = 0.14 * len(lines), 0.06
    rows = [panels[first : first + columns] for first in range(0, len(panels), columns)]
    heights = measure_heights(panels, legend, columns, edge)
    height, top = above + sum(heights), above + heights.pop(0)
    drawing = Drawing(figsize=(width, height), dpi=dots_an_inch)
    FigureCanvasAgg(drawing)
    for r, row in enumerate(rows):
        bottom = height - top - sum(heights[: r + 1])
        for i, panel in enumerate(row):
            left, below = _measure_margins(panel)
            lift = 0.42 if panel.round else 0.22 + 0.13 * (len(_wrap_title(panel)) - 1)  # for the angles around it
            box = np.array([i * each + left, bottom + below, each - left - 0.14, heights[r] - below - lift])
            _draw_panel(drawing, panel, box / [width, height, width, height])
    if lines:
        drawing.text(0.01, 1 - 0.05 / height, "\n".join(lines), va="top", fontsize=7)
    if legend:
        drawing.legend(
            handles=[_draw_key(curve) for curve in legend],
            loc="upper left",
            ncols=_count_across(columns),
            bbox_to_anchor=(0.0, 1 - (above + edge) / height),
            borderaxespad=0.1,
            fontsize=7,
        )
    return drawing


def measure_heights(panels: Sequence[Panel], legend: Sequence[Curve], columns: int, edge: float = 0.06) -> list[float]:
    """Inches of the legend, below the ``edge``, and of each row of panels."""
    rows = (panels[first : first + columns] for first in range(0, len(panels), columns))
    return [edge + 0.17 * -(-len(legend) // _count_across(columns)), *(max(map(_measure_height, row)) for row in rows)]


def _count_across(columns: int) -> int:
    """Keys of a legend side by side."""
    return max(4, 2 * columns)


def _measure_height(panel: Panel) -> float:
    """Inches of a panel with its title and the words below it."""
    inner = 1.9 + 0.9 * (len(panel.axes) - 1)
    if panel.equal or panel.round:
        inner = 4.4 if panel.wide else 2.2
    names = max(len(axes.y_names) for axes in panel.axes)
    title = 0.12 + 0.13 * len(_wrap_title(panel)) + 0.3 * panel.round
    return max(inner, 0.24 * names) + _measure_margins(panel)[1] + title


def _measure_margins(panel: Panel) -> tuple[float, float]:
    """Inches left of a panel and below it, for the words at its ticks: numbers of seven characters, and names."""
    longest = max([0, *(len(name) for axes in panel.axes for name in axes.y_names)])
    lines = 1 + max([0, *(name.count("\n") for name in panel.x_names)])
    widest = max([0, *(len(line) for name in panel.x_names for line in name.split("\n"))])
    below = 0.062 * widest + 0.08 * (lines - 1) if _is_turned(panel) else 0.12 * (lines - 1)
    titles = max(axes.y_title.count("\n") for axes in panel.axes)
    return max(0.7 + 0.12 * titles, 0.36 + 0.062 * longest), 0.42 + below


def _wrap_title(panel: Panel) -> list[str]:
    """The lines of a title above its panel."""
    return [line for text in panel.title.split("\n") for line in wrap(text, 110 if panel.wide else 54) or [""]]


def _is_turned(panel: Panel) -> bool:
    """Whether the names below a panel have no place side by side."""
    longest = [max(map(len, name.split("\n"))) for name in panel.x_names]
    return 0.06 * len(longest) * max([0, *longest]) > PANEL_WIDTH * (2 if panel.wide else 1)


def _draw_key(curve: Curve) -> Any:
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    if curve.filled:
        return Patch(facecolor=curve.colour, alpha=0.3, edgecolor=curve.colour, label=curve.label)
    look: dict[str, Any] = {"color": curve.colour, "ls": _DASHES[curve.dash], "marker": curve.marker or None}
    face = curve.colour if curve.full else "none"
    return Line2D([], [], mfc=face, ms=4, lw=min(0.8 * curve.width, 4), label=curve.label, **look)


def _draw_panel(drawing: Any, panel: Panel, box: np.ndarray) -> None:
    from matplotlib.ticker import MaxNLocator

    left, bottom, width, height = box
    if panel.round:
        ax = drawing.add_axes(tuple(box), projection="polar")
        ax.set_theta_offset(np.radians(panel.polar))
        ax.set_theta_direction(-1)
        for curve in panel.axes[0].curves:
            _draw_curve(ax, curve, (np.pi / 180, MICROMETRES_PEAK_TO_PEAK))
        ax.set_title(panel.title, fontsize=8, loc="left", x=-0.3, y=1.04)
        ax.tick_params(labelsize=6)
        ax.yaxis.set_major_locator(MaxNLocator(4))
        ax.set_rlabel_position(panel.bare_lag)
        return
    shares = np.array([1.5, *([1.0] * (len(panel.axes) - 1))])
    shares *= (1 - 0.04 * (len(shares) - 1)) / shares.sum()
    for i, axes in enumerate(panel.axes):
        ax = drawing.add_axes(
            (left, bottom + height * (1 - shares[: i + 1].sum() - 0.04 * i), width, height * shares[i])
        )
        if panel.heat is not None:
            _draw_heat(drawing, ax, panel.heat)
        _draw_axes(ax, axes, panel)
        if i == 0:
            top = ax
            ax.set_title("\n".join(_wrap_title(panel)), fontsize=8, loc="left", y=1.0)  # given, it is not looked for
        ax.tick_params(labelbottom=i == len(shares) - 1)
    ax.set_xlabel(panel.x_title, labelpad=1)
    if panel.legend:
        _draw_keys(top, [_draw_key(key) for key in list_keys([panel])])


def _draw_keys(ax: Any, keys: Sequence[Any], few: int = 6, columns: int = 2) -> None:
    """A legend inside: where the curves leave room, or above them if there are more than a ``few`` keys."""
    short = max(len(key.get_label()) for key in keys) < 25
    if len(keys) <= few:
        ax.legend(
            handles=keys, fontsize=6.5, ncols=columns if short else 1, frameon=True, fancybox=False, edgecolor="none"
        )
        return
    share = 0.07 * -(-len(keys) // columns)  # of the height
    scale = ax.yaxis.get_transform()
    low, high = scale.transform(ax.get_ylim())
    ax.set_ylim(top=scale.inverted().transform(low + (high - low) / (1 - share)))
    ax.legend(handles=keys, fontsize=6.5, ncols=columns, loc="upper left")


def _draw_axes(ax: Any, axes: Axes, panel: Panel, ticks_an_inch: float = 2.0) -> None:
    """Below an axis stand no more than ``ticks_an_inch``, room for numbers of five digits; whole ones below seeds."""
    if axes.scale == "log":
        _set_logarithmic(ax, "y", [curve.y for curve in axes.curves])
    if panel.log_x:
        _set_logarithmic(ax, "x", [curve.x for curve in axes.curves])
    else:
        inches = ax.get_position().width * ax.figure.get_figwidth()
        whole = all((curve.x % 1 == 0).all() for curve in axes.curves)
        ax.locator_params(axis="x", nbins=max(3, round(ticks_an_inch * inches)), integer=whole)
    for curve in axes.curves:
        _draw_curve(ax, curve, panel.scales(axes))
    for at, text in axes.rules:
        ax.axvline(at, color=GREY, lw=0.8, ls=":")
        ax.annotate(
            text,
            (at, 1),
            xycoords=("data", "axes fraction"),
            xytext=(3, -8),
            textcoords="offset points",
            color=GREY,
            fontsize=6.5,
        )
    ax.set_ylabel(axes.y_title, labelpad=2)
    if axes.y_names:
        ax.set_yticks(range(len(axes.y_names)), axes.y_names)
        ax.set_ylim(len(axes.y_names) - 0.5, -0.5)
    if panel.x_names:
        ax.set_xticks(
            range(len(panel.x_names)),
            panel.x_names,
            **{"rotation": 60, "ha": "right", "rotation_mode": "anchor"} if _is_turned(panel) else {},
        )
        ax.set_xlim(-0.5, len(panel.x_names) - 0.5)
    if len(axes.y_range):
        ax.set_ylim(*axes.y_range)
    if len(panel.x_range):
        ax.set_xlim(*panel.x_range)
    for axis, ends in ((ax.xaxis, ax.get_xlim()), (ax.yaxis, ax.get_ylim())):
        if axis.get_scale() == "linear" and not 1e-3 <= np.abs(ends).max() < 1e5:
            axis.set_major_formatter(_write_tick)
    if panel.equal:
        ax.set_aspect("equal", adjustable="datalim")
    if panel.bare:
        ax.yaxis.set_visible(False)
        ax.xaxis.set_visible(bool(panel.x_title))
        ax.spines[:].set_visible(False)
        ax.grid(False)


def _set_logarithmic(ax: Any, letter: str, values: Sequence[np.ndarray]) -> None:
    """Of few powers of ten, ticks between them, with plain numbers."""
    from matplotlib.ticker import LogLocator, NullFormatter

    ax.set(**{f"{letter}scale": "log"})
    if count_decades(values) < 2.5:
        axis = getattr(ax, f"{letter}axis")
        axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        axis.set_major_formatter(_write_tick)
        axis.set_minor_formatter(NullFormatter())


def _write_tick(value: float, _: int | None) -> str:
    """Powers of ten from 1e5 on and below 1e-4: longer numbers, or a power beside the axis, reach into the words.

    Matplotlib gives the place among the ticks beside it.
    """
    mantissa, power = f"{value:.3e}".split("e")
    return f"{float(mantissa):g}e{int(power)}" if abs(value) >= 1e5 else write_number(value)


def _draw_curve(ax: Any, curve: Curve, scales: tuple[float, float]) -> None:
    if not curve.shown or not len(curve.x):
        return
    x, y = (scale * values[:: curve.every] for scale, values in zip(scales, (curve.x, curve.y), strict=True))
    look: dict[str, Any] = {"color": curve.colour, "alpha": 0.25 * curve.alpha, "lw": 0}
    if curve.filled:
        ax.fill(x, y, **look)
    edges, low, high = curve.edges(ax.get_yscale() == "log")
    if len(edges):
        ax.fill_between(scales[0] * edges, scales[1] * low, scales[1] * high, **look)
    style: dict[str, Any] = {"ls": _DASHES[curve.dash], "marker": curve.marker or None, "ms": curve.size}
    style |= {"mfc": curve.colour if curve.full else "none", "alpha": curve.alpha, "lw": 0.75 * curve.width}
    ax.plot(x, y, color=curve.colour, clip_on=not curve.texts and not curve.full, **style)
    beside = {"xytext": (0, 3), "textcoords": "offset points", "ha": "center", "fontsize": 6, "color": curve.colour}
    for text, at_x, at_y in zip(curve.texts, x, y, strict=False):
        ax.annotate(text, (at_x, at_y), **beside)


def _draw_heat(drawing: Any, ax: Any, heat: HeatMap) -> None:
    drawn = ax.pcolormesh(
        heat.x,
        heat.y,
        heat.z,
        rasterized=True,
        cmap=heat.colours,
        vmin=heat.reach[0],
        vmax=heat.reach[1],
        shading="nearest",
    )
    ax.grid(False)
    if heat.title:
        drawing.colorbar(drawn, ax=ax, pad=0.02).set_label(heat.title, color=GREY)
