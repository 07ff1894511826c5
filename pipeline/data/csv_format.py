"""How a CSV file is written: what is stated of it, and what the file itself shows of the rest.

Loggers write semicolons and decimal commas, the encoding of their system, lines of text above the header, and units
below it. What is recognised is said beside the results, and each part can be stated.
"""

from __future__ import annotations

import codecs
import csv
import re
from collections import Counter
from collections.abc import Collection, Iterator, Sequence
from contextlib import suppress
from itertools import accumulate, zip_longest
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field

from pipeline.config.section import NonNegativeInt, Section, Text, rule
from pipeline.errors import DataError


class CsvConfig(Section):
    """How a CSV file is written; what is not stated is recognised.

    ``skip_rows`` are lines before the header, ``unit_rows`` such as ``rpm;um pp;deg`` below it, and ``sheet`` is that
    of an Excel workbook, in which they count, too.
    """

    encoding: Text | None = None
    delimiter: Annotated[str, Field(min_length=1, max_length=1)] | None = None
    decimal: Literal[".", ","] | None = None
    skip_rows: NonNegativeInt | None = None
    unit_rows: NonNegativeInt | None = None
    sheet: Text | None = None

    @rule
    def _lawful(self) -> Iterator[str]:
        if self.decimal and self.delimiter == self.decimal:
            yield f"must have a delimiter that is not the decimal mark, but both are {self.decimal!r}"
        with suppress(LookupError):
            codecs.lookup(self.encoding or "utf-8")
            return
        yield f"must have an encoding such as utf-8 or cp1252, but got '{self.encoding}'"

    @property
    def first(self) -> int:
        """The line of the first row of numbers."""
        return (self.skip_rows or 0) + (self.unit_rows or 0) + 2

    def on(self, sheet: str | None) -> CsvConfig:
        """The same, on another sheet if one is named."""
        return self.model_copy(update={"sheet": sheet}) if sheet else self


USUAL = {"encoding": "utf-8-sig", "delimiter": ",", "decimal": ".", "skip_rows": 0, "unit_rows": 0}
"""What needs no word."""


def recognize_csv(path: Path, names: Collection[str], stated: CsvConfig, head: int = 1 << 16) -> CsvConfig:
    """The format of a CSV file whose header has the ``names``, from its first ``head`` letters; stated parts stay.

    Raises DataError where a comma may stand for decimals and for thousands.
    """
    encoding = stated.encoding or _recognize_encoding(path)
    with path.open(encoding=encoding, errors="replace", newline="") as file:
        lines = file.read(head).splitlines()
    delimiter = stated.delimiter or _recognize_delimiter(lines, ";\t|" if stated.decimal == "," else ",;\t|")
    rows = _split(lines, delimiter)
    skip, units = find_header(rows, names, stated.skip_rows)
    cells = [cell.strip() for row in rows[skip + 1 :] for cell in row]
    decimal = stated.decimal or ("." if delimiter == "," else _recognize_decimal(path, cells))
    known = {"skip_rows": skip, "unit_rows": units} | stated.model_dump(exclude_none=True)
    return CsvConfig.model_validate(known | {"encoding": encoding, "delimiter": delimiter, "decimal": decimal})


def describe_format(path: Path, names: Collection[str], stated: CsvConfig) -> tuple[str, ...]:
    """What was recognised of a CSV file, as a sentence; none where it is usual or stated."""
    made = recognize_csv(path, names, stated).model_dump(exclude_none=True)
    told = {key for key, usual in USUAL.items() if getattr(stated, key) is None and made[key] != usual}
    line = made["skip_rows"] + 1
    said = {
        "encoding": made["encoding"],
        "delimiter": {"\t": "tabs"}.get(made["delimiter"], f"'{made['delimiter']}'") + " between fields",
        "decimal": "decimal commas",
        "skip_rows": f"the header in line {line}",
        "unit_rows": f"units below it, left out ({made['unit_rows']})",
    }
    parts = [text for key, text in said.items() if key in told]
    return (f"'{path}' is read as: {', '.join(parts)} (machine.recordings.csv states another)",) if parts else ()


def _recognize_encoding(path: Path, block: int = 1 << 20) -> str:
    """UTF-8, or UTF-16 by its mark, or what Windows writes in the West of Europe."""
    try:
        with path.open("rb") as raw:
            if raw.read(2) in (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE):
                return "utf-16"
        with path.open(encoding="utf-8-sig", newline="") as file:
            while file.read(block):
                pass
    except UnicodeDecodeError:
        return "cp1252"
    return "utf-8-sig"


def _split(lines: Sequence[str], delimiter: str) -> list[list[str]]:
    try:
        return [next(csv.reader([line], delimiter=delimiter), []) for line in lines]
    except csv.Error:
        return [line.split(delimiter) for line in lines]


