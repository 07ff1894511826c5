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
    """Text with a look: a cell is ``good``, ``with care`` or ``no``, a paragraph a ``warning`` (or none)."""

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
        return Table(self.caption, [self.header[c] for c in keep], [[row[c] for c in keep] for row in self.rows])


def format_markdown(header: Sequence[str], rows: Sequence[Sequence[Cell]]) -> str:
    """Write a table as Markdown, for a file."""
    lines = ["| " + " | ".join(map(str, cells)) + " |\n" for cells in (header, *rows)]
    return "".join([lines[0], "|" + "---|" * len(header) + "\n", *lines[1:]])


Block: TypeAlias = "str | Mark | Table | Figure"
"""A paragraph is one or more sentences."""
Section: TypeAlias = tuple[str, str, Sequence[Block]]
"""A part of the report: its name in links, its title, and what stands in it."""


def typeset(text: object) -> str:
    """What the terminal says, as a page prints it."""
    return str(text).replace("+-", "±")
