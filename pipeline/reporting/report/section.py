"""A section of the report as a value: sentences, tables and figures, in order."""

from __future__ import annotations

from dataclasses import dataclass

from pipeline.reporting.figure import Figure
from pipeline.reporting.tables import Table


@dataclass(frozen=True)
class Paragraph:
    """One or more sentences; a ``warning`` stands out."""

    text: str
    warning: bool = False


Block = Paragraph | Table | Figure


@dataclass(frozen=True)
class Section:
    """A part of the report; ``anchor`` is its name in links."""

    anchor: str
    title: str
    blocks: tuple[Block, ...]


def typeset(text: object) -> str:
    """What the terminal says, as a page prints it."""
    return str(text).replace("+-", "±")
