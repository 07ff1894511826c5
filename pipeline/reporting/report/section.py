"""A section of the report as a value: sentences, tables and figures, in order."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from pipeline.reporting.report.figure import Figure
from pipeline.reporting.write_numbers import format_deviation


@dataclass(frozen=True)
class Amplitude:
    """A cell with an amplitude in m, zero-to-peak, which the page shows in the reader's unit."""

    value: float
    deviation: float | None = None


@dataclass(frozen=True)
class Mark:
    """A cell with a verdict: ``good``, ``with care`` or ``no`` (its look), and the words that say it."""

    kind: str
    words: str


Cell = str | Amplitude | Mark


@dataclass(frozen=True)
class Paragraph:
    """One or more sentences; a ``warning`` stands out."""

    text: str
    warning: bool = False


@dataclass(frozen=True)
class Table:
    """Rows below a header; ``caption`` says what they are, and their units where the header does not."""

    caption: str
    header: Sequence[str]
    rows: Sequence[Sequence[Cell]]


Block = Paragraph | Table | Figure


@dataclass(frozen=True)
class Section:
    """A part of the report; ``anchor`` is its name in links."""

    anchor: str
    title: str
    blocks: tuple[Block, ...]


def write_number(value: float | None, deviation: float | None = None, digits: int = 4) -> str:
    """A number with its standard deviation where there is one, such as ``12.34 ± 0.05``; a dash for None."""
    if value is None or not math.isfinite(value):
        return "–"
    if deviation is None or not math.isfinite(deviation) or deviation <= 0:
        return f"{value:.{digits}g}" if abs(value) < 1e5 else f"{value:.0f}"
    return format_deviation(value, deviation).replace("+-", "±")
