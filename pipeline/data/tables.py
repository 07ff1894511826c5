"""Tables as columns of numpy arrays: reading those that somebody else may have made, and refusing what isn't one.

They are read and written without pandas, whose import takes half a second.
"""

from __future__ import annotations

import csv
import math
import re
import warnings
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from functools import partial
from itertools import islice, zip_longest
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from pipeline.data.csv_format import CsvConfig, find_header, is_grouped, name_columns, recognize_csv
from pipeline.data.mat_files import (
    open_measured,
    read_mat,
    require_lengths,
    require_names,
    require_room,
    require_unpacked,
)
from pipeline.errors import DataError
from pipeline.files import write_beside

if TYPE_CHECKING:
    import pandas as pd

SCHEMA = "1"
_MARK = "bearing_identification."
Columns = dict[str, np.ndarray]
"""Name -> values: float arrays of numbers, object arrays of texts."""


class _Table(NamedTuple):
    """A table as it is stored."""

    names: list[str]
    columns: Sequence[Any]  # sequences, arrays, or Arrow's columns of texts
    first: int = 1  # the row of the first values, as the file counts them
    decimal: str = "."


_FORMULA = re.compile(r"^('?)([=+@\t\r].*|-(?![\d.]+(?:[eE][-+]?\d+)?$).*)", re.S)
"""What a spreadsheet would compute; an apostrophe before it makes it text, which is no part of it."""
PLAIN = CsvConfig()
"""All of it recognised."""


def read_table(
    path: Path,
    columns: Mapping[str, str],
    optional: Mapping[str, str] | Callable[[list[str]], Mapping[str, str]] | None = None,
    text: CsvConfig = PLAIN,
) -> Columns:
    """The ``columns`` of a CSV, Excel (.xlsx), Parquet or MAT file, and those ``optional`` ones it has.

    ``text`` states how a CSV file is written, and the sheet of a workbook (else the first one).

    Both: name -> "number", "number or blank" (NaN), or "text"; what is optional may depend on the names that are there.

    Raises DataError: no such file, unreadable or truncated, an older schema, no rows, a column that is missing, there
    twice or of another kind, NaN or infinite values.
    """
    names, table, first, decimal = _read_any(path, columns, text)
    counts = Counter(names)
    if text.delimiter and len(names) == 1 < len(columns):
        raise DataError(
            f"'{path}' must have {len(columns)} columns, but '{text.delimiter}' does not part its header: leave csv: "
            "delimiter out, it is recognised"
        )
    require_names(path, "column", columns, names)
    if not table or not len(table[0]):
        raise DataError(f"'{path}' must have at least one row, but it has none")
    columns_read: Columns = {}
    further = optional(names) if callable(optional) else optional
    for name, kind in (dict(columns) | dict(further or {})).items():
        if counts[name] > 1:
            raise DataError(
                f"'{path}' must have the column '{name}' once, but it has it twice: give each a name of its own"
            )
        if name in counts:
            column = table[names.index(name)]
            if kind == "text":
                column = column if isinstance(column, np.ndarray | Sequence) else _to_array(column)
                texts = ["" if value is None else _FORMULA.sub(r"\2", str(value)) for value in column]
                columns_read[name] = np.array(texts, dtype=object)
            else:
                columns_read[name] = _to_numbers(path, name, column, kind, first, decimal)
    return columns_read


def list_columns(path: Path, text: CsvConfig = PLAIN) -> list[str]:
    """The names of the columns, in their order. Raises DataError as :func:`read_table`."""
    return _read_any(path, {}, text).names


def list_units(path: Path, text: CsvConfig = PLAIN, head: int = 100) -> dict[str, str]:
    """Name of each column -> the words of the rows of units below it. Raises DataError as :func:`read_table`."""
    if path.suffix.lower() in (".xlsx", ".xlsm"):
        rows: list[Any] = _read_sheet(path, text)
    elif is_csv(path):
        with open_measured(path, "CSV table"):
            text = recognize_csv(path, (), text)
            rows = _read_head(path, text, head)
    else:
        return dict.fromkeys(list_columns(path, text), "")
    skip, units = find_header(rows[:head], (), text.skip_rows)
    below = [" ".join(str(cell or "") for cell in column[1:]) for column in zip_longest(*rows[skip : skip + 1 + units])]
    return dict(zip(name_columns(rows, skip) if rows else (), below, strict=False))


