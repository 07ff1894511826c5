"""The sections as one HTML page, with all that it needs inside: it opens offline, on a phone, and prints; and as a PDF.

Panels of the page are plotly's traces and layouts: plain dictionaries, which it hands to plotly in the browser. The PDF
has the same words and tables, and its figures are drawn by matplotlib. No browser is needed.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.files import render, write_beside, write_text
from pipeline.reporting.blocks import (
    GREY,
    MICROMETRES_PEAK_TO_PEAK,
    Block,
    Curve,
    Figure,
    HeatMap,
    Mark,
    Panel,
    Section,
    Table,
    count_decades,
    typeset,
)
from pipeline.reporting.matplotlib_figures import PANEL_WIDTH, draw_image, measure_heights

_NUMBER = re.compile(r"[-+–]?[\d.]*(e[-+]?\d+)?( ± [\d.]+)?( \*)?")
"""Columns of these are aligned to the right."""
_SYMBOLS = {"o": "circle", "s": "square", "^": "triangle-up", "D": "diamond", "v": "triangle-down", "x": "x-thin"}
_FONT = {"family": "system-ui, sans-serif", "size": 11, "color": "#222"}
_GRID = {
    "gridcolor": "#e4e4e4",
    "linecolor": GREY,
    "zeroline": False,
    "ticks": "outside",
    "ticklen": 3,
    "automargin": True,
}
_DASHES = {"solid": "", "dash": "6,4", "dashdot": "7,3,2,3", "dot": "2,3", "longdash": "9,3"}


_WIDTH = 186.0
"""mm of a page between its margins."""


def write_page(path: Path, title: str, head: Mapping[str, str], sections: Sequence[Section], paper: str = "A4") -> Path:
    """Write the page: ``head`` is the block below the ``title``, without its blank entries; it prints on ``paper``.

    Raises StorageError.
    """
    from plotly.offline import get_plotlyjs

    figures = [block for _, _, blocks in sections for block in blocks if isinstance(block, Figure)]
    every = [panel for figure in figures for panel in figure.panels]
    panels = {panel: _describe_panel(panel) | {"id": f"panel{i}"} for i, panel in enumerate(every)}
    return write_text(
        path,
        render(
            Path(__file__).with_name("page.html"),
            typeset=typeset,
            title=title,
            head=head,
            paper=paper,
            sections=sections,
            panels=panels,
            dashes=_DASHES,
            scale=MICROMETRES_PEAK_TO_PEAK,
            find_textual=_find_textual,
            plotly=get_plotlyjs().replace("</script", "<\\/script"),
            drawn=json.dumps(list(panels.values()), separators=(",", ":"), allow_nan=False).replace("<", "\\u003c"),
        ),
    )


def _find_textual(table: Table) -> list[bool]:
    """Which columns have more than numbers."""
    return [any(not _NUMBER.fullmatch(typeset(row[c])) for row in table.rows) for c in range(len(table.header))]


def _describe_panel(panel: Panel) -> dict[str, Any]:
    """``traces``, ``layout``, ``wide`` and what the page's choices of units act on."""
    margin, height = {"l": 8, "r": 14, "t": 34, "b": 8}, 335 if panel.equal else 290 + 110 * (len(panel.axes) - 1)
    if panel.round:
        traces, layout = _describe_polar(panel)
        margin, height = {"l": 40, "r": 40, "t": 62, "b": 24}, 335
    else:
        traces, layout = _describe_axes(panel)
    layout |= {
        "title": {"text": panel.title, "font": {"size": 13}, "x": 0.02, "xanchor": "left", "y": 0.97, "yanchor": "top"},
        "font": _FONT,
        "margin": margin,
        "paper_bgcolor": "#fff",
        "plot_bgcolor": "#fff",
        "showlegend": False,
        "hovermode": "closest",
    }
    return {"traces": traces, "layout": layout, "wide": panel.wide, "height": height}