_NUMBER = re.compile(r"[-+]?[.,]*\d[\d.,]*([eE][-+]?\d+)?")


def _recognize_delimiter(lines: Sequence[str], candidates: str) -> str:
    """The one that cuts most lines alike, then the one that leaves the most numbers, then the one of most fields."""

    def rate(mark: str) -> tuple[int, float, int]:
        rows = _split(lines, mark)
        widths = Counter(len(row) for row in rows if len(row) > 1)
        if not widths:
            return 0, 0.0, 0
        width, count = widths.most_common(1)[0]
        cells = [cell for row in rows if len(row) == width for cell in row]
        return count, sum(bool(_NUMBER.fullmatch(cell.strip())) for cell in cells) / len(cells), width

    return max(candidates, key=rate)


def find_header(rows: Sequence[Sequence[Any]], names: Collection[str], stated: int | None = None) -> tuple[int, int]:
    """The place of the header among ``rows``, and how many rows of units follow it.

    The header has most of the ``names``; where none has any, it is the last row of texts before the numbers that is as
    long as most rows are, or the very first.
    """
    header = stated
    if header is None:
        shared = [len(set(names) & set(name_columns(rows, i))) for i in range(len(rows) if names else 0)]
        widths = Counter(len(row) for row in rows if len(row) > 1)
        width = widths.most_common(1)[0][0] if widths else 1
        long = [i for i, row in enumerate(rows) if len(row) == width and any(row)]
        cells = {i: [str(cell).strip() for cell in rows[i] if cell not in (None, "")] for i in long}
        mostly = (i for i in long if 2 * sum(bool(_NUMBER.fullmatch(cell)) for cell in cells[i]) > len(cells[i]))
        numbers = next(mostly, 1)
        last = max((i for i in long if i < numbers and not _has_units(rows[i])), default=0)
        header = shared.index(max(shared)) if any(shared) else last
    units = 0
    while header + 1 + units < len(rows) and _has_units(rows[header + 1 + units]):
        units += 1
    return header, units


def name_columns(rows: Sequence[Sequence[Any]], header: int) -> list[str]:
    """The names in the row ``header``; those that repeat, with the name of their group above and the unit below them.

    A blank above belongs to the group at its left: ``;DE_Y;;DE_X;`` above ``Speed;Amp;Phase;Amp;Phase``.
    """
    before, names, after = ([str(cell or "") for cell in row] for row in [[], *rows, []][header : header + 3])
    groups: Iterator[str] = accumulate(before, lambda left, cell: cell or left)
    units = after if _has_units(after) else []
    every = list(zip_longest(groups, names, units, fillvalue=""))[: len(names)]
    return [" ".join(filter(None, parts)) if names.count(parts[1]) > 1 else parts[1] for parts in every]


_UNITS = {
    *("rpm", "1/min", "min-1", "cpm", "hz", "rad/s", "s", "ms", "m", "mm", "um", "mil", "mils", "in", "deg", "degree"),
    *("degrees", "rad", "lag", "lead", "pp", "p-p", "pk-pk", "pk", "0-p", "rms", "v", "mv", "g", "mm/s", "m/s", "in/s"),
    *("m/s2", "m/s^2", "degc", "degf", "-"),
}


def _has_units(row: Sequence[Any]) -> bool:
    """Whether a row has units, or nothing, in each of its cells."""
    letters = str.maketrans({"µ": "u", "μ": "u", "°": "deg", **dict.fromkeys("[]()", " ")})
    texts = ["" if cell is None else str(cell).translate(letters).lower() for cell in row]
    parts = [part for text in texts for part in text.split()]
    return bool(parts) and set(parts) <= _UNITS and parts != ["-"]


def _recognize_decimal(path: Path, cells: Sequence[str]) -> str:
    """By the marks of the numbers: what parts thousands stands before each three digits, and before the other mark."""
    numbers = [cell for cell in cells if _NUMBER.fullmatch(cell)]
    commas, points = ([cell for cell in numbers if mark in cell] for mark in ",.")
    if not commas:
        return "."
    if not all(is_grouped(cell, ",") for cell in commas):
        return ","
    if points and not all(is_grouped(cell, ".") for cell in points):
        return "."
    raise DataError(
        f"'{path}' must show what its commas mean, but '{commas[0]}' may have a decimal comma or parted thousands: "
        "give csv: {decimal: ','} or csv: {decimal: '.'} in machine.recordings"
    )


def is_grouped(cell: str, mark: str) -> bool:
    """Whether the ``mark`` can part thousands in a number: ``1.234`` or ``1.234,5``, but not ``0.123`` or ``12.5``."""
    other = "," if mark == "." else "."
    pattern = rf"[-+]?[1-9]\d{{0,2}}(\{mark}\d{{3}})+(\{other}\d*)?"
    return bool(re.fullmatch(pattern, cell))