def _read_head(path: Path, text: CsvConfig, count: int) -> list[Any]:
    """The first rows of a CSV file."""
    with path.open(newline="", encoding=text.encoding, errors="replace") as file:
        return list(islice(csv.reader(file, delimiter=text.delimiter or ","), count))


def list_sheets(path: Path) -> list[str | None]:
    """Those of a workbook; a single None for another file, and for a workbook of one sheet."""
    if path.suffix.lower() not in (".xlsx", ".xlsm"):
        return [None]
    with open_measured(path, "complete Excel file (.xlsx)"):
        names = _open_book(path).sheetnames
    return names if len(names) > 1 else [None]


def _read_any(path: Path, columns: Mapping[str, str], text: CsvConfig) -> _Table:
    stated = "{encoding, delimiter, decimal, skip_rows, unit_rows}"
    read, *kind = _READERS.get(
        path.suffix.lower(), (_read_csv, "CSV table", f"its format can be stated: csv: {stated}")
    )
    if text.sheet and read is not _read_excel:
        raise DataError(f"'{path}' must be a workbook, since it has sheet: {text.sheet}, but is none: leave sheet out")
    with open_measured(path, *kind):
        return read(path, columns, text)


def _to_numbers(path: Path, name: str, column: Any, kind: str, first: int, decimal: str) -> np.ndarray:
    if not isinstance(column, np.ndarray | Sequence):
        column = _parse_numbers(column) if decimal == "." else column.to_pylist()
    if isinstance(column, np.ndarray) and column.dtype.kind in "iuf":
        values = column.astype(float)
    else:
        values = np.array([_to_number(value, decimal) for value in column])
    bad = np.flatnonzero(np.isinf(values) if kind == "number or blank" else ~np.isfinite(values))
    if len(bad):
        raise DataError(
            f"'{path}' must have finite numbers in the column '{name}', but row {bad[0] + first} has {column[bad[0]]!r}"
            + (f" ({len(bad)} rows in all)" if len(bad) > 1 else "")
            + ": correct it, or leave the row out"
        )
    return values


def _to_number(value: Any, decimal: str) -> float:
    """NaN for a blank; infinite for what is no finite number, such as a date or a truth."""
    if value is None or value == "":
        return math.nan
    if isinstance(value, str):
        thousands = "," if decimal == "." else "."
        if thousands in value and is_grouped(value, thousands):
            value = value.replace(thousands, "")
        if "_" in value or not value.isascii() or thousands in value:  # Python takes 1_000 for a thousand
            return math.inf
        value = value.replace(decimal, ".")
    elif isinstance(value, bool) or not isinstance(value, (int, float)):
        return math.inf
    try:
        number = float(value)
    except (ValueError, OverflowError):
        return math.inf
    return number if math.isfinite(number) else math.inf


def _parse_numbers(column: Any) -> Sequence[Any] | np.ndarray:
    """The numbers of Arrow's ``column`` of texts; the texts where not all are finite numbers, to judge each."""
    from pyarrow.lib import ArrowInvalid

    with suppress(ArrowInvalid):
        values = _to_array(column.cast("float64"))
        if np.isfinite(values).all():
            return values
    return list(column.to_pylist())


def _read_csv(path: Path, columns: Mapping[str, str], text: CsvConfig, block: int = 1 << 20) -> _Table:
    """By Arrow, which takes a thirtieth of the time; by Python where there are quotes or anything that is wrong, which
    it explains. Both give the same; ``block`` is in letters."""
    import pyarrow as pa
    from pyarrow import csv as arrow

    text = recognize_csv(path, columns, text)
    numbers = [name for name, kind in columns.items() if kind == "number" and text.decimal == "."]
    with suppress(OSError, ValueError), path.open(newline="", encoding=text.encoding) as file:
        if not any('"' in content or "\0" in content for content in iter(partial(file.read, block), "")):
            stored = arrow.read_csv(
                path,
                read_options=arrow.ReadOptions(
                    skip_rows=text.skip_rows,
                    skip_rows_after_names=text.unit_rows,
                    encoding=(text.encoding or "").replace("utf-8-sig", "utf8"),
                    use_threads=False,
                ),
                parse_options=arrow.ParseOptions(delimiter=text.delimiter),
                convert_options=arrow.ConvertOptions(
                    column_types=dict.fromkeys(numbers, pa.float64()), default_column_type=pa.string(), null_values=[]
                ),
            )
            if all(np.isfinite(_to_array(column)).all() for column in stored.columns if column.type == "double"):
                names = name_columns(_read_head(path, text, text.first), text.skip_rows or 0)
                return _Table(names, stored.columns, text.first, text.decimal or ".")
    return _explain_csv(path, text)