def _describe_axes(panel: Panel) -> tuple[list[dict[str, Any]], dict[str, Any]]:
    traces: list[dict[str, Any]] = [] if panel.heat is None else [_describe_heat(panel.heat)]
    layout: dict[str, Any] = {"shapes": []}
    shown = [curve for axes in panel.axes for curve in axes.curves if curve.shown and len(curve.x)]
    bare = all(curve.dash == "none" and not curve.marker for curve in shown)  # plotly looks for no ends of bands alone
    ends = [f(np.concatenate([curve.x for curve in shown])) for f in (np.min, np.max)] if shown and bare else ()
    layout["xaxis"] = _describe_axis(
        panel.x_title, panel.x_names, panel.log_x, panel.x_range if len(panel.x_range) else ends
    )
    for i, (axes, domain) in enumerate(zip(panel.axes, _share(len(panel.axes)), strict=True)):
        suffix = "" if i == 0 else str(i + 1)
        y = _describe_axis(axes.y_title, axes.y_names, axes.scale == "log", axes.y_range) | {"domain": domain}
        if axes.scale == "log":
            y |= {
                "dtick": "D2" if count_decades([curve.y for curve in axes.curves]) < 1.5 else 1,
                "exponentformat": "power",
            }
        layout[f"yaxis{suffix}"] = y
        kind = {"amplitude": "xy" if panel.equal else "y"}.get(axes.quantity, axes.quantity)
        traces += [
            trace | {"xaxis": "x", "yaxis": f"y{suffix}"}
            for curve in axes.curves
            for trace in _describe_curve(curve, kind, panel.scales(axes), axes.scale == "log")
        ]
        look = {"type": "line", "yref": f"y{suffix} domain", "y0": 0, "y1": 1, "line": {"color": GREY, "dash": "dot"}}
        layout["shapes"] += [look | {"x0": at, "x1": at, "label": {"text": text}} for at, text in axes.rules]
    if len(panel.axes) > 1:
        layout["xaxis"]["anchor"] = f"y{len(panel.axes)}"
    if panel.equal:
        curves, scale = panel.axes[0].curves, panel.scales(panel.axes[0])[0]
        every = np.array([[f(np.concatenate([getattr(c, k) for c in curves])) for f in (np.min, np.max)] for k in "xy"])
        half = 0.55 * max(float(np.ptp(every, axis=1).max()), 1e-12)  # of x and y alike, around all curves
        for letter, middle in zip("xy", every.mean(axis=1), strict=True):
            layout[f"{letter}axis"] |= {"range": [(middle - half) * scale, (middle + half) * scale]}
    if panel.bare:
        layout["yaxis"] |= {"visible": False}
    return traces, layout


def _describe_axis(title: str, names: Sequence[str], logarithmic: bool, reach: Sequence[float]) -> dict[str, Any]:
    axis = _GRID | {"title": {"text": title, "standoff": 4}, "type": "log" if logarithmic else "linear"}
    if len(reach):
        axis["range"] = [float(np.log10(end)) if logarithmic else end for end in reach]
    return axis | ({"tickvals": list(range(len(names))), "ticktext": list(names)} if names else {})


def _share(count: int) -> list[list[float]]:
    """Domains from above to below: the first is the largest."""
    if count == 1:
        return [[0.0, 1.0]]
    lower = 0.66 / count
    edges = [[0.04 + lower * i, lower * (i + 1)] for i in range(count - 1)][::-1]
    edges[-1][0] = 0.0
    return [[edges[0][1] + 0.06, 1.0], *edges]


