"""The sections as a PDF: the same words and tables, and the figures drawn by matplotlib. No browser is needed."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from pipeline.files import write_beside
from pipeline.reporting.figure import Figure
from pipeline.reporting.matplotlib_figures import PANEL_WIDTH, draw_image
from pipeline.reporting.tables import Paragraph, Section, Table, typeset

_WIDTH = 186.0
"""mm of a page between its margins."""


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
                pdf.multi_cell(0, 4.6, typeset(block.text), align="L", **below)
                pdf.ln(1)
            elif isinstance(block, Table):
                _write_table(pdf, block)
            else:
                _place_figure(pdf, block)
                pdf.set_font("DejaVu", "", 8)
                pdf.multi_cell(0, 4.2, block.caption, align="L", **below)
                pdf.ln(1)
    return write_beside(path, lambda beside: pdf.output(str(beside)))


def _write_table(pdf: Any, table: Table, when_wide: int = 5) -> None:
    """The letters are smaller from so many columns on."""
    from fpdf.enums import TableBordersLayout

    if not table.rows:
        return
    pdf.ln(1)
    if pdf.will_page_break(18):
        pdf.add_page()
    pdf.set_font("DejaVu", "B", 9)
    pdf.multi_cell(0, 4.6, typeset(table.caption), align="L", new_x="LMARGIN", new_y="NEXT")
    pdf.set_font("DejaVu", "", 6.5 if len(table.header) >= when_wide else 8)
    texts = [[typeset(cell) for cell in row] for row in (table.header, *table.rows)]
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
