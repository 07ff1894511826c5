"""The sections as a PDF: the same words and tables, and the figures drawn by matplotlib. No browser is needed."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from pipeline.files import write_beside
from pipeline.reporting.figure import Figure
from pipeline.reporting.matplotlib_figures import PANEL_WIDTH, draw_image
from pipeline.reporting.tables import Mark, Section, Table, typeset

_WIDTH = 186.0
"""mm of a page between its margins."""


def write_pdf(path: Path, title: str, head: Sequence[str], sections: Sequence[Section]) -> Path:
    """Write the PDF on A4 pages. Raises StorageError."""
    import logging

    import matplotlib
    from fpdf import FPDF

    logging.getLogger("fontTools").setLevel(logging.ERROR)  # it tells of each table of a font
    pdf = FPDF(format="A4")
    pdf.set_margins(12, 12)
    pdf.set_auto_page_break(True, 14)
    fonts = Path(matplotlib.get_data_path()) / "fonts" / "ttf"
    for style, name in (("", "DejaVuSans.ttf"), ("B", "DejaVuSans-Bold.ttf")):
        pdf.add_font("DejaVu", style, fonts / name)
    pdf.set_title(title)
    pdf.add_page()
    _write_text(pdf, title, 15, 8, bold=True)
    for line in [*head, "Amplitudes are in µm pk-pk, phases are lags."]:
        _write_text(pdf, line, 9, 5)
    for number, (_, name, blocks) in enumerate(sections, start=1):
        pdf.ln(3)
        if pdf.will_page_break(30):
            pdf.add_page()
        pdf.set_font("DejaVu", "B", 12)
        pdf.start_section(f"{number}. {name}")
        _write_text(pdf, f"{number}. {name}", 12, 7, bold=True)
        for block in blocks:
            if isinstance(block, str | Mark):
                _write_text(pdf, typeset(block), 9, 4.6, bold=isinstance(block, Mark) and block.kind != "", align="L")
                pdf.ln(1)
            elif isinstance(block, Table):
                _write_table(pdf, block)
            else:
                _place_figure(pdf, block)
                _write_text(pdf, block.caption, 8, 4.2, align="L")
                pdf.ln(1)
    return write_beside(path, lambda beside: pdf.output(str(beside)))


def _write_text(pdf: Any, text: str, size: float, height: float, bold: bool = False, align: str = "J") -> None:
    """Lines of letters of a ``size`` (points), each of a ``height`` (mm)."""
    pdf.set_font("DejaVu", "B" if bold else "", size)
    pdf.multi_cell(0, height, text, align=align, new_x="LMARGIN", new_y="NEXT")


def _write_table(pdf: Any, table: Table, when_wide: int = 5) -> None:
    """The letters are smaller from so many columns on."""
    from fpdf.enums import TableBordersLayout

    if not table.rows:
        return
    pdf.ln(1)
    if pdf.will_page_break(18):
        pdf.add_page()
    _write_text(pdf, typeset(table.caption), 9, 4.6, bold=True, align="L")
    pdf.set_font("DejaVu", "", 6.5 if len(table.header) >= when_wide else 8)
    texts = [[typeset(cell) for cell in row] for row in (table.header, *table.rows)]
    widths = [max(4.0, min(70.0, 1.0 + max(len(row[c]) for row in texts))) for c in range(len(table.header))]
    pdf.set_draw_color(170)
    with pdf.table(
        texts,
        col_widths=tuple(widths),
        width=min(_WIDTH, 2.6 * sum(widths)),
        align="LEFT",
        borders_layout=TableBordersLayout.HORIZONTAL_LINES,
        line_height=3.9,
        text_align="LEFT",
    ):
        pass
    pdf.ln(1)


def _place_figure(pdf: Any, figure: Figure, dots_an_inch: int = 110) -> None:
    """Rows of panels one after the other, so that a page may end between them; the legend above the first."""
    columns = 1 if any(panel.wide for panel in figure.panels) else 2
    for first in range(0, len(figure.panels), columns):
        legend = figure.legend() if first == 0 else []
        image, height = draw_image(figure.panels[first : first + columns], legend, columns, dots_an_inch)
        shown = _WIDTH * height / (2 * PANEL_WIDTH)
        if pdf.will_page_break(shown):
            pdf.add_page()
        pdf.image(image, w=_WIDTH, h=shown)
