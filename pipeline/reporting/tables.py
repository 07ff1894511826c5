"""Tables, sentences and sections as values, shown alike on the terminal, in Markdown, on the page and in the PDF."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple, TypeAlias

from pipeline.write_numbers import write_number

if TYPE_CHECKING:
    from pipeline.reporting.figure import Figure

MICROMETRES_PEAK_TO_PEAK = 2e6
"""What an amplitude in m, zero-to-peak, is multiplied by, unless the reader chooses another unit."""


@dataclass(frozen=True)
class Amplitude:
    """A cell with an amplitude in m, zero-to-peak, which the page shows in the reader's unit; else in µm pk-pk."""

    value: float
    deviation: float = 0.0

    def __str__(self) -> str:
        """In µm, peak-to-peak."""
        scale = MICROMETRES_PEAK_TO_PEAK
        return write_number(scale * self.value, scale * self.deviation or None)


@dataclass(frozen=True)
class Mark:
    """A cell with a verdict: ``good``, ``with care`` or ``no`` (its look), and the text that says it."""

    kind: str
    text: str

    def __str__(self) -> str:
        """The words alone."""
        return self.text


Cell = str | Amplitude | Mark


class Table(NamedTuple):
    """Rows below a header; ``caption`` says what they are, and their units where the header does not."""

    caption: str
    header: Sequence[str]
    rows: Sequence[Sequence[Cell]]

    def without_blank(self) -> Table:
        """The same without the columns in which nothing stands; all of them where there is no row."""
        keep = [c for c in range(len(self.header)) if not self.rows or any(str(row[c]) for row in self.rows)]
        rows = [[row[c] for c in keep] for row in self.rows]
        return Table(self.caption, [self.header[c] for c in keep], rows)


def format_markdown(header: Sequence[str], rows: Sequence[Sequence[Cell]]) -> str:
    """Write a table as Markdown, for a file."""
    lines = ["| " + " | ".join(header) + " |", "|" + "---|" * len(header)]
    return "\n".join([*lines, *("| " + " | ".join(map(str, row)) + " |" for row in rows)]) + "\n"


@dataclass(frozen=True)
class Paragraph:
    """One or more sentences; a ``warning`` stands out."""

    text: str
    warning: bool = False


Block: TypeAlias = "Paragraph | Table | Figure"


@dataclass(frozen=True)
class Section:
    """A part of the report; ``anchor`` is its name in links."""

    anchor: str
    title: str
    blocks: tuple[Block, ...]


def typeset(text: object) -> str:
    """What the terminal says, as a page prints it."""
    return str(text).replace("+-", "±")
