"""Files of coefficients: there and back by speed and conditions, and at conditions that they do not name."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from conftest import refused
from reading import RPM

from data.test_vibration_files import KELVIN, grid
from pipeline.data.coefficient_files import read_coefficients, write_coefficients
from pipeline.rotor.bearing_table import BearingTable
from pipeline.units import RAD_S_PER_RPM


def test_coefficients_there_and_back_by_speed_and_conditions(tmp_path: Path) -> None:
    data = grid()
    values = np.random.default_rng(1).normal(size=(2, len(data.speeds), 8))
    table = BearingTable((1, 5), data.speeds, values, dict(data.operating))
    path = write_coefficients(tmp_path / "k.csv", table)
    assert path.read_text().startswith("bearing_node,speed_rpm,oil_temperature_degC,load_N,kxx,")
    some = np.array([6, 1, 3])
    found = read_coefficients(
        path, (5, 1), data.speeds[some], operating={name: values[some] for name, values in data.operating.items()}
    )
    np.testing.assert_array_equal(found.values, table.values[::-1][:, some])
    warm = {"oil_temperature": np.array([338.15]), "load": np.array([500.0])}
    with refused("65 degC, 500 N, must have every speed of the data, but 1 are missing (the first: 100 rpm)"):
        read_coefficients(path, (1,), data.speeds[:1], operating=warm)
    with refused("which that lacks"):
        read_coefficients(path, (1,), data.speeds[:1])


def test_known_coefficients_hold_at_all_conditions_or_at_their_own(tmp_path: Path) -> None:
    path, of = tmp_path / "known.csv", {1: ("cxx",)}
    rpm = np.array([100.0, 200.0, 100.0, 200.0]) * RAD_S_PER_RPM
    operating = {"oil_temperature": np.repeat(KELVIN, 2)}
    path.write_text("bearing_node,speed_rpm,cxx\n1,100,3\n1,300,5\n")
    assert read_coefficients(path, (1,), rpm, of, operating, True).values[0, :, 4] == pytest.approx([3, 4, 3, 4])
    path.write_text("bearing_node,speed_rpm,oil_temperature_degC,cxx\n1,100,55,6\n1,100,45,3\n1,300,45,5\n1,300,55,8\n")
    assert read_coefficients(path, (1,), rpm, of, operating, between=True).values[0, :, 4] == pytest.approx(
        [3, 4, 6, 7]
    )
    with refused("bearing at node 1, 65 degC, must have rows at the conditions of the data"):
        read_coefficients(path, (1,), rpm, of, {"oil_temperature": np.full(4, 338.15)}, between=True)
    with refused(
        "must have every operating condition of the vibration or none, but it has oil_temperature and not load"
    ):
        read_coefficients(path, (1,), rpm, of, operating | {"load": np.full(4, 500.0)}, between=True)


def test_known_coefficients_at_other_speeds(tmp_path: Path) -> None:
    rpm = np.linspace(500, 3000, 21)
    frame = pd.DataFrame({"bearing_node": 0, "speed_rpm": rpm, "cxx": 100 + (rpm / 1000) ** 2})
    frame.to_csv(tmp_path / "known.csv", index=False)
    asked = np.array([600.0, 2222.0]) * RPM
    found = read_coefficients(tmp_path / "known.csv", (0,), asked, {0: ("cxx",)}, between=True)
    assert found.coefficient("cxx")[0] == pytest.approx([100.36, 100 + 2.222**2])
