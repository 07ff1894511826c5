"""The sections as a PDF: the same words and tables, and the figures drawn by matplotlib. No browser is needed."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.files import write_beside
from pipeline.reporting.figures import BLACK, GREY
from pipeline.reporting.report.figure import MICROMETRES, MICROMETRES_PEAK_TO_PEAK, Axes, Curve, Figure, HeatMap, Panel
from pipeline.reporting.report.section import Amplitude, Cell, Mark, Paragraph, Section, Table, write_number

_DASHES: dict[str, Any] = {"longdash": (0, (8, 3)), "solid": "-", "dash": "--", "dashdot": "-.", "dot": ":", "none": ""}
_WIDTH, _PANEL, _ROW, _DPI = 186.0, 3.66, 2.5, 110
"""mm of a page between its margins; inches of a panel and of a row of panels; dots an inch."""
_WHEN_WIDE = 5
"""Columns of a table from which on its letters are smaller."""


def write_pdf(path: Path, title: str, head: Sequence[str], sections: Sequence[Section]) -> Path:
    """Write the PDF on A4 pages. Raises StorageError."""
    import logging

    import matplotlib
    from fpdf import FPDF
    from fpdf.enums import XPos, YPos

    logging.getLogger("fontTools").setLevel(logging.ERROR)  # it tells of each table of a font
    pdf = FPDF(format="A4")
    pdf.set_margins(12, 12)
    pdf.set_auto_page_break(True, 14)
    fonts = Path(matplotlib.get_data_path()) / "fonts" / "ttf"
    for style, name in (("", "DejaVuSans.ttf"), ("B", "DejaVuSans-Bold.ttf")):
        pdf.add_font("DejaVu", style, fonts / name)
    pdf.set_title(title)
    pdf.add_page()
    below: Any = {"new_x": XPos.LMARGIN, "new_y": YPos.NEXT}
    pdf.set_font("DejaVu", "B", 15)
    pdf.multi_cell(0, 8, title, **below)
    pdf.set_font("DejaVu", "", 9)
    for line in [*head, "Amplitudes are in µm pk-pk, phases are lags."]:
        pdf.multi_cell(0, 5, line, **below)
    for number, section in enumerate(sections, start=1):
        pdf.ln(3)
        if pdf.will_page_break(30):
            pdf.add_page()
        pdf.set_font("DejaVu", "B", 12)
        pdf.start_section(f"{number}. {section.title}")
        pdf.multi_cell(0, 7, f"{number}. {section.title}", **below)
        for block in section.blocks:
            if isinstance(block, Paragraph):
                pdf.set_font("DejaVu", "B" if block.warning else "", 9)
                pdf.multi_cell(0, 4.6, block.text, align="L", **below)
                pdf.ln(1)
            elif isinstance(block, Table):
                _write_table(pdf, block)
            else:
                _place_figure(pdf, block)
                pdf.set_font("DejaVu", "", 8)
                pdf.multi_cell(0, 4.2, block.caption, align="L", **below)
                pdf.ln(1)
    return write_beside(path, lambda beside: pdf.output(str(beside)))


def _write_table(pdf: Any, table: Table) -> None:
    from fpdf.enums import TableBordersLayout

    if not table.rows:
        return
    pdf.ln(1)
    if pdf.will_page_break(18):
        pdf.add_page()
    pdf.set_font("DejaVu", "B", 9)
    pdf.multi_cell(0, 4.6, table.caption, align="L", new_x="LMARGIN", new_y="NEXT")
    pdf.set_font("DejaVu", "", 6.5 if len(table.header) >= _WHEN_WIDE else 8)
    texts = [list(table.header), *([_write_cell(cell) for cell in row] for row in table.rows)]
    widths = [max(4.0, min(70.0, 1.0 + max(len(row[c]) for row in texts))) for c in range(len(table.header))]
    layout: dict[str, Any] = {
        "borders_layout": TableBordersLayout.HORIZONTAL_LINES,
        "line_height": 3.9,
        "text_align": "LEFT",
    }
    pdf.set_draw_color(170)
    with pdf.table(col_widths=tuple(widths), width=min(_WIDTH, 2.6 * sum(widths)), align="LEFT", **layout) as drawn:
        for row in texts:
            line = drawn.row()
            for text in row:
                line.cell(text)
    pdf.ln(1)


def _write_cell(cell: Cell) -> str:
    if isinstance(cell, Mark):
        return cell.words
    if isinstance(cell, Amplitude):
        deviation = None if cell.deviation is None else MICROMETRES_PEAK_TO_PEAK * cell.deviation
        return write_number(MICROMETRES_PEAK_TO_PEAK * cell.value, deviation)
    return cell


def _place_figure(pdf: Any, figure: Figure) -> None:
    """Rows of panels one after the other, so that a page may end between them; the legend above the first."""
    wide = any(panel.wide for panel in figure.panels)
    columns = 1 if wide or (len(figure.panels) == 1 and figure.panels[0].wide) else 2
    for first in range(0, len(figure.panels), columns):
        row = figure.panels[first : first + columns]
        image, height = _draw_row(row, figure.legend() if first == 0 else [], columns)
        shown = _WIDTH * height / (_PANEL * 2)
        if pdf.will_page_break(shown):
            pdf.add_page()
        pdf.image(image, w=_WIDTH, h=shown)


def _draw_row(panels: Sequence[Panel], legend: Sequence[Curve], columns: int) -> tuple[Any, float]:
    """The picture of a row of panels, and its height in inches; axes are placed by hand, for speed."""
    from matplotlib import rc_context
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure as Drawing
    from PIL import Image

    width, lines = 2 * _PANEL, math.ceil(len(legend) / 4)
    top = 0.26 + 0.17 * lines
    deepest = max(len(panel.axes) for panel in panels)
    height = top + (
        _ROW + 0.4 if panels[0].equal else _ROW + 0.6 if panels[0].polar is not None else _ROW + 0.7 * (deepest - 1)
    )
    with rc_context(
        {"font.size": 7.5, "axes.grid": True, "grid.alpha": 0.3, "axes.spines.top": False, "axes.spines.right": False}
    ):
        drawing = Drawing(figsize=(width, height), dpi=_DPI)
        canvas = FigureCanvasAgg(drawing)
        for i, panel in enumerate(panels):
            left = (i * _PANEL + 0.58) / width
            right = (i * _PANEL + _PANEL - 0.14) / width if columns > 1 else 1 - 0.14 / width
            lift = 0.2 if panel.polar is not None else 0.0  # for the angles around it
            box = (left, 0.42 / height, right - left, 1 - (top + 0.42 + lift) / height)
            _draw_panel(drawing, panel, box)
        if legend:
            handles = [_draw_key(curve) for curve in legend]
            drawing.legend(handles=handles, loc="upper left", ncols=4, frameon=False, borderaxespad=0.1, fontsize=7)
        canvas.draw()
        return Image.fromarray(np.asarray(canvas.buffer_rgba())[..., :3].copy()), height


def _draw_key(curve: Curve) -> Any:
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    if curve.filled:
        return Patch(facecolor=curve.colour, alpha=0.3, edgecolor=curve.colour, label=curve.label)
    look: dict[str, Any] = {"color": curve.colour, "ls": _DASHES[curve.dash], "marker": curve.marker or None}
    return Line2D([], [], mfc="none", ms=4, lw=1.3, label=curve.label, **look)


def _draw_panel(drawing: Any, panel: Panel, box: tuple[float, float, float, float]) -> None:
    from matplotlib.ticker import MaxNLocator

    left, bottom, width, height = box
    if panel.polar is not None:
        ax = drawing.add_axes(box, projection="polar")
        ax.set_theta_offset(np.radians(panel.polar))
        ax.set_theta_direction(-1)
        for curve in (thick.thin() for thick in panel.axes[0].curves):
            _draw_curve(ax, curve, np.radians(curve.x), MICROMETRES_PEAK_TO_PEAK * curve.y)
        ax.set_title(panel.title, fontsize=8, loc="left", x=-0.3, y=1.04)
        ax.tick_params(labelsize=6)
        ax.yaxis.set_major_locator(MaxNLocator(4))
        return
    shares = [1.7, *([1.0] * (len(panel.axes) - 1))]
    top = bottom + height
    for i, axes in enumerate(panel.axes):
        share = (height - 0.03 * (len(shares) - 1)) * shares[i] / sum(shares)
        ax = drawing.add_axes((left, top - share, width, share))
        top -= share + 0.03
        if panel.heat is not None:
            _draw_heat(drawing, ax, panel.heat)
        _draw_axes(ax, axes, panel)
        if i == 0:
            ax.set_title(panel.title, fontsize=8, loc="left")
        if i == len(shares) - 1:
            ax.set_xlabel(panel.x_title, labelpad=1)
        else:
            ax.tick_params(labelbottom=False)


def _draw_axes(ax: Any, axes: Axes, panel: Panel) -> None:
    scale_x = MICROMETRES if axes.amplitude and panel.equal else 1.0
    scale_y = scale_x if panel.equal else MICROMETRES_PEAK_TO_PEAK if axes.amplitude else 1.0
    if axes.log:
        ax.set_yscale("log")
    for curve in (thick.thin() for thick in axes.curves):
        _draw_curve(ax, curve, scale_x * curve.x, scale_y * curve.y, scale_y)
    ax.set_ylabel(axes.y_title, labelpad=2)
    if axes.y_range is not None:
        ax.set_ylim(*axes.y_range)
    if panel.equal:
        ax.set_aspect("equal", adjustable="datalim")
    if panel.bare:
        ax.yaxis.set_visible(False)
        ax.grid(False)


def _draw_curve(ax: Any, curve: Curve, x: np.ndarray, y: np.ndarray, scale: float = 1.0) -> None:
    if curve.filled:
        ax.fill(x, y, facecolor=curve.colour, alpha=0.25, lw=0)
    if curve.band is not None:
        ax.fill_between(x, y - scale * curve.band, y + scale * curve.band, color=curve.colour, alpha=0.25, lw=0)
    fill = curve.colour if curve.marker == "." else "none"
    look = {"ls": _DASHES[curve.dash], "marker": curve.marker or None, "ms": 4, "mfc": fill}
    ax.plot(x, y, color=curve.colour, lw=0.75 * curve.width, clip_on=not curve.words, **look)
    for word, at_x, at_y in zip(curve.words, x, y, strict=False):
        ax.annotate(word, (at_x, at_y), xytext=(0, 3), textcoords="offset points", ha="center", fontsize=6, color=BLACK)


def _draw_heat(drawing: Any, ax: Any, heat: HeatMap) -> None:
    drawn = ax.pcolormesh(heat.x, heat.y, heat.z, cmap="cividis", shading="nearest", rasterized=True)
    ax.grid(False)
    bar = drawing.colorbar(drawn, ax=ax, pad=0.02)
    bar.set_label(heat.title, color=GREY)
