"""Every exported format read back by a reader of its own, to the digits that it prints."""

from __future__ import annotations

import csv
import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pipeline.coefficients import COEFFICIENTS
from pipeline.config.compose import compose_config
from pipeline.data.coefficient_files import read_coefficients
from pipeline.data.tables import write_table
from pipeline.errors import ConfigError, DataError
from pipeline.export.coefficients import Document, Exported, document, tabulate
from pipeline.export.folder import write_for, write_workbook
from pipeline.rotor.bearing_table import BearingTable
from pipeline.units import RAD_S_PER_RPM

RPM = np.array([600.0, 1234.56, 2500.0, 4000.0, 5999.99, 7321.123])
US = 0.45359237 * 9.80665 / 0.0254
"""N/m of 1 lbf/in: international pounds (kg) by the standard acceleration (m/s^2) and inches (m)."""


@pytest.fixture(params=["si", "us"])
def exported(request: pytest.FixtureRequest) -> Exported:
    """Two bearings with all eight coefficients of either sign; cxy and cyx of the second were known."""
    generator = np.random.default_rng(3)
    values = generator.standard_normal((2, len(RPM), 8)) * np.array([1e7] * 4 + [1e4] * 4)
    deviation = np.abs(generator.standard_normal(values.shape))
    identified = np.ones((2, 8), dtype=bool)
    identified[1, [5, 6]] = False
    deviation[1, :, [5, 6]] = np.nan
    return Exported(
        "toy", BearingTable((1, 5), RPM * RAD_S_PER_RPM, values, deviation=deviation), identified, request.param
    )


def scale(exported: Exported) -> float:
    return 1.0 if exported.units == "si" else US


def test_csv_reads_as_known_coefficients(exported: Exported, tmp_path: Path) -> None:
    """Into the project itself, bit by bit; in US units its names are no one's, so that it is not taken for SI."""
    path = write_table(tmp_path / "coefficients.csv", tabulate(exported))
    if exported.units == "us":
        with pytest.raises(DataError, match="must have the column 'kxx'"):
            read_coefficients(path, (1, 5), exported.table.speeds)
        rows = list(csv.DictReader(path.read_text().splitlines()))
        found = np.array([[float(row[f"kxy_lb_per_in{end}"]) for end in ("", "_std")] for row in rows])
        np.testing.assert_allclose(found[:, 0] * US, exported.table.values[..., 1].ravel(), rtol=1e-14)
        np.testing.assert_allclose(found[:, 1] * US, exported.table.deviation[..., 1].ravel(), rtol=1e-14)
        assert rows[-1]["cyx_lb_s_per_in_std"] == ""
        return
    found = read_coefficients(path, (1, 5), exported.table.speeds)
    np.testing.assert_array_equal(found.values, exported.table.values)


def test_dyrobes(exported: Exported) -> None:
    """``N, unit, Nc, kRot, 0, 0, 0 comments``, then a line a speed; unit systems 3 (s, m, N) and 2 (s, in, lbf)."""
    for b in range(2):
        head, *lines = write_for("dyrobes.txt", exported, b).splitlines()
        assert re.match(rf"6, {'3' if exported.units == 'si' else '2'}, 8, 0, 0, 0, 0  toy, node {(1, 5)[b]}: ", head)
        assert len(head) < 200
        assert "from x to y (CCW)" in head
        table = np.array([[float(word) for word in line.split(",")] for line in lines])
        np.testing.assert_allclose(table[:, 0], RPM, atol=5e-7)
        np.testing.assert_allclose(table[:, 1:] * scale(exported), exported.table.values[b], rtol=1e-9)


def test_ansys_bearing_file(exported: Exported) -> None:
    """Fixed columns: three titles of 80, 3I10, then I10 F10.2 and twice 4E15.7 (K11, K12, K21, K22; C11 ..)."""
    lines = write_for("ansys.txt", exported, 1).splitlines()
    assert all(len(line) <= 80 for line in lines)
    assert [int(lines[3][i : i + 10]) for i in (0, 10, 20)] == [6, 0, 1]  # no change of units, rpm into rad/s
    for i, rpm in enumerate(RPM):
        head, stiffness, damping = lines[4 + 3 * i : 7 + 3 * i]
        assert (int(head[:10]), float(head[10:20])) == (i + 1, pytest.approx(rpm, abs=0.00501))
        found = [float(line[15 * k : 15 * k + 15]) for line in (stiffness, damping) for k in range(4)]
        np.testing.assert_allclose(np.array(found) * scale(exported), exported.table.values[1, i], rtol=6e-8)
    assert len(lines) == 4 + 3 * len(RPM)


def interpret(text: str) -> tuple[dict[str, np.ndarray], list[str], list[str]]:
    """What APDL makes of the input: tables (S, 2) of rad/s and values, the real constants, the other commands."""
    tables, constants, others = dict[str, np.ndarray](), list[str](), list[str]()
    for line in text.splitlines():
        if line.startswith("!"):
            continue
        if line.startswith("*DIM"):
            name, kind, rows, *rest = line.split(",")[1:]
            assert (kind, rest) == ("TABLE", ["1", "1", "OMEGS"])
            tables[name] = np.full((int(rows), 2), np.nan)
        elif found := re.fullmatch(r"(\w+)\((\d+),([01])\)=(\S+)", line):
            tables[found[1]][int(found[2]) - 1, int(found[3])] = float(found[4])
        elif line.startswith(("R,", "RMORE,")):
            constants += line.split(",")[1 if line.startswith("RMORE") else 2 :]
        else:
            others.append(line)
    return tables, constants, others


