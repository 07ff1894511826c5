"""Export of a machine with operating conditions: rows, sheets and files a state, and the numbers of its laws."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from warm_rotor import CELSIUS, SPEEDS, warm_bearings, warm_machine

from pipeline.config.compose import compose_config
from pipeline.data.coefficient_files import read_coefficients
from pipeline.data.tables import write_table
from pipeline.errors import ConfigError
from pipeline.export.coefficients import Document, Exported, Number, document, list_conventions, tabulate
from pipeline.export.folder import list_states, write_for, write_workbook

NUMBERS = [Number(name="node 8 radial clearance", value=99.9, std=0.07, unit="um")]


@pytest.fixture
def states() -> list[Exported]:
    """Both bearings at 45 and 70 degC."""
    tables = {celsius: warm_bearings(SPEEDS, np.full(len(SPEEDS), celsius)) for celsius in (45.0, 70.0)}
    every = np.ones((2, 8), dtype=bool)
    return [
        Exported(
            "toy", replace(table, deviation=0.1 * table.values), every, "si", {"oil_temperature": celsius + 273.15}
        )
        for celsius, table in tables.items()
    ]


def configured(operating: tuple[dict[str, float], ...] = ()) -> Any:
    return SimpleNamespace(export=SimpleNamespace(operating=operating))


def test_states_are_the_measured_ones_unless_others_are_asked_for() -> None:
    data = warm_machine()[0].dataset
    assert [one["oil_temperature"] - 273.15 for one in list_states(configured(), data)] == pytest.approx(CELSIUS)
    asked = ({"oil_temperature": 343.15},)
    assert list_states(configured(operating=asked), data) == list(asked)
    with pytest.raises(ConfigError, match=r"export\.operating must name conditions of the data, but got load"):
        list_states(configured(operating=({"load": 1.0},)), data)
    assert list_states(configured(), replace(data, operating={})) == [{}]


@pytest.mark.slow
def test_states_of_the_configuration_have_units() -> None:
    config = compose_config(["experiment=ball_bearing", "+export.operating=[{oil_temperature: 70 degC, load: 1 kN}]"])
    assert config.export.operating == ({"oil_temperature": 343.15, "load": 1000.0},)
    with pytest.raises(ConfigError, match="oil_temperature must convert to kelvin"):
        compose_config(["experiment=ball_bearing", "+export.operating=[{oil_temperature: 70 mm}]"])


def test_the_csv_has_a_column_a_condition_and_reads_back(states: list[Exported], tmp_path: Path) -> None:
    path = write_table(tmp_path / "coefficients.csv", tabulate(*states))
    assert path.read_text().splitlines()[0].startswith("bearing_node,speed_rpm,oil_temperature_degC,kxx")
    for one in states:
        found = read_coefficients(path, (0, 5), one.table.speeds, operating=one.table.operating)
        np.testing.assert_array_equal(found.values, one.table.values)


def test_json_and_workbook_have_every_state_and_the_numbers(states: list[Exported], tmp_path: Path) -> None:
    import openpyxl

    found = Document.model_validate_json(document(*states, numbers=NUMBERS).model_dump_json())
    kept = [(one.node, one.operating["oil_temperature_degC"]) for one in found.bearings]
    assert kept == [(0, 45.0), (5, 45.0), (0, 70.0), (5, 70.0)]
    assert found.physical_numbers == NUMBERS
    write_workbook(tmp_path / "coefficients.xlsx", *states, numbers=NUMBERS)
    book = openpyxl.load_workbook(tmp_path / "coefficients.xlsx")
    assert book.sheetnames[:2] == ["node 0, 45 degC", "node 0, 45 degC deviations"]
    assert book.sheetnames[-2:] == ["physical numbers", "conventions"]
    assert [cell.value for cell in book["physical numbers"][2]] == ["node 8 radial clearance", 99.9, 0.07, "um"]
    rows = list(book["node 5, 70 degC"].iter_rows(min_row=8, values_only=True))
    np.testing.assert_allclose(np.array(rows, dtype=float)[:, 1:], states[1].table.values[1])


def test_formats_of_the_speed_alone_name_the_state(states: list[Exported]) -> None:
    assert [one.suffix for one in states] == ["_45_degC", "_70_degC"]
    assert "toy, 70 degC, node 5" in write_for("dyrobes.txt", states[1], 1)
    assert list_conventions(states)[0].startswith("toy: identified")
    assert list_conventions(states)[-1] == "States: 45 degC; 70 degC."


def test_what_is_not_determined_is_named_with_its_speeds(states: list[Exported]) -> None:
    """A deviation of half of kxx below the third speed; the others are far below their coefficients."""
    state, rpm = states[0], states[0].rpm
    deviation = 1e-3 * np.abs(state.table.values)
    deviation[1, :2, 0] = 0.5 * np.abs(state.table.values[1, :2, 0])
    line = list_conventions([replace(state, table=replace(state.table, deviation=deviation))])[-1]
    assert line == (
        f"Not determined by these data, stated for completeness (45 degC): kxx at node 5 below {rpm[2]:.4g} rpm."
    )
