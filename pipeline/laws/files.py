"""Tables of films from files: those that come with the package, by name, and a user's own CSV files."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from pipeline.errors import ConfigError, nearest
from pipeline.laws.table import Curve, FilmTable

FOLDER = Path(__file__).with_name("tables")
COLUMNS = ("S", "Kxx", "Kxy", "Kyx", "Kyy", "Bxx", "Bxy", "Byx", "Byy")
PRELOAD = "preload"


def packaged_tables() -> tuple[str, ...]:
    """Names of the tables that come with the package."""
    return tuple(sorted(path.stem for path in FOLDER.glob("*.csv")))


def packaged_file(table: str) -> Path | None:
    """The file of a table that comes with the package; None for another."""
    return FOLDER / f"{table}.csv" if table in packaged_tables() else None


def read_film_table(table: str) -> FilmTable:
    """A table of the package by its name, or of a CSV file by its path.

    Lines that begin with ``#`` are its head. It has the columns :data:`COLUMNS`, dimensionless, and perhaps
    ``preload``; others are left alone. Raises ConfigError: no such table, a column that is missing, a value that is no
    number, Sommerfeld numbers that do not ascend (at each preload), too few rows.
    """
    path = packaged_file(table) or Path(table)
    try:
        lines = [line for line in path.read_text(encoding="utf-8").splitlines() if line.strip() and line[0] != "#"]
    except (OSError, UnicodeDecodeError):
        raise ConfigError(
            f"a bearing's table must be one of the package or a CSV file, but '{table}' is neither: "
            f"{nearest(table, packaged_tables())}"
        ) from None
    header, *cells = list(csv.reader(lines)) or [[]]
    names = [name.strip() for name in header]
    if missing := [name for name in COLUMNS if name not in names]:
        raise ConfigError(
            f"a bearing's table must have the columns {', '.join(COLUMNS)} (and perhaps {PRELOAD}), but '{table}' has "
            f"no {missing[0]}: {nearest(missing[0], names)}"
        )
    wanted = [names.index(name) for name in (*COLUMNS, *([PRELOAD] if PRELOAD in names else []))]
    try:
        rows = np.array([[float(row[i]) for i in wanted] for row in cells])
    except (ValueError, IndexError):
        raise ConfigError(f"a bearing's table must have a number in every cell, but '{table}' has not") from None
    return make_film_table(rows, table)


def make_film_table(rows: np.ndarray | Sequence[Sequence[float]], name: str, fewest: int = 4) -> FilmTable:
    """The table of ``rows`` (n, 9) over S, or (n, 10) with a preload in the last column.

    Raises ConfigError as :func:`read_film_table`.
    """
    rows = np.asarray(rows, dtype=float).reshape(len(rows), -1 if len(rows) else len(COLUMNS))
    if not np.isfinite(rows).all():
        raise ConfigError(f"a bearing's table must be finite, but '{name}' is not")
    own = rows[:, len(COLUMNS)] if rows.shape[1] > len(COLUMNS) else np.zeros(len(rows))
    preloads, curves = np.unique(own), []
    if len(preloads) > 1 and not (preloads[0] >= 0 and preloads[-1] < 1):
        raise ConfigError(f"a bearing's table must have preloads from 0 to below 1, but '{name}' has others")
    for preload in preloads if len(rows) else [0.0]:
        same_preload = rows[own == preload]
        where = f" at the preload {preload:g}" if len(preloads) > 1 else ""
        if len(same_preload) < fewest:
            raise ConfigError(f"a bearing's table must have {fewest} rows{where}, but '{name}' has {len(same_preload)}")
        if same_preload[0, 0] <= 0 or (np.diff(same_preload[:, 0]) <= 0).any():
            raise ConfigError(
                f"a bearing's table must have ascending Sommerfeld numbers above zero{where}, but '{name}' has not: "
                "sort its rows by S"
            )
        curves.append(Curve(np.log(same_preload[:, 0]), same_preload[:, 1 : len(COLUMNS)]))
    return FilmTable(preloads, tuple(curves))
