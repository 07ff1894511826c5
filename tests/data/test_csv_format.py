"""CSV by Arrow, and by Python's own reader that explains what is wrong: both give the same."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from pipeline.data import tables
from pipeline.data.csv_format import CsvConfig, recognize_csv
from pipeline.data.tables import Columns, read_table
from pipeline.errors import DataError

NUMBERS = ("1", "2.5", "-3e-7", "+.5", "0.1")
ODD = (
    "",
    " ",
    "nan",
    "inf",
    "x",
    " 1",
    "1 ",
    "1_0",
    "é",
    "\u2028",
    "\x0b",
    "\x85",
    "#",
    "'",
    '"q"',
    '"',
    "\0",
    "1e400",
    *("1e400", "\t", "true", "NA", "null", "2020-01-01", "1,5", "1;5", "0x10", "1d5", "١", "\ufeff", "01"),
)
KINDS = st.sampled_from(["number", "number or blank", "text"])


@st.composite
def files(draw: st.DrawFn) -> tuple[bytes, dict[str, str], CsvConfig]:
    """What a file holds, what is asked of it, and its format."""
    cells = st.sampled_from(NUMBERS if draw(st.booleans()) else NUMBERS + ODD)
    width, end, mark = draw(st.integers(1, 3)), draw(st.sampled_from(["\n", "\r\n", "\r"])), draw(st.sampled_from(",;"))
    rows = draw(st.lists(st.lists(cells, min_size=width, max_size=width), max_size=4))
    if draw(st.booleans()):
        rows += draw(st.lists(st.lists(cells, max_size=4), max_size=1))
    junk = draw(st.lists(st.sampled_from(["made by: someone", "", "x,y"]), max_size=2))
    lines = [*junk, *(mark.join(row) for row in ([*"abc"[:width]], *rows))]
    content = (end.join(lines) + draw(st.sampled_from(["", end, end + end]))).encode()
    if draw(st.integers(0, 9)) == 0:
        at = draw(st.integers(0, len(content)))
        content = content[:at] + bytes([draw(st.integers(0, 255))]) + content[at + 1 :]
    content = draw(st.sampled_from([b"", b"", b"\xef\xbb\xbf"])) + content
    decimal = draw(st.sampled_from(".,")) if mark == ";" else "."
    kinds = {name: draw(KINDS) for name in "abc"[: draw(st.integers(1, width))]}
    return content, kinds, CsvConfig(delimiter=mark, decimal=decimal, skip_rows=len(junk))


def read_by(reader: Callable[..., object], path: Path, kinds: dict[str, str], text: CsvConfig) -> Columns | str:
    """The table, or the message that refuses it."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(tables, "_read_csv", reader)
        try:
            return read_table(path, kinds, {"c": "number"}, text)
        except DataError as error:
            return str(error)


@pytest.mark.slow
@settings(max_examples=400, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(asked=files())
def test_both_readers_give_the_same(asked: tuple[bytes, dict[str, str], CsvConfig], tmp_path: Path) -> None:
    content, kinds, text = asked
    path = tmp_path / "table.csv"
    path.write_bytes(content)
    fast = read_by(tables._read_csv, path, kinds, text)
    slow = read_by(
        lambda path, columns, text: tables._explain_csv(path, recognize_csv(path, columns, text)), path, kinds, text
    )
    if isinstance(fast, str) or isinstance(slow, str):
        assert fast == slow
        return
    assert fast.keys() == slow.keys()
    for name in fast:
        np.testing.assert_array_equal(fast[name], slow[name])
        assert fast[name].dtype == slow[name].dtype
