"""Vibration files: rows in any order, points that are joined, conditions of readings, and what may not be there."""

from __future__ import annotations

import csv
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from conftest import MachineFactory, refused
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from problem.test_identifiability import FEW
from reading import read_rows
from small_rotor import small_machine

from pipeline import default_setup, fit
from pipeline.data.dataset import EVERYWHERE, Excitation, VibrationDataset
from pipeline.data.excitation_files import write_excitation
from pipeline.data.operating import spread_states
from pipeline.data.simulate import simulate
from pipeline.data.vibration_files import read_measured, write_vibration
from pipeline.units import RAD_S_PER_RPM

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


POINT_CHANNELS = ((0, 0.0), (0, 90.0))


RUNS = ("a", "b")


ACTING = tuple(Excitation(run, "unbalance", 1, 1e-4, 0.1) for run in RUNS)


KELVIN, LOADS = (318.15, 328.15), (500.0, 750.0)


def dataset_at(
    speeds: np.ndarray, operating: dict[str, np.ndarray], present: np.ndarray = EVERYWHERE
) -> VibrationDataset:
    """Readings that tell their points apart."""
    random = np.random.default_rng(len(speeds))
    shape = (len(speeds), len(POINT_CHANNELS), len(RUNS))
    values = 1e-6 * (random.normal(size=shape) + 1j * random.normal(size=shape)) * present[:, None]
    return VibrationDataset(speeds, RUNS, POINT_CHANNELS, values, ACTING, operating=operating, present=present)


def grid() -> VibrationDataset:
    """Two speeds at two temperatures and two loads."""
    speeds = np.array([100.0, 200.0]) * RAD_S_PER_RPM
    return dataset_at(*spread_states(speeds, {"oil_temperature": KELVIN, "load": LOADS}))


def rows_of(dataset: VibrationDataset, folder: Path) -> tuple[Path, list[list[str]]]:
    """Both files; the path of the first and its rows."""
    write_excitation(folder / "excitation.csv", dataset)
    path = write_vibration(folder / "vibration.csv", dataset)
    return path, list(csv.reader(path.read_text().splitlines()))


@settings(max_examples=8, deadline=None)
@given(
    rpm=st.lists(st.integers(1, 60), min_size=1, max_size=4, unique=True),
    celsius=st.lists(st.integers(-300, 1500), min_size=2, max_size=3, unique=True),
    bar=st.lists(st.integers(1, 90), min_size=1, max_size=2, unique=True),
    ending=st.sampled_from(["csv", "parquet"]),
    seed=st.integers(0, 9),
)
def test_what_is_written_is_read_in_the_same_order_whatever_the_order_of_the_rows(
    rpm: list[int],
    celsius: list[int],
    bar: list[int],
    ending: str,
    seed: int,
    tmp_path_factory: pytest.TempPathFactory,
) -> None:
    """Runs may lack points; conditions come first in the order, then the speed."""
    folder = tmp_path_factory.mktemp("points")
    states = {"oil_temperature": [0.1 * c + 273.15 for c in celsius], "oil_supply_pressure": [1e4 * b for b in bar]}
    speeds, operating = spread_states(np.sort(rpm) * 100 * RAD_S_PER_RPM, states)
    random = np.random.default_rng(seed)
    present = random.random((len(speeds), 2)) < 0.7
    present[np.flatnonzero(~present.any(axis=1)), 0] = True
    present[0] = True  # both runs were measured somewhere
    before = dataset_at(speeds, operating, present)
    write_excitation(folder / "excitation.csv", before)
    found = read_measured(write_vibration(folder / f"vibration.{ending}", before), folder / "excitation.csv")
    np.testing.assert_allclose(found.speeds, speeds, rtol=1e-12)
    np.testing.assert_allclose(found.displacement, before.displacement, rtol=1e-9, atol=1e-20)
    assert tuple(found.operating) == ("oil_temperature", "oil_supply_pressure")
    for name, values in operating.items():
        np.testing.assert_allclose(found.operating[name], values, rtol=1e-11)
    assert (found.present == present).all()
    if ending == "csv":
        header, *rows = csv.reader((folder / "vibration.csv").read_text().splitlines())
        again = read_rows(folder, [header, *(rows[i] for i in random.permutation(len(rows)))])
        assert again.fingerprint == found.fingerprint


def test_columns_are_named_with_the_units_of_an_engineer(tmp_path: Path) -> None:
    _, (header, first, *_) = rows_of(grid(), tmp_path)
    assert (header[:4], first[:4]) == (
        ["run", "speed_rpm", "oil_temperature_degC", "load_N"],
        ["a", "100.0", "45.0", "500.0"],
    )


def test_other_units_and_names_of_other_programs_are_read(tmp_path: Path) -> None:
    _, (header, *rows) = rows_of(grid(), tmp_path)
    own = [[*header[:2], "oil_temperature_degF", "drain_degC", "comment", *header[4:]]]
    own += [[*row[:2], str(1.8 * float(row[2]) + 32), row[3], "x", *row[4:]] for row in rows]
    found = read_rows(tmp_path, own)
    np.testing.assert_allclose(np.unique(found.operating["oil_temperature"].round(9)), KELVIN)
    assert set(found.operating) == {"oil_temperature", "drain_degC"}
    assert rows_of(found, tmp_path)[0].read_text().startswith("run,speed_rpm,oil_temperature_degC,drain_degC,")