def _describe_curve(
    curve: Curve, kind: str, scales: tuple[float, float], logarithmic: bool = False
) -> list[dict[str, Any]]:
    """The line or the markers, and the area of the band; ``meta`` says what the page scales."""
    if not curve.shown or not len(curve.x):
        return []
    curve, (wide, high) = curve.thin(), scales
    about: dict[str, Any] = {"name": curve.label, "meta": kind}
    trace = about | _describe_look(curve) | {"hoverinfo": "skip" if curve.filled or not curve.label else "all"}
    if kind == "r":
        return [trace | {"type": "scatterpolar", "theta": _round(curve.x), "r": _round(high * curve.y)}]
    x, y = (scale * values[:: curve.every] for scale, values in ((wide, curve.x), (high, curve.y)))
    trace |= {"type": "scatter", "x": _round(x), "y": _round(y), "opacity": curve.alpha}
    trace |= {"fill": "toself", "fillcolor": _fade(curve.colour, 0.25)} if curve.filled else {}
    x, least, most = curve.edges(logarithmic)
    band = about | {"type": "scatter", "mode": "lines", "name": "", "line": {"width": 0}, "hoverinfo": "skip"}
    band |= {"fill": "toself", "fillcolor": _fade(curve.colour, 0.22 * curve.alpha)}
    band |= {"x": _round(wide * np.r_[x, x[::-1]]), "y": _round(high * np.r_[most, least[::-1]])}
    return [band, trace] if len(x) else [trace]


def _describe_look(curve: Curve) -> dict[str, Any]:
    symbol = _SYMBOLS.get(curve.marker, "circle") + ("" if curve.full or curve.marker in "x" else "-open")
    dash, marked = curve.dash if curve.dash != "none" else "solid", {"color": curve.colour, "symbol": symbol}
    drawn = ["lines"] * (curve.dash != "none") + ["markers"] * bool(curve.marker) + ["text"] * bool(curve.texts)
    return {
        "mode": "+".join(drawn) or "none",
        "line": {"color": curve.colour, "dash": dash, "width": curve.width},
        "marker": marked | {"size": 1.5 * curve.size, "line": {"color": curve.colour, "width": 1.3}},
        "text": list(curve.texts),
        "textposition": "top center",
        "textfont": {"size": 10, "color": curve.colour},
    }


def _describe_polar(panel: Panel) -> tuple[list[dict[str, Any]], dict[str, Any]]:
    angles = {"rotation": panel.polar, "direction": "clockwise", "gridcolor": "#e4e4e4", "ticksuffix": "°", "dtick": 45}
    radii = {"gridcolor": "#e4e4e4", "angle": panel.polar - panel.bare_lag, "nticks": 4, "tickfont": {"size": 9}}
    scales = panel.scales(panel.axes[0])
    traces = [trace for curve in panel.axes[0].curves for trace in _describe_curve(curve, "r", scales)]
    return traces, {"polar": {"angularaxis": angles, "radialaxis": radii, "bgcolor": "#fff"}}


def _describe_heat(heat: HeatMap) -> dict[str, Any]:
    return {
        "type": "heatmap",
        "x": _round(heat.x),
        "y": _round(heat.y),
        "z": [_round(row, 3) for row in heat.z],
        "colorscale": heat.colours.capitalize(),
        "colorbar": {"title": {"text": heat.title, "side": "right"}, "thickness": 12, "tickfont": {"size": 9}},
        "meta": "",
    }


def _round(values: np.ndarray, digits: int = 5) -> list[float | None]:
    return [float(f"{v:.{digits}g}") if np.isfinite(v) else None for v in np.asarray(values, dtype=float).tolist()]


def _fade(colour: str, alpha: float) -> str:
    red, green, blue = (int(colour[i : i + 2], 16) for i in (1, 3, 5))
    return f"rgba({red},{green},{blue},{alpha})"


