"""Reading tables that somebody else may have made, and refusing what isn't one."""

from __future__ import annotations

import csv
import hashlib
import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.errors import DataError, nearest
from pipeline.files import write_beside

if TYPE_CHECKING:
    import pandas as pd

SCHEMA = "1"
_SCHEMA_KEY = b"bearing_identification.schema"
_ROTOR_KEY = b"bearing_identification.rotor"
_ORIGIN_KEY = b"bearing_identification.origin"


@dataclass(frozen=True)
class TextFormat:
    """How a CSV file is written; ``skip_rows`` are lines before the header (of an Excel sheet, too)."""

    delimiter: str = ","
    decimal: str = "."
    skip_rows: int = 0


PLAIN = TextFormat()


def read_table(
    path: Path, columns: Mapping[str, str], optional: Mapping[str, str] | None = None, text: TextFormat = PLAIN
) -> pd.DataFrame:
    """A CSV, Excel (.xlsx, its first sheet) or Parquet file with at least ``columns``.

    ``columns``: name -> "number", "number or blank", or "text". Columns that are ``optional`` are held to their kind
    where there are any.

    Raises DataError: no such file, unreadable or truncated, an older schema, no rows, a missing column, a
    column of another type, NaN or infinite values.
    """
    if not path.is_file():
        raise DataError(f"'{path}' must exist, but there is no such file")
    texts = {"run", *(name for name, kind in columns.items() if kind == "text")}
    if path.suffix == ".parquet":
        table = _read_parquet(path)
    elif path.suffix.lower() in (".xlsx", ".xlsm"):
        table = _read_excel(path, texts, text)
    else:
        table = _read_csv(path, texts, text)
    for name in columns:
        if name not in table.columns:
            raise DataError(
                f"'{path}' must have the column '{name}', but it has not: {nearest(name, map(str, table.columns))}"
            )
    if table.empty:
        raise DataError(f"'{path}' must have at least one row, but it has none")
    there = {name: kind for name, kind in (optional or {}).items() if name in table.columns}
    for name, kind in (dict(columns) | there).items():
        if kind == "number":
            table[name] = _numbers(path, table, name)
        elif kind == "number or blank":
            blank = table[name].isna() | (table[name].astype(str) == "")
            table[name] = _numbers(path, table.assign(**{name: table[name].where(~blank, 0.0)}), name)
            table.loc[blank, name] = np.nan
        else:
            table[name] = table[name].astype(str)
    return table


def _numbers(path: Path, table: pd.DataFrame, name: str) -> np.ndarray:
    import pandas as pd

    column = table[name]
    values = pd.to_numeric(column, errors="coerce").to_numpy(dtype=float)
    if column.dtype.kind not in "iuf":
        # pandas takes true for 1, and a date for nanoseconds.
        strange = column.map(lambda value: isinstance(value, (bool, np.bool_)) or hasattr(value, "year"))
        values = np.where(strange, np.nan, values)
    bad = np.flatnonzero(~np.isfinite(values))
    if len(bad):
        raise DataError(
            f"'{path}' must have finite numbers in the column '{name}', but row {bad[0] + 1} has "
            f"{table[name].iloc[bad[0]]!r}" + (f" ({len(bad)} rows in all)" if len(bad) > 1 else "")
        )
    return values


def _read_csv(path: Path, texts: set[str], text: TextFormat) -> pd.DataFrame:
    import pandas as pd

    try:
        with warnings.catch_warnings():
            # A row with more fields than the header: pandas would drop some, or take the first for a name of the row.
            warnings.simplefilter("error", pd.errors.ParserWarning)
            # Texts are kept as they are: a run called 'NA' is a run.
            return pd.read_csv(
                path,
                keep_default_na=False,
                dtype=dict.fromkeys(texts, str),
                index_col=False,
                low_memory=False,
                sep=text.delimiter,
                decimal=text.decimal,
                skiprows=text.skip_rows,
            )
    except (OSError, ValueError, OverflowError, pd.errors.ParserError, pd.errors.ParserWarning) as error:
        raise DataError(f"'{path}' must be a CSV table, but it can't be read as one ({_first_line(error)})") from None


def _read_excel(path: Path, texts: set[str], text: TextFormat) -> pd.DataFrame:
    import pandas as pd

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of styles and validations, which hold no data
            return pd.read_excel(
                path,
                keep_default_na=False,
                dtype=dict.fromkeys(texts, str),
                skiprows=text.skip_rows,
                engine="openpyxl",
            )
    except Exception as error:  # for a damaged file openpyxl raises many kinds (zip, XML, key, attribute errors)
        raise DataError(
            f"'{path}' must be a complete Excel file (.xlsx), but it can't be read as one ({_first_line(error)})"
        ) from None


