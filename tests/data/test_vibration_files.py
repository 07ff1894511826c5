"""The order of the rows of vibration.csv means nothing."""

from __future__ import annotations

import csv
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from conftest import refused
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from reading import read_rows
from small_rotor import small_machine

from pipeline import default_setup, fit
from pipeline.data.dataset import Excitation, VibrationDataset
from pipeline.data.excitation_files import write_excitation
from pipeline.data.simulate import simulate
from pipeline.data.vibration_files import read_measured, write_vibration

CHANNELS = ((0, 0.0), (0, 90.0), (2, 45.0))
FREQUENCIES = np.array([[30.0, 30.0, 55.0], [60.0, 60.0, 55.0], [90.0, 90.0, 55.0]])


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A baseline, a run with two weights and a run of a force with a frequency of its own."""
    folder = tmp_path_factory.mktemp("rows")
    random = np.random.default_rng(3)
    dataset = VibrationDataset(
        FREQUENCIES[:, 0],
        ("found", "weights", "force"),
        CHANNELS,
        1e-6 * (random.normal(size=(3, 3, 3)) + 1j * random.normal(size=(3, 3, 3))),
        (
            Excitation("weights", "unbalance", 1, 2e-4, 0.3),
            Excitation("weights", "unbalance", 2, 1e-4, -1.1),
            Excitation("force", "force", 1, 5.0, 0.0, "backward"),
        ),
        FREQUENCIES,
    )
    write_vibration(folder / "vibration.csv", dataset)
    write_excitation(folder / "excitation.csv", dataset)
    return folder


def table(files: Path) -> list[list[str]]:
    return list(csv.reader((files / "vibration.csv").read_text().splitlines()))


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=40, deadline=None)
@given(order=st.permutations(range(27)))
def test_rows_in_any_order_are_the_same_measurement_bit_for_bit(order: list[int], files: Path) -> None:
    """Channel by channel, descending, or mixed: what a fit reads does not change."""
    header, *rows = table(files)
    sorted_one = read_measured(files / "vibration.csv", files / "excitation.csv", "found", 3)
    found = read_rows(files, [header, *(rows[i] for i in order)], "found", 3)
    assert (found.fingerprint, found.runs) == (sorted_one.fingerprint, ("weights", "force"))
    assert (np.diff(found.speeds) > 0).all()
    for ours, theirs in zip(vars(sorted_one).values(), vars(found).values(), strict=True):
        np.testing.assert_array_equal(ours, theirs)


@pytest.mark.parametrize("row", [0, 13, 26])
def test_a_row_that_is_there_twice_is_named(row: int, files: Path) -> None:
    header, *rows = table(files)
    run, rpm, node, direction = rows[row][:4]
    words = f"the first: run '{run}', {float(rpm):g} rpm, node {node} {direction})"
    with refused("must have one row a run, speed, node and direction", words):
        read_rows(files, [header, *rows[::-1], rows[row]], "found", 3)


@pytest.mark.slow
def test_a_standing_rotor_that_is_pushed_tells_its_bearings(tmp_path: Path) -> None:
    """Files of 12 frequencies at 0 rpm, modelled and without noise, give back what they were made with."""
    made, bearings = small_machine((1e6, 0, 0, 2e6, 2e3, 0, 0, 1e3), speeds=np.zeros(1))
    frequencies = 2 * np.pi * np.linspace(20, 60, 12)[None]
    forces = tuple(Excitation(f"{w:.0f}", "force", 2, 10.0, 0.0) for w in frequencies[0])
    write_vibration(tmp_path / "vibration.csv", data := simulate(made.rotor, bearings, forces, frequencies))
    write_excitation(tmp_path / "excitation.csv", data)
    read = read_measured(tmp_path / "vibration.csv", tmp_path / "excitation.csv")
    answer = fit(replace(made, dataset=read), default_setup(made.guess, constant=True))
    assert answer.table(bearings).values == pytest.approx(bearings.values, rel=1e-5)