def write_pdf(path: Path, title: str, head: Mapping[str, str], sections: Sequence[Section], paper: str = "A4") -> Path:
    """Write the PDF on pages of ``paper``. Raises StorageError."""
    import logging

    import matplotlib
    from fpdf import FPDF

    logging.getLogger("fontTools").setLevel(logging.ERROR)  # it tells of each table of a font
    pdf = FPDF(format=paper)
    pdf.set_margins((pdf.w - _WIDTH) / 2, 12)
    pdf.set_auto_page_break(True, 14)
    fonts = Path(matplotlib.get_data_path()) / "fonts" / "ttf"
    for style, name in (("", "DejaVuSans.ttf"), ("B", "DejaVuSans-Bold.ttf")):
        pdf.add_font("DejaVu", style, fonts / name)
    pdf.set_title(title)
    pdf.add_page()
    _write_text(pdf, title, 15, 8, bold=True)
    for name, text in ({**head, "units": "amplitudes are in µm pk-pk, phases are lags"}).items():
        if text:
            _write_text(pdf, f"{name.capitalize()}: {text}", 9, 5)
    for number, (_, name, blocks) in enumerate(sections, start=1):
        pdf.ln(3)
        if pdf.will_page_break(30 + next((height for block in blocks if (height := _ask_height(block))), 0.0)):
            pdf.add_page()
        pdf.set_font("DejaVu", "B", 12)
        pdf.start_section(f"{number}. {name}")
        _write_text(pdf, f"{number}. {name}", 12, 7, bold=True)
        for block in blocks:
            if isinstance(block, str | Mark):
                _write_text(pdf, typeset(block), 9, 4.6, bold=isinstance(block, Mark) and block.kind != "")
                pdf.ln(1)
            elif isinstance(block, Table):
                _write_table(pdf, block)
            else:
                _place_figure(pdf, block)
                _write_text(pdf, block.caption, 8, 4.2)
                pdf.ln(1)
    return write_beside(path, lambda beside: pdf.output(str(beside)))


def _ask_height(block: Block) -> float:
    """mm that stay on one page: a short table, the first rows of a long one or of a figure; zero of text."""
    return 12 + 4.4 * min(len(block.rows), 12) if isinstance(block, Table) else 80.0 * isinstance(block, Figure)


def _write_text(pdf: Any, text: str, size: float, height: float, bold: bool = False) -> None:
    """Lines of letters of a ``size`` (points), each of a ``height`` (mm)."""
    pdf.set_font("DejaVu", "B" if bold else "", size)
    pdf.multi_cell(0, height, text, align="L", new_x="LMARGIN", new_y="NEXT")


def _write_table(pdf: Any, table: Table, when_wide: int = 5) -> None:
    """The letters are smaller from so many columns on."""
    from fpdf.enums import TableBordersLayout

    if not table.rows:
        return
    pdf.ln(1)
    if pdf.will_page_break(_ask_height(table)):
        pdf.add_page()
    if table.caption:
        _write_text(pdf, typeset(table.caption), 9, 4.6, bold=True)
    pdf.set_font("DejaVu", "B", 6.5 if len(table.header) >= when_wide else 8)
    texts = [[typeset(cell) for cell in row] for row in (table.header, *table.rows)]
    columns = list(zip(*texts, strict=True))
    whole = np.array([max(map(pdf.get_string_width, column)) for column in columns]) + 3.0
    word = np.array([max(map(pdf.get_string_width, " ".join(column).split()), default=0.0) for column in columns]) + 3.0
    share = (min(_WIDTH, whole.sum()) - word.sum()) / max(whole.sum() - word.sum(), 1.0)
    widths = word + max(share, 0.0) * (whole - word)  # no narrower than a word
    pdf.set_font("DejaVu", "", pdf.font_size_pt)
    pdf.set_draw_color(170)
    with pdf.table(
        texts,
        col_widths=tuple(widths.tolist()),
        width=min(_WIDTH, float(widths.sum())),
        align="LEFT",
        borders_layout=TableBordersLayout.HORIZONTAL_LINES,
        line_height=3.9,
        text_align="LEFT",
    ):
        pass
    pdf.ln(1)


def _place_figure(pdf: Any, figure: Figure, dots_an_inch: int = 110) -> None:
    """Rows of panels one after the other, so that a page may end between them; the legend above the first of a page."""
    columns, scale = 1 if any(panel.wide for panel in figure.panels) else 2, _WIDTH / (2 * PANEL_WIDTH)
    for first in range(0, len(figure.panels), columns):
        row, legend = figure.panels[first : first + columns], [] if first else figure.legend()
        caption = 10.0 if first + columns >= len(figure.panels) else 0.0  # mm: it stays below its last row
        if pdf.will_page_break(scale * sum(measure_heights(row, legend, columns)) + caption):
            pdf.add_page()
            legend = figure.legend()
        height = scale * sum(measure_heights(row, legend, columns))
        pdf.image(draw_image(row, legend, columns, dots_an_inch), w=_WIDTH, h=height)
