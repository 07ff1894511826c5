"""Tables of every format: numbers as they stand, names that are text, and what a file may not hold."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from conftest import refused
from measured_files import table_config
from reading import RUNS, check_read, read

from data.test_mat_files import turned_tables
from pipeline.data import tables
from pipeline.data.csv_format import CsvConfig
from pipeline.data.tables import list_units, read_table


@pytest.mark.parametrize(
    ("types", "index", "tolerance"),
    [
        ({}, [], 1e-12),
        ({"run": "category", "probe": "category"}, [], 1e-12),
        ({}, ["run", "probe"], 1e-12),
        ({"amplitude": "float32", "phase": "float32"}, [], 1e-6),
        ({"speed": "int32"}, [], 1e-12),
    ],
    ids=["plain", "categorical", "index", "single", "integers"],
)
def test_long_tables_in_parquet(types: dict[str, str], index: list[str], tolerance: float, tmp_path: Path) -> None:
    """As pandas writes them: categories, columns in the index, float32, and speeds that are whole numbers."""
    table = turned_tables().astype(types)
    (table.set_index(index) if index else table).to_parquet(tmp_path / "all.parquet")
    check_read(read(table_config(RUNS, "long", file=str(tmp_path / "all.parquet"))), tolerance)


def test_numbers_come_from_arrow(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, rng: np.random.Generator) -> None:
    """What is a table of numbers is not read cell by cell, and keeps every bit."""
    values = rng.standard_normal((1000, 3)) * 10.0 ** rng.integers(-300, 300, (1000, 3))
    path = tmp_path / "table.csv"
    path.write_text("a,b,c\n" + "\n".join(",".join(map(repr, row)) for row in values.tolist()))
    monkeypatch.setattr(tables, "_to_number", None)
    monkeypatch.setattr(tables, "_explain_csv", None)
    read = read_table(path, dict.fromkeys("abc", "number"))
    np.testing.assert_array_equal(np.stack([read[name] for name in "abc"], axis=1), values)


def test_names_that_a_spreadsheet_would_compute_are_text(tmp_path: Path) -> None:
    """An apostrophe leads them in the file, and not where it is read."""
    names = ['=HYPERLINK("http://x")', "+1+cmd|x", "@SUM(A1)", "-2+3", "\tx", "plain", "'quoted", "a=b", "-5"]
    path = tables.write_table(tmp_path / "names.csv", {"run": names, "value": [0.5] * len(names)})
    assert [line.strip('"')[0] for line in path.read_text().splitlines()[1:6]] == ["'"] * 5
    assert read_table(path, {"run": "text"})["run"].tolist() == names


def test_columns_whose_field_never_ends(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text('a,b\n"' + "1" * 200000)
    with refused("a.csv", "field larger than field limit"):
        list_units(tmp_path / "a.csv")


@pytest.mark.parametrize(
    ("cells", "decimal", "value"),
    [("1,234;5,5", None, 1.234), ("1,234;5.5", None, 1234), ("1.234;5,5", None, 1234), ("1,234;7", ".", 1234)],
)
def test_a_mark_that_parts_thousands(cells: str, decimal: str | None, value: float, tmp_path: Path) -> None:
    (tmp_path / "t.csv").write_text(f"a;b\n{cells}\n")
    assert read_table(tmp_path / "t.csv", {"a": "number"}, text=CsvConfig(decimal=decimal))["a"].tolist() == [value]
    (tmp_path / "t.csv").write_text("a;b\n1,234;7\n")
    with refused("must show what its commas mean, but '1,234' may have a decimal comma or parted thousands"):
        read_table(tmp_path / "t.csv", {"a": "number"})


def test_an_excel_table_is_read_as_a_csv_is(tmp_path: Path) -> None:
    frame = pd.DataFrame({"run": ["007", "NA", "x"], "a": [1.0, 2.5, -3e-7], "b": [1.0, np.nan, 3.0]})
    frame.to_csv(tmp_path / "t.csv", index=False)
    frame.to_excel(tmp_path / "t.xlsx", index=False)
    kinds = {"run": "text", "a": "number", "b": "number or blank"}
    csv, excel = (read_table(tmp_path / f"t.{ending}", kinds) for ending in ("csv", "xlsx"))
    assert csv["run"].tolist() == ["007", "NA", "x"]
    np.testing.assert_equal(dict(csv), dict(excel))
    for value in (pd.Timestamp("2026-05-01"), True):
        frame.assign(a=value).to_excel(tmp_path / "t.xlsx", index=False)
        with refused("must have finite numbers in the column 'a', but row 2 has"):
            read_table(tmp_path / "t.xlsx", kinds)