def _explain_csv(path: Path, text: CsvConfig) -> _Table:
    with path.open(newline="", encoding=text.encoding) as file:
        lines = islice(file, text.skip_rows or 0, None)
        rows = [row for row in csv.reader(lines, delimiter=text.delimiter or ",") if row]
    if not rows:
        raise ValueError("it is empty")
    header = rows[0]
    for i, row in enumerate(rows, (text.skip_rows or 0) + 1):
        if len(row) > len(header):
            raise ValueError(f"row {i} has {len(row)} fields, the header {len(header)}")
        if any("\0" in field for field in row):
            raise ValueError(f"row {i} has bytes that are no text")
    require_room(path, 8 * len(header) * len(rows))
    return _Table(
        name_columns(_read_head(path, text, text.first), text.skip_rows or 0),
        [column[1 + (text.unit_rows or 0) :] for column in zip_longest(*rows, fillvalue="")],
        text.first,
        text.decimal or ".",
    )


def _read_sheet(path: Path, text: CsvConfig, most: int = 1 << 20, most_blank: int = 50_000) -> list[Any]:
    """Its rows to the last that is not blank: at most as many as a spreadsheet has, with so many blank ones together,
    which a file states in no space at all."""
    # Warnings of styles and validations, which hold no data.
    with open_measured(path, "complete Excel file (.xlsx)"), warnings.catch_warnings(action="ignore"):
        book = _open_book(path)
        require_names(path, "sheet", [text.sheet] if text.sheet else (), book.sheetnames)
        sheet = book[text.sheet or book.sheetnames[0]]
        sheet.reset_dimensions()  # what other programs write there may be wrong
        rows: list[Any] = []
        cells = blank = 0
        for row in sheet.iter_rows(values_only=True):
            cells += len(row)  # a row is as long as its last cell says
            require_room(path, 8 * cells)
            blank = blank + 1 if row.count(None) == len(row) else 0
            if blank > most_blank or len(rows) == most:
                raise DataError(
                    f"'{path}' must have at most {most:,} rows, and {most_blank:,} blank ones together, but row "
                    f"{len(rows) + 1:,} is one more: delete blank rows, or save the sheet as CSV"
                )
            rows.append(row)
        book.close()
    return rows[: len(rows) - blank]


def _open_book(path: Path, most: float = 5e6, times: float = 30.0) -> Any:
    """A workbook whose parts unpack to at most so many bytes, or ``times`` those of the file: 2 MB take a second."""
    import openpyxl

    require_unpacked(path, most, times)
    return openpyxl.load_workbook(path, read_only=True, data_only=True, keep_links=False)


def _read_excel(path: Path, columns: Mapping[str, str], text: CsvConfig) -> _Table:
    rows = _read_sheet(path, text)
    skip, units = find_header(rows[:100], columns, text.skip_rows)
    units = units if text.unit_rows is None else text.unit_rows
    names, header, rows = name_columns(rows, skip), rows[skip], rows[skip + 1 + units :]
    table = list(zip_longest(header, *rows))[: len(header)]
    return _Table(names, [column[1:] for column in table], skip + units + 2, text.decimal or ".")


def _read_mat(path: Path, columns: Mapping[str, str], text: CsvConfig) -> _Table:
    mat = read_mat(path, columns)
    require_lengths(path, "values in every variable", mat)
    return _Table(list(mat), [values if values.dtype.kind in "iuf" else values.tolist() for values in mat.values()])


def _read_parquet(path: Path, columns: Mapping[str, str], text: CsvConfig) -> _Table:
    import pyarrow.parquet as parquet

    # parquet.read_table would import pyarrow's data sets, which takes as long as pandas.
    with parquet.ParquetFile(path) as file:
        require_room(path, 8 * file.metadata.num_rows * file.metadata.num_columns)
        stored = file.read()
    table = [_to_array(column) for column in stored.columns]
    schema = _decode_marks(stored.schema.metadata).get("schema", SCHEMA)
    if schema != SCHEMA:
        raise DataError(
            f"'{path}' must have the file schema {SCHEMA}, but it was written with schema {schema}: make it "
            "again with stage=generate"
        )
    return _Table(stored.column_names, table)