Rows = list[list[str]]


def _name(column: str) -> Callable[[Rows], Rows]:
    """The column of the temperature under another name."""
    return lambda rows: [[column if name == "oil_temperature_degC" else name for name in rows[0]], *rows[1:]]


def _read_as(row: int, text: str) -> Callable[[Rows], Rows]:
    """Another temperature in a row."""
    return lambda rows: [[*r[:2], text, *r[3:]] if i == row else r for i, r in enumerate(rows)]


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (_name("oil_temperature"), "unit in the name of the column 'oil_temperature', but it has none: call it"),
        (_name("oil_temperature_C"), "a unit of temperature at the end of 'oil_temperature_C', but got 'C'"),
        (_name("oil_temperature_N"), "call it oil_temperature_degC"),
        (_name("load_kg"), "a unit of load at the end of 'load_kg', but got 'kg': call it load_N"),
        (_read_as(6, ""), "oil_temperature in every row, but row 6 has none (run 'a', 100 rpm; 1 rows in all)"),
        (_read_as(3, "-999"), "above absolute zero in the column 'oil_temperature_degC', but row 3 has -999"),
        (lambda rows: [*rows, rows[1]], "one row a run, speed, operating conditions, node and direction"),
        (lambda rows: [*rows, rows[1]], "100 rpm, 45 degC, 500 N, node 0 x"),
    ],
)
def test_conditions_that_break_a_law_are_refused(change: Callable[[Rows], Rows], words: str, tmp_path: Path) -> None:
    _, rows = rows_of(grid(), tmp_path)
    with refused(words):
        read_rows(tmp_path, change(rows))


def test_a_run_may_lack_points_but_not_channels(tmp_path: Path) -> None:
    _, (header, *rows) = rows_of(grid(), tmp_path)
    found = read_rows(tmp_path, [header, *rows[2:]])
    assert (found.complete, found.present.tolist()) == (False, [[False, True], *[[True, True]] * 7])
    assert (found.displacement[0, :, 0] == 0).all()
    with refused("every channel at every speed of a run", "run 'a', 100 rpm, 45 degC, 500 N, node 0 x"):
        read_rows(tmp_path, [header, *rows[1:]])
    single = read_rows(tmp_path, [header, *[row for row in rows if row[2:4] == ["45.0", "500.0"]][2:]])
    assert single.present.tolist() == [[False, True], [True, True]]


def test_conditions_within_the_tolerance_are_one_point_with_their_mean(tmp_path: Path) -> None:
    """The oil is never quite as warm in the next run."""
    _, (header, *rows) = rows_of(grid(), tmp_path)
    rows = [[*row[:2], str(float(row[2]) + 0.3 * (row[0] == "b")), *row[3:]] for row in rows]
    apart = read_rows(tmp_path, [header, *rows])
    joined = read_rows(tmp_path, [header, *rows], same={"oil_temperature": 0.31})
    assert (apart.complete, len(apart.speeds), apart.present.sum()) == (False, 16, 16)
    assert joined.complete
    np.testing.assert_allclose(np.unique(joined.operating["oil_temperature"]), [318.3, 328.3])
    np.testing.assert_allclose(joined.displacement, grid().displacement, rtol=1e-9)


def test_the_baseline_must_be_measured_where_the_others_are(tmp_path: Path) -> None:
    _, (header, *rows) = rows_of(grid(), tmp_path)
    (tmp_path / "excitation.csv").write_text("run,kind,node,magnitude,phase_deg,whirl\na,unbalance,1,1e-4,0,forward\n")
    of_a, of_b = ([row for row in rows if row[0] == run] for run in RUNS)
    found = read_rows(tmp_path, [header, *of_a[2:], *of_b], baseline="b")  # 'b' alone was measured at the first point
    assert (found.runs, len(found.speeds), found.complete) == (("a",), 7, True)
    assert found.subtracted is not None
    with refused(
        "the baseline 'b' must be measured at the speeds and conditions of the other runs", "run 'a', 100 rpm"
    ):
        read_rows(tmp_path, [header, *of_a, *of_b[2:]], baseline="b")


def test_frequencies_go_through_the_files(machine: MachineFactory, tmp_path: Path) -> None:
    """A column of the vibration file; blank and absent mean synchronous."""
    from pipeline.data.excitation_files import write_excitation
    from pipeline.data.vibration_files import read_dataset, write_vibration

    runs = (
        "[{name: a, unbalances: [{node: 2, magnitude: 1e-4}]}, "
        "{name: b, forces: [{node: 4, magnitude: 10}], frequency_hz: 40}]"
    )
    made = machine("experiment=all_coefficients", *FEW, f"machine.runs={runs}")
    vibration, excitation = tmp_path / "v.csv", tmp_path / "e.csv"
    write_vibration(vibration, made.dataset, {"rotor": made.rotor.fingerprint})
    write_excitation(excitation, made.dataset)
    read = read_dataset(vibration, excitation, made.rotor)
    np.testing.assert_allclose(read.frequencies, made.dataset.frequencies, rtol=1e-12)
    text = vibration.read_text().splitlines()
    blank = [",".join([*line.split(",")[:-1], ""]) if line.startswith("a,") else line for line in text]
    vibration.write_text("\n".join(blank) + "\n")
    np.testing.assert_allclose(read_dataset(vibration, excitation, made.rotor).frequencies, read.frequencies, rtol=1e-9)