def _read_parquet(path: Path) -> pd.DataFrame:
    import pyarrow.lib
    import pyarrow.parquet as parquet

    try:
        stored = parquet.read_table(path)
        # Without the notes that pandas leaves in a file: columns and types are all that is needed of it.
        table = stored.replace_schema_metadata(None).to_pandas()
    except (OSError, ValueError, TypeError, pyarrow.lib.ArrowException) as error:
        raise DataError(
            f"'{path}' must be a complete Parquet file, but it can't be read ({_first_line(error)}): make it "
            "again with stage=generate"
        ) from None
    schema = schema_of(stored.schema.metadata)
    if schema is not None:
        raise DataError(
            f"'{path}' must have the file schema {SCHEMA}, but it was written with schema {schema}: make it "
            "again with stage=generate"
        )
    return table


def schema_of(metadata: Mapping[bytes, bytes] | None) -> str | None:
    """The schema of a Parquet file's notes where it is another than the one read here; else None."""
    schema = (metadata or {}).get(_SCHEMA_KEY, SCHEMA.encode()).decode(errors="replace")
    return schema if schema != SCHEMA else None


def _first_line(error: Exception) -> str:
    return (str(error).splitlines() or [type(error).__name__])[0][:200]


def rotor_of(path: Path) -> str | None:
    """Fingerprint of the rotor that a Parquet file was made for; None where it doesn't say (CSV, other makers)."""
    return _stored(path, _ROTOR_KEY)


def fingerprint_of(path: Path) -> str:
    """Identity of a file's bytes; empty where there is no file."""
    return hashlib.sha256(path.read_bytes()).hexdigest()[:16] if path.is_file() else ""


def origin_of(path: Path) -> str | None:
    """Identity of the configuration that a Parquet file was generated from; None where it doesn't say."""
    return _stored(path, _ORIGIN_KEY)


def is_foreign(path: Path) -> bool:
    """True for a complete Parquet file that was not generated here."""
    import pyarrow.lib
    import pyarrow.parquet as parquet

    try:
        return _ORIGIN_KEY not in (parquet.read_schema(path).metadata or {})
    except (OSError, ValueError, pyarrow.lib.ArrowException):
        return False


def is_ingested(path: Path) -> bool:
    """True for a complete Parquet file that was written here, and not generated."""
    return _stored(path, _SCHEMA_KEY) is not None and origin_of(path) is None


def _stored(path: Path, key: bytes) -> str | None:
    import pyarrow.lib
    import pyarrow.parquet as parquet

    if path.suffix != ".parquet":
        return None
    try:
        stored = (parquet.read_schema(path).metadata or {}).get(key)
    except (OSError, ValueError, pyarrow.lib.ArrowException):
        return None  # a damaged file says so when its rows are read
    return stored.decode(errors="replace") if stored is not None else None


def write_table(
    path: Path, table: Mapping[str, Any] | pd.DataFrame, rotor: str | None = None, origin: str | None = None
) -> Path:
    """Write CSV or Parquet, by the file's ending. Numbers keep every digit; NaN is a blank. Raises StorageError.

    ``table`` has a sequence of values by the name of each column. ``rotor`` and ``origin`` are kept in a Parquet file,
    for :func:`rotor_of` and :func:`origin_of`.
    """
    columns = {str(name): np.asarray(table[name]) for name in table}

    def write(beside: Path) -> None:
        """By the ending of ``path``: ``beside`` has another name."""
        if path.suffix == ".parquet":
            marks = {_ROTOR_KEY: rotor, _ORIGIN_KEY: origin, _SCHEMA_KEY: SCHEMA}
            _write_parquet(beside, columns, {key: mark.encode() for key, mark in marks.items() if mark is not None})
        else:
            _write_csv(beside, columns)

    return write_beside(path, write)


def _write_csv(path: Path, columns: Mapping[str, np.ndarray]) -> None:
    texts = [[_written(value) for value in column.tolist()] for column in columns.values()]
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(columns)
        writer.writerows(zip(*texts, strict=True))


def _written(value: object) -> str:
    """A float as its shortest text that reads back to the same bits."""
    return "" if value is None or value != value else str(value)


def _write_parquet(path: Path, columns: Mapping[str, np.ndarray], marks: Mapping[bytes, bytes]) -> None:
    import pyarrow as pa
    import pyarrow.parquet as parquet

    stored = pa.table(
        {name: pa.array(column.tolist() if column.dtype == object else column) for name, column in columns.items()}
    )
    parquet.write_table(stored.replace_schema_metadata(dict(marks)), path)