_READERS: dict[str, tuple[Callable[[Path, Mapping[str, str], CsvConfig], _Table], str, str]] = {
    ".parquet": (_read_parquet, "complete Parquet file", "make it again with stage=generate"),
    ".xlsx": (_read_excel, "complete Excel file (.xlsx)", "copy it again"),
    ".xlsm": (_read_excel, "complete Excel file (.xlsx)", "copy it again"),
    ".mat": (_read_mat, "complete MAT file", "copy it again"),
}
"""By a file's ending: its reader, what it reads and the next step where it can't; any other is CSV."""


def is_csv(path: Path) -> bool:
    """Whether a table is read as CSV."""
    return path.suffix.lower() not in _READERS


def _to_array(column: Any) -> Sequence[Any] | np.ndarray:
    """NaN for a number that is null. By DLPack: pyarrow's own way to numpy imports pandas."""
    import pyarrow as pa

    kind = column.type
    if pa.types.is_integer(kind) and not column.null_count:
        return np.array(np.from_dlpack(column.combine_chunks()))
    if pa.types.is_integer(kind) or pa.types.is_floating(kind) or pa.types.is_decimal(kind):
        array = column.combine_chunks().cast("float64")
        return np.from_dlpack(array.fill_null(float("nan")) if array.null_count else array)
    if (pa.types.is_string(kind) or pa.types.is_large_string(kind)) and not column.null_count:
        coded = column.combine_chunks().dictionary_encode()  # a few texts, many times each
        return np.array(coded.dictionary.to_pylist(), dtype=object)[np.from_dlpack(coded.indices)]
    return list(column.to_pylist())


def read_marks(path: Path) -> dict[str, str] | None:
    """Read what a Parquet file says about itself; None where it is no complete Parquet file.

    Each file that was written here has ``schema``. A generated one also has ``rotor``, the rotor's fingerprint, and
    ``origin``, the identity of its configuration.
    """
    import pyarrow.lib
    import pyarrow.parquet as parquet

    with suppress(OSError, ValueError, pyarrow.lib.ArrowException):  # a damaged file says so when its rows are read
        if path.suffix == ".parquet":
            return _decode_marks(parquet.read_schema(path).metadata)
    return None


def _decode_marks(metadata: Mapping[bytes, bytes] | None) -> dict[str, str]:
    texts = {key.decode(errors="replace"): value.decode(errors="replace") for key, value in (metadata or {}).items()}
    return {key.removeprefix(_MARK): value for key, value in texts.items() if key.startswith(_MARK)}


def write_table(
    path: Path,
    table: Mapping[str, Any] | pd.DataFrame | Sequence[Mapping[str, Any]],
    marks: Mapping[str, str] | None = None,
) -> Path:
    """Write CSV or Parquet, by the file's ending. Numbers keep every digit; NaN is a blank. Raises StorageError.

    ``table`` has a sequence of values by the name of each column, or is a sequence of rows;
    what a row lacks is a blank. A Parquet file keeps ``marks`` for
    :func:`read_marks`.
    """
    if isinstance(table, Sequence):
        names = dict.fromkeys(name for row in table for name in row)
        table = {name: [row.get(name) for row in table] for name in names}
    columns = {str(name): np.asarray(table[name]) for name in table}

    def write(beside: Path) -> None:
        """Parquet, or else CSV."""
        if path.suffix == ".parquet":  # the temporary file beside it has another ending
            import pyarrow as pa
            import pyarrow.parquet as parquet

            arrays = {
                k: pa.array(column.tolist() if column.dtype == object else column) for k, column in columns.items()
            }
            every = {f"{_MARK}{key}": mark for key, mark in (dict(marks or {}) | {"schema": SCHEMA}).items()}
            parquet.write_table(pa.table(arrays).replace_schema_metadata(every), beside)
            return
        cells = [column.tolist() for column in columns.values()]  # a float as its shortest text with the same bits
        texts = [
            [_FORMULA.sub(r"'\2", v) if isinstance(v, str) else "" if v is None or v != v else str(v) for v in column]
            for column in cells
        ]
        with beside.open("w", newline="", encoding="utf-8") as file:
            writer = csv.writer(file, lineterminator="\n")
            writer.writerow(columns)
            writer.writerows(zip(*texts, strict=True))

    return write_beside(path, write)
