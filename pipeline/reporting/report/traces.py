"""Panels as plotly's traces and layouts: plain dictionaries, which the page hands to plotly in the browser."""

from __future__ import annotations

from typing import Any

import numpy as np

from pipeline.reporting.figures import GREY
from pipeline.reporting.report.figure import MICROMETRES, MICROMETRES_PEAK_TO_PEAK, Axes, Curve, HeatMap, Panel

_SYMBOLS = {
    "o": "circle-open",
    "s": "square-open",
    "^": "triangle-up-open",
    "D": "diamond-open",
    "v": "triangle-down-open",
}
_FONT = {"family": "system-ui, sans-serif", "size": 11, "color": "#222"}
_GRID = {
    "gridcolor": "#e4e4e4",
    "linecolor": GREY,
    "zeroline": False,
    "ticks": "outside",
    "ticklen": 3,
    "automargin": True,
}


def describe_panel(panel: Panel) -> dict[str, Any]:
    """``traces``, ``layout``, ``wide`` and what the page's choices of units act on."""
    if panel.polar is not None:
        traces, layout = _describe_polar(panel)
    elif panel.heat is not None:
        traces, layout = _describe_heat(panel, panel.heat)
    else:
        traces, layout = _describe_axes(panel)
    layout |= {
        "title": {"text": panel.title, "font": {"size": 13}, "x": 0.02, "xanchor": "left", "y": 0.97, "yanchor": "top"},
        "font": _FONT,
        "margin": {"l": 40, "r": 40, "t": 62, "b": 24}
        if panel.polar is not None
        else {"l": 8, "r": 14, "t": 34, "b": 8},
        "paper_bgcolor": "#fff",
        "plot_bgcolor": "#fff",
        "showlegend": False,
        "hovermode": "closest",
    }
    return {"traces": traces, "layout": layout, "wide": panel.wide, "height": _height(panel)}


def _height(panel: Panel) -> int:
    if panel.equal or panel.polar is not None:
        return 335
    return 290 + 110 * (len(panel.axes) - 1)


def _describe_axes(panel: Panel) -> tuple[list[dict[str, Any]], dict[str, Any]]:
    layout: dict[str, Any] = {"xaxis": _GRID | {"title": {"text": panel.x_title, "standoff": 4}}}
    if panel.log_x:
        layout["xaxis"]["type"] = "log"
    traces: list[dict[str, Any]] = []
    places = _share(len(panel.axes))
    for i, (axes, domain) in enumerate(zip(panel.axes, places, strict=True)):
        suffix = "" if i == 0 else str(i + 1)
        y = _GRID | {"title": {"text": axes.y_title, "standoff": 4}, "domain": domain}
        if axes.log:
            y |= {"type": "log", "dtick": "D2" if _decades(axes) < 1.5 else 1, "exponentformat": "power"}
        if axes.y_range is not None:
            y["range"] = [float(np.log10(v)) if axes.log else v for v in axes.y_range]
        layout[f"yaxis{suffix}"] = y
        kind = ("xy" if panel.equal else "y") if axes.amplitude else "lag" if axes.lag else ""
        for curve in axes.curves:
            traces += [trace | {"xaxis": "x", "yaxis": f"y{suffix}"} for trace in _describe_curve(curve, kind)]
    if len(panel.axes) > 1:
        layout["xaxis"]["anchor"] = f"y{len(panel.axes)}"
    if panel.equal:
        size = _reach(panel) * (MICROMETRES if panel.axes[0].amplitude else 1.0)
        for letter, (low, high) in zip("xy", size, strict=True):
            layout[f"{letter}axis"] |= {"range": [low, high]}
    if panel.bare:
        layout["yaxis"] |= {"visible": False}
    return traces, layout


def _share(count: int) -> list[list[float]]:
    """Domains from above to below: the first is the largest."""
    if count == 1:
        return [[0.0, 1.0]]
    lower = 0.66 / count
    edges = [[0.04 + lower * i, lower * (i + 1)] for i in range(count - 1)][::-1]
    edges[-1][0] = 0.0
    return [[edges[0][1] + 0.06, 1.0], *edges]


def _reach(panel: Panel) -> np.ndarray:
    """(2, 2) from and to of x and y, equally long, around all curves."""
    ends = np.array(
        [[f(np.concatenate([getattr(c, k) for c in panel.axes[0].curves])) for f in (np.min, np.max)] for k in "xy"]
    )
    half = 0.55 * max(float(np.ptp(ends, axis=1).max()), 1e-12)
    return np.asarray(ends.mean(axis=1)[:, None] + half * np.array([-1.0, 1.0]))


def _decades(axes: Axes) -> float:
    values = np.concatenate([np.abs(curve.y) for curve in axes.curves] or [np.ones(1)])
    values = values[np.isfinite(values) & (values > 0)]
    return float(np.log10(values.max() / values.min())) if len(values) else 0.0


