"""One HTML page of the sections, with all that it needs inside: it opens offline, on a phone, and prints."""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from pathlib import Path

from pipeline.files import write_text
from pipeline.reporting.figure import Figure
from pipeline.reporting.plotly_panels import describe_panel
from pipeline.reporting.tables import MICROMETRES_PEAK_TO_PEAK, Section, Table, typeset

_NUMBER = re.compile(r"[-+–]?[\d.]*(e[-+]?\d+)?( ± [\d.]+)?")
"""Columns of these are aligned to the right."""
_FOLDER = Path(__file__).parent
_DASHES = {"solid": "", "dash": "6,4", "dashdot": "7,3,2,3", "dot": "2,3", "longdash": "9,3"}


def write_page(path: Path, title: str, head: Sequence[str], sections: Sequence[Section]) -> Path:
    """Write the page: ``head`` are lines below the ``title``. Raises StorageError."""
    from jinja2 import Environment, FileSystemLoader
    from plotly.offline import get_plotlyjs

    environment = Environment(loader=FileSystemLoader(_FOLDER), autoescape=True, trim_blocks=True, lstrip_blocks=True)
    environment.filters["typeset"] = typeset
    figures = [block for section in sections for block in section.blocks if isinstance(block, Figure)]
    every = [panel for figure in figures for panel in figure.panels]
    panels = {panel: describe_panel(panel) | {"id": f"panel{i}"} for i, panel in enumerate(every)}
    text = environment.get_template("page.html").render(
        title=title,
        head=head,
        sections=sections,
        panels=panels,
        dashes=_DASHES,
        scale=MICROMETRES_PEAK_TO_PEAK,
        find_textual=_find_textual,
        style=_read("page.css"),
        script=_read("page.js"),
        plotly=get_plotlyjs().replace("</script", "<\\/script"),
        drawn=json.dumps(list(panels.values()), separators=(",", ":"), allow_nan=False).replace("</", "<\\/"),
    )
    return write_text(path, text)


def _read(name: str) -> str:
    return (_FOLDER / name).read_text(encoding="utf-8")


def _find_textual(table: Table) -> list[bool]:
    """Which columns have more than numbers."""
    columns = range(len(table.header))
    return [any(not _NUMBER.fullmatch(typeset(row[c])) for row in table.rows) for c in columns]