def test_apdl(exported: Exported) -> None:
    """COMBI214 takes K11, K22, K12, K21, C11, C22, C12, C21 in this order, over OMEGS in rad/s."""
    text = write_for("ansys.inp", exported, 1)
    tables, constants, others = interpret(text)
    assert (constants, others) == (
        [f"%{name}_5%" for name in ("K11", "K22", "K12", "K21", "C11", "C22", "C12", "C21")],
        ["ET,6,COMBI214", "KEYOPT,6,2,0", "KEYOPT,6,3,1"],
    )
    assert "! kij is the force along i" in text
    for name, of in zip(COEFFICIENTS, ("K11", "K12", "K21", "K22", "C11", "C12", "C21", "C22"), strict=True):
        found = tables[f"{of}_5"]
        np.testing.assert_allclose(found[:, 0], RPM * RAD_S_PER_RPM, rtol=1e-9)
        np.testing.assert_allclose(found[:, 1] * scale(exported), exported.table.coefficient(name)[1], rtol=1e-9)


def test_apdl_of_one_speed_has_constants(exported: Exported) -> None:
    one = replace(exported, table=replace(exported.table.at(np.array([2])), deviation=None))
    tables, constants, _ = interpret(write_for("ansys.inp", one, 0))
    assert not tables
    found = np.array([float(word) for word in constants]) * scale(exported)
    np.testing.assert_allclose(found, exported.table.values[0, 2, [0, 3, 1, 2, 4, 7, 5, 6]], rtol=1e-9)


def test_json_follows_its_schema(exported: Exported) -> None:
    text = document(exported).model_dump_json()
    found = Document.model_validate_json(text)
    assert found.stiffness_unit == ("N/m" if exported.units == "si" else "lb/in")
    for b, bearing in enumerate(found.bearings):
        assert bearing.speed_rpm == pytest.approx(RPM.tolist())
        for c, name in enumerate(COEFFICIENTS):
            one = bearing.coefficients[name]
            np.testing.assert_allclose(
                np.array(one.value) * scale(exported), exported.table.values[b, :, c], rtol=1e-14
            )
            assert one.identified is not (b == 1 and name in ("cxy", "cyx"))
            assert (one.std is None) is not one.identified
    assert set(Document.model_json_schema()["required"]) == json.loads(text).keys() - {"schema_version"}
    with pytest.raises(ValueError, match="Extra inputs"):
        Document.model_validate_json(text.replace('"experiment"', '"experimant":1,"experiment"', 1))


def test_workbook(exported: Exported, tmp_path: Path) -> None:
    """XLTRC2's layout: names in the sixth row, units below them, then the speeds in rpm."""
    import openpyxl

    path = tmp_path / "coefficients.xlsx"
    write_workbook(path, exported)
    book = openpyxl.load_workbook(path)
    assert book.sheetnames == ["node 1", "node 1 deviations", "node 5", "node 5 deviations", "conventions"]
    rows = list(book["node 5"].iter_rows(values_only=True))
    assert rows[5] == ("Speed", "Kxx", "Kxy", "Kyx", "Kyy", "Cxx", "Cxy", "Cyx", "Cyy")
    assert rows[6][:2] == ("rpm", "N/m" if exported.units == "si" else "lb/in")
    found = np.array(rows[7:], dtype=float)
    np.testing.assert_allclose(found[:, 0], RPM)
    np.testing.assert_allclose(found[:, 1:] * scale(exported), exported.table.values[1], rtol=1e-14)
    assert rows[0][0].startswith("toy, bearing at node 5")
    assert [row[6] for row in book["node 5 deviations"].iter_rows(min_row=8, values_only=True)] == [None] * len(RPM)
    write_workbook(path, replace(exported, name='=HYPERLINK("x")'))
    assert openpyxl.load_workbook(path)["node 1"]["A1"].data_type == "s"


@pytest.mark.slow
def test_ross_reads_the_workbook(exported: Exported, tmp_path: Path) -> None:
    """``from_table`` and ``table_to_toml``; ROSS's own pound per inch has eight digits."""
    from pipeline.rotor.ross_adapter import ross

    path, rs = tmp_path / "coefficients.xlsx", ross()
    write_workbook(path, exported)
    for b, node in enumerate((1, 5)):
        element = rs.BearingElement.from_table(node, path, sheet_name=f"node {node}")
        tolerance = 1e-12 if exported.units == "si" else 2e-8
        np.testing.assert_allclose(element.frequency, RPM * RAD_S_PER_RPM, rtol=1e-12)
        for name in COEFFICIENTS:
            np.testing.assert_allclose(getattr(element, name), exported.table.coefficient(name)[b], rtol=tolerance)
    first = rs.BearingElement.table_to_toml(1, path)
    np.testing.assert_allclose(first["kyx"], exported.table.coefficient("kyx")[0], rtol=2e-8)


@pytest.mark.parametrize(
    ("override", "words"),
    [
        ("export.formats=[ansis]", r"export\.formats.*'ansis'"),
        ("export.units=metric", r"export\.units.*'metric'"),
        ("export.formats=[]", r"export\.formats"),
    ],
)
def test_an_unknown_format_or_unit_is_named(override: str, words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        compose_config([override])
