"""One HTML page of the sections, with all that it needs inside: it opens offline, on a phone, and prints."""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from pipeline.files import write_text
from pipeline.reporting.figure import Curve
from pipeline.reporting.plotly_panels import describe_panel
from pipeline.reporting.tables import (
    MICROMETRES_PEAK_TO_PEAK,
    Amplitude,
    Block,
    Cell,
    Mark,
    Paragraph,
    Section,
    Table,
    typeset,
)

_NUMBER = re.compile(r"[-+–]?[\d.]*(e[-+]?\d+)?( ± [\d.]+)?")
"""Columns of these are aligned to the right."""
_FOLDER = Path(__file__).parent
_DASH = {"solid": "", "dash": "6,4", "dashdot": "7,3,2,3", "dot": "2,3", "longdash": "9,3"}


def write_page(path: Path, title: str, head: Sequence[str], sections: Sequence[Section]) -> Path:
    """Write the page: ``head`` are lines below the ``title``. Raises StorageError."""
    from jinja2 import Environment, FileSystemLoader
    from plotly.offline import get_plotlyjs

    environment = Environment(loader=FileSystemLoader(_FOLDER), autoescape=True, trim_blocks=True, lstrip_blocks=True)
    panels: list[dict[str, Any]] = []
    shown = [
        {
            "anchor": section.anchor,
            "title": section.title,
            "blocks": [_describe_block(block, panels) for block in section.blocks],
        }
        for section in sections
    ]
    text = environment.get_template("page.html").render(
        title=title,
        head=head,
        sections=shown,
        style=_read("page.css"),
        script=_read("page.js"),
        plotly=get_plotlyjs().replace("</script", "<\\/script"),
        panels=json.dumps(panels, separators=(",", ":"), allow_nan=False).replace("</", "<\\/"),
    )
    return write_text(path, text)


def _read(name: str) -> str:
    return (_FOLDER / name).read_text(encoding="utf-8")


def _describe_block(block: Block, panels: list[dict[str, Any]]) -> dict[str, Any]:
    """What the template needs of a block; its panels are appended to ``panels``, which the script draws."""
    if isinstance(block, Paragraph):
        return {"kind": "paragraph", "text": typeset(block.text), "warning": block.warning}
    if isinstance(block, Table):
        rows = [[_describe_cell(cell) for cell in row] for row in block.rows]
        textual = [any(not _NUMBER.fullmatch(row[c]["text"]) for row in rows) for c in range(len(block.header))]
        header = list(zip(map(typeset, block.header), textual, strict=True))
        cells = [list(zip(row, textual, strict=True)) for row in rows]
        return {"kind": "table", "caption": typeset(block.caption), "header": header, "rows": cells}
    places = []
    for panel in block.panels:
        described = describe_panel(panel)
        places.append(
            {"id": f"panel{len(panels)}", "wide": panel.wide, "height": described["height"], "title": panel.title}
        )
        panels.append(described | {"id": places[-1]["id"]})
    legend = [_describe_key(curve) for curve in block.legend()]
    pairs = len(places) in (2, 4)
    return {
        "kind": "figure",
        "pairs": pairs,
        "name": block.name,
        "caption": block.caption,
        "panels": places,
        "legend": legend,
    }


def _describe_key(curve: Curve) -> dict[str, Any]:
    """What the template draws of a curve in the legend."""
    marker = "." if curve.full and curve.marker else curve.marker
    look = {"dash": _DASH.get(curve.dash), "marker": marker, "filled": curve.filled}
    return {"label": curve.label, "colour": curve.colour} | look


def _describe_cell(cell: Cell) -> dict[str, Any]:
    shown: dict[str, Any] = {"text": typeset(cell)}
    if isinstance(cell, Mark):
        return shown | {"mark": cell.kind.replace(" ", "-")}
    if isinstance(cell, Amplitude):
        value, deviation = (MICROMETRES_PEAK_TO_PEAK * size for size in (cell.value, cell.deviation))
        return shown | {"amplitude": value, "deviation": deviation or None}
    return shown