def _describe_curve(curve: Curve, kind: str) -> list[dict[str, Any]]:
    curve = curve.thin()
    scale_x = MICROMETRES if kind == "xy" else 1.0
    scale_y = {"y": MICROMETRES_PEAK_TO_PEAK, "xy": MICROMETRES}.get(kind, 1.0)
    traces = []
    if curve.band is not None:
        traces += _describe_band(curve, kind, scale_y)
    line, mark = curve.dash != "none", bool(curve.marker)
    trace: dict[str, Any] = {
        "type": "scatter",
        "mode": "+".join(["lines"] * line + ["markers"] * mark + ["text"] * bool(curve.words)) or "none",
        "x": _round(curve.x * scale_x),
        "y": _round(curve.y * scale_y),
        "name": curve.label,
        "meta": kind,
        "hoverinfo": "skip" if curve.filled or not curve.label else "all",
    }
    if line:
        trace["line"] = {"color": curve.colour, "dash": curve.dash, "width": curve.width}
    if mark:
        symbol = _SYMBOLS.get(curve.marker, "x-thin" if curve.marker == "x" else "circle")
        trace["marker"] = {
            "color": curve.colour,
            "symbol": symbol,
            "size": 6,
            "line": {"color": curve.colour, "width": 1.3},
        }
    if curve.words:
        trace |= {"text": list(curve.words), "textposition": "top center", "textfont": {"size": 10}}
    if curve.filled:
        trace |= {"fill": "toself", "fillcolor": _fade(curve.colour, 0.25)}
    return [*traces, trace]


def _describe_band(curve: Curve, kind: str, scale: float) -> list[dict[str, Any]]:
    """The area between the ends of the band, where they are known."""
    assert curve.band is not None
    known = np.isfinite(curve.band) & np.isfinite(curve.y)
    x, low, high = curve.x[known], (curve.y - curve.band)[known] * scale, (curve.y + curve.band)[known] * scale
    if not len(x):
        return []
    low = np.where((curve.y[known] > 0) & (low <= 0), 1e-3 * high, low)  # on a logarithmic axis too
    area = {"type": "scatter", "mode": "lines", "x": _round(np.r_[x, x[::-1]]), "y": _round(np.r_[high, low[::-1]])}
    look = {"fill": "toself", "fillcolor": _fade(curve.colour, 0.22), "line": {"width": 0}, "hoverinfo": "skip"}
    return [area | look | {"meta": kind, "name": ""}]


def _describe_polar(panel: Panel) -> tuple[list[dict[str, Any]], dict[str, Any]]:
    traces = []
    for curve in panel.axes[0].curves:
        thin = curve.thin()
        trace: dict[str, Any] = {
            "type": "scatterpolar",
            "mode": "lines" if thin.dash != "none" else "markers+text",
            "theta": _round(thin.x),
            "r": _round(thin.y * MICROMETRES_PEAK_TO_PEAK),
            "name": thin.label,
            "meta": "r",
            "hoverinfo": "all" if thin.label else "skip",
            "line": {"color": thin.colour, "dash": thin.dash if thin.dash != "none" else "solid", "width": thin.width},
            "marker": {"color": thin.colour, "size": 4},
        }
        if thin.words:
            trace |= {"text": list(thin.words), "textposition": "top center", "textfont": {"size": 9}}
        traces.append(trace)
    polar = {
        "angularaxis": {
            "rotation": panel.polar,
            "direction": "clockwise",
            "gridcolor": "#e4e4e4",
            "ticksuffix": "°",
            "dtick": 45,
        },
        "radialaxis": {"gridcolor": "#e4e4e4", "angle": 0, "nticks": 4, "tickfont": {"size": 9}},
        "bgcolor": "#fff",
    }
    return traces, {"polar": polar}


def _describe_heat(panel: Panel, heat: HeatMap) -> tuple[list[dict[str, Any]], dict[str, Any]]:
    trace = {
        "type": "heatmap",
        "x": _round(heat.x),
        "y": _round(heat.y),
        "z": [_round(row, 3) for row in heat.z],
        "colorscale": "Cividis",
        "colorbar": {"title": {"text": heat.title, "side": "right"}, "thickness": 12, "tickfont": {"size": 9}},
        "meta": "",
    }
    axes = {
        "xaxis": _GRID | {"title": {"text": panel.x_title}},
        "yaxis": _GRID | {"title": {"text": panel.axes[0].y_title}},
    }
    return [trace], axes


def _round(values: np.ndarray, digits: int = 5) -> list[float | None]:
    return [float(f"{v:.{digits}g}") if np.isfinite(v) else None for v in np.asarray(values, dtype=float).tolist()]


def _fade(colour: str, alpha: float) -> str:
    red, green, blue = (int(colour[i : i + 2], 16) for i in (1, 3, 5))
    return f"rgba({red},{green},{blue},{alpha})"
