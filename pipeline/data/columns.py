"""Tables as columns of numpy arrays, without pandas where a table is well formed: importing it takes half a second.

What is not plainly well formed goes the way of :func:`pipeline.data.tables.read_table`, which reads more and names what
is wrong. Both ways give the same numbers.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.data.tables import read_table, schema_of

Columns = dict[str, np.ndarray]
"""Name -> values: float arrays of numbers, object arrays of texts."""


def read_columns(path: Path, columns: Mapping[str, str], optional: Mapping[str, str] | None = None) -> Columns:
    """The ``columns`` of a CSV, Excel or Parquet file, and those ``optional`` ones that it has.

    Kinds and errors are those of :func:`pipeline.data.tables.read_table`.
    """
    found = _well_formed(path, columns, optional or {})
    if found is not None:
        return found
    table = read_table(path, columns, optional)
    names = [*columns, *(name for name in optional or {} if name in table.columns)]
    return {name: np.asarray(table[name], dtype=_dtype((dict(columns) | dict(optional or {}))[name])) for name in names}


def _dtype(kind: str) -> type:
    return object if kind == "text" else float


def _well_formed(path: Path, columns: Mapping[str, str], optional: Mapping[str, str]) -> Columns | None:
    """None for whatever needs a closer look."""
    if path.suffix == ".parquet":
        return _plain_parquet(path, columns, optional)
    return _plain_csv(path, columns, optional) if path.suffix == ".csv" else None


def _plain_csv(path: Path, columns: Mapping[str, str], optional: Mapping[str, str]) -> Columns | None:
    try:
        text = path.read_text(encoding="utf-8")
        if not text.isascii() or "\0" in text:
            return None
        header, *rows = [row for row in csv.reader(io.StringIO(text, newline=""), strict=True) if row]
    except (OSError, ValueError, csv.Error):
        return None
    kinds = _kinds(header, columns, optional)
    if kinds is None or not rows or any(len(row) != len(header) for row in rows):
        return None
    by_name = dict(zip(header, zip(*rows, strict=True), strict=True))
    found: Columns = {}
    for name, kind in kinds.items():
        if kind == "text":
            found[name] = np.array(by_name[name], dtype=object)
            continue
        numbers = _numbers(by_name[name], kind)
        if numbers is None:
            return None
        found[name] = numbers
    return found


def _kinds(header: list[str], columns: Mapping[str, str], optional: Mapping[str, str]) -> dict[str, str] | None:
    if len(set(header)) != len(header) or not set(columns) <= set(header):
        return None
    return dict(columns) | {name: kind for name, kind in optional.items() if name in header}


def _numbers(texts: tuple[str, ...], kind: str) -> np.ndarray | None:
    if any("_" in text for text in texts):  # Python takes 1_000 for a thousand
        return None
    try:
        blank = kind == "number or blank"
        values = np.array([np.nan if blank and not text else float(text) for text in texts])
    except ValueError:
        return None
    finite = np.isfinite(values)
    return values if all(finite) or (blank and all(ok or not t for ok, t in zip(finite, texts, strict=True))) else None


def _plain_parquet(path: Path, columns: Mapping[str, str], optional: Mapping[str, str]) -> Columns | None:
    import pyarrow as pa
    import pyarrow.lib
    import pyarrow.parquet as parquet

    try:
        # parquet.read_table would import pyarrow's data sets, which takes as long as pandas.
        table = parquet.ParquetFile(path).read()
    except (OSError, ValueError, TypeError, pyarrow.lib.ArrowException):
        return None
    kinds = _kinds(table.column_names, columns, optional)
    if kinds is None or not table.num_rows or schema_of(table.schema.metadata) is not None:
        return None
    found: Columns = {}
    for name, kind in kinds.items():
        column, of = table.column(name), table.schema.field(name).type
        if kind == "text":
            if column.null_count or not (pa.types.is_string(of) or pa.types.is_large_string(of)):
                return None
            found[name] = _texts(column)
            continue
        if not (pa.types.is_integer(of) or pa.types.is_floating(of)) or (column.null_count and kind == "number"):
            return None
        values = _floats(column)
        if not np.isfinite(values if kind == "number" else values[~np.isnan(values)]).all():
            return None
        found[name] = values
    return found


def _floats(column: Any) -> np.ndarray:
    """NaN for what is null. By DLPack: pyarrow's own way to numpy imports pandas."""
    array = column.combine_chunks().cast("float64")
    return np.array(np.from_dlpack(array.fill_null(float("nan")) if array.null_count else array))


def _texts(column: Any) -> np.ndarray:
    """A few texts, many times each."""
    coded = column.combine_chunks().dictionary_encode()
    return np.array(coded.dictionary.to_pylist(), dtype=object)[np.from_dlpack(coded.indices)]
