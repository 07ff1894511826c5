"""Measured tables: conventions, layouts, probes, damage, and speeds that runs have not in common."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from conftest import assert_says, refused
from damaged import put
from measured_files import CONVENTIONS, PAIR, PROBES, Vectors, long, probes_config, table_config, wide
from reading import DISC, GRID, RPM, RUNOUT, RUNS, TURNS, check_read, long_table, notes, parsed, read, seen, wide_runs

Runs = list[dict[str, Any]]


@pytest.fixture
def runs(tmp_path: Path) -> Runs:
    """Those of the configuration, each with a wide table."""
    return wide_runs(tmp_path)


def test_the_high_spot_of_a_stiff_rotor_is_where_the_unbalance_is(tmp_path: Path) -> None:
    """Far below its critical speed a rotor leans towards its unbalance: probes say so by their lag, in all conventions.

    The unbalance is at s on the shaft from the mark, with the rotation; the mark is at the tacho (T) at the pulse. The
    probe at a sees its highest spot after a rotation of a - (T + s).
    """
    shaft, tacho = 25.0, 70.0
    rows = {"speed": GRID}
    for name, (_, angle) in PROBES.items():
        rows[f"{name} amp"] = np.full(len(GRID), 10.0)
        rows[f"{name} ph"] = np.full(len(GRID), (angle - (tacho + shaft)) % 360)
    pd.DataFrame(rows).to_csv(tmp_path / "a.csv", index=False)
    run = {"name": "a", "file": str(tmp_path / "a.csv"), "unbalances": [DISC | {"phase": f"{shaft} deg"}]}
    dataset = read(table_config([run], shaft_angle="with_rotation", tacho={"angle": f"{tacho} deg"}))
    (force,) = dataset.excitations
    assert force.phase == pytest.approx(np.radians(tacho + shaft))
    lean = 5e-6 * np.exp(1j * force.phase) * np.array([1, -1j, 1, -1j])  # along the force e^{jp} [1, -j]
    assert dataset.displacement[0, :, 0] == pytest.approx(lean)


def test_angles_on_the_shaft() -> None:
    config = parsed(table_config([{"name": "a", "file": "a.csv", "unbalances": [DISC]}], tacho={"angle": 1.0}))
    for sense, angle in (("with_rotation", 1.3), ("against_rotation", 0.7), ("from_x", 0.3)):
        assert config.model_copy(update={"shaft_angle": sense}).angle_from_x(0.3) == pytest.approx(angle)


@pytest.mark.parametrize("ending", [".csv", ".xlsx"])
def test_wide_tables(ending: str, tmp_path: Path) -> None:
    check_read(read(table_config(wide_runs(tmp_path, ending))))


@pytest.mark.parametrize("ending", [".csv", ".xlsx"])
def test_long_tables(ending: str, tmp_path: Path) -> None:
    table = long({name: seen(turn) for name, turn in TURNS.items()} | {"spare": seen()}).sample(frac=1, random_state=1)
    path = tmp_path / f"all{ending}"
    table.to_excel(path, index=False) if ending == ".xlsx" else table.to_csv(path, index=False)
    check_read(read(table_config(RUNS, "long", file=str(path), leave_out=["spare"])))


def test_a_table_as_written_elsewhere(runs: Runs) -> None:
    """Semicolons, decimal commas and lines before the header, said in the configuration."""
    for run in runs:
        path = Path(run["file"])
        path.write_text("made by: someone\n\n" + pd.read_csv(path).to_csv(sep=";", decimal=",", index=False))
    check_read(read(table_config(runs, csv={"delimiter": ";", "decimal": ",", "skip_rows": 2})))


def write_as_a_logger(table: pd.DataFrame) -> list[str]:
    """Lines with a title, the header, units, and numbers with decimal commas and parted thousands."""
    numbers = [[f"{value:_}".replace(".", ",").replace("_", ".") for value in row] for row in table.to_numpy().tolist()]
    units = ["rpm", *["µm pp", "deg lag"] * (len(table.columns) // 2)]
    return ["Plant: Möhne; fan", "", *(";".join(row) for row in (table.columns, units, *numbers))]


def test_the_format_of_a_logger_is_recognised_and_said(runs: Runs) -> None:
    """cp1252, semicolons, decimal commas, thousands, text above the header, units below it: nothing is stated."""
    for run in runs:
        path = Path(run["file"])
        path.write_bytes("\r\n".join([*write_as_a_logger(pd.read_csv(path)), ""]).encode("cp1252"))
    check_read(read(table_config(runs)))
    assert (
        "one.csv' is read as: cp1252, ';' between fields, decimal commas, the header in line 3, units below it, left "
        "out (1) (machine.recordings.csv states another)"
    ) in notes(table_config(runs))
    path.write_bytes(path.read_bytes().replace(b"500,0;", b"5oo,0;", 1))
    with refused("row 5 has '5oo,0'"):
        read(table_config(runs))


def test_a_workbook_with_a_sheet_a_run(tmp_path: Path) -> None:
    runs = [run | {"file": str(tmp_path / "all.xlsx"), "sheet": f"run {run['name']}"} for run in wide_runs(tmp_path)]
    with pd.ExcelWriter(tmp_path / "all.xlsx") as book:
        for run in runs:
            pd.read_csv(tmp_path / f"{run['name']}.csv").to_excel(
                book, sheet_name=run["sheet"], index=False, startrow=2
            )
    check_read(read(table_config(runs)))
    with refused("must have the sheet 'run onee', but it has not: did you mean 'run one'?"):
        read(table_config([runs[0] | {"sheet": "run onee"}]))


def test_other_columns_in_one_run(runs: Runs) -> None:
    path = Path(runs[1]["file"])
    pd.read_csv(path).rename(columns={"A amp": "amplitude 1", "A ph": "phase 1"}).to_csv(path, index=False)
    runs[1] |= {"columns": {"A": {"amplitude": "amplitude 1", "phase": "phase 1"}}}
    check_read(read(table_config(runs)))


def test_interpolation_to_common_speeds(tmp_path: Path) -> None:
    """Runs at other speeds come to the grid, as complex numbers: through the turns of the phase, too."""
    fine = {"one": seen(0.0, np.arange(450.0, 3100.0, 10.0)), "two": seen(1.1, np.arange(500.0, 3001.0, 12.5))}
    section = table_config(wide_runs(tmp_path, **fine), speeds={"start_rpm": 500, "stop_rpm": 3000, "step_rpm": 250})
    check_read(read(section), tolerance=1e-5)
    check_read(read(section | {"interpolation": "linear"}), tolerance=2e-3)


def test_uneven_speeds_are_not_swung_through(tmp_path: Path) -> None:
    """Two rows at nearly one speed with different noise: no cubic overshoots between them."""
    rpm = np.sort(np.append(np.arange(500.0, 3001.0, 100.0), 1500.001))
    noisy = {name: v * np.where(rpm == 1500.001, 1.05, 1.0) for name, v in seen(0.0, rpm).of.items()}
    runs = wide_runs(tmp_path, one=Vectors(rpm, noisy), two=seen(1.1, rpm))
    found = read(table_config(runs, speeds={"start_rpm": 500, "stop_rpm": 3000, "step_rpm": 50}))
    assert np.abs(found.displacement[..., 0]).max() < 1.1 * max(np.abs(v).max() for v in noisy.values()) * 2**0.5


def test_speeds_that_are_nearly_the_same(tmp_path: Path) -> None:
    """Without a grid, speeds of two runs are one where they differ by less than 0.1 %."""
    runs = wide_runs(tmp_path, two=Vectors(GRID * 1.0004, seen(1.1).of))
    assert read(table_config(runs)).speeds == pytest.approx(GRID * 1.0002 * RPM, rel=1e-9)


Damage = Callable[[pd.DataFrame], pd.DataFrame | str]
BAD_TABLES: dict[str, tuple[Damage, str, str]] = {
    "NaN": (put("A amp", np.nan), "must have finite numbers in the column 'A amp'", "row 6"),
    "infinite": (put("B ph", np.inf), "must have finite numbers in the column 'B ph'", "row 6"),
    "text": (put("speed", "fast"), "must have finite numbers in the column 'speed'", "'fast'"),
    "negative amplitude": (put("A amp", -2.0), "must have amplitudes of zero or more", "'A amp'"),
    "no speed": (put("speed", 0.0), "must have speeds above zero", "0 rpm"),
    "a speed twice": (put("speed", 500.0), "must have one row a speed, but 500 rpm is there twice", "average"),
    "all rows twice": (lambda t: pd.concat([t, t]), "must have one row a speed", "twice"),
    "a column under another name": (
        lambda t: t.rename(columns={"A amp": "A ampl"}),
        "must have the column 'A amp', but it has not: did you mean 'A ampl'?",
        "known",
    ),
    "a column twice": (
        lambda t: t.assign(more=1.0).to_csv(index=False).replace("more", "A amp", 1),
        "must have the column 'A amp' once",
        "twice",
    ),
    "no rows": (lambda t: t.iloc[:0], "must have at least one row", ""),
    "another delimiter": (lambda t: t.to_csv(index=False, sep=":"), "must have the column 'speed'", "speed:A amp"),
    "decimal commas": (
        lambda t: t.to_csv(index=False).replace(".", ","),
        "must be a CSV table",
        "",
    ),
    "empty": (lambda t: "", "must be a CSV table", ""),
    "binary": (lambda t: "\x00\x01\x02", "must", ""),
    "a row cut off": (lambda t: t.to_csv(index=False)[:-60], "must", ""),
}


@pytest.mark.parametrize("case", BAD_TABLES)
def test_a_damaged_table_is_refused(case: str, runs: Runs) -> None:
    damage, words, more = BAD_TABLES[case]
    path = Path(runs[1]["file"])
    damaged = damage(pd.read_csv(path))
    path.write_text(damaged) if isinstance(damaged, str) else damaged.to_csv(path, index=False)
    with refused(words, more, str(path)):
        read(table_config(runs))


def test_a_truncated_excel_file_is_refused(tmp_path: Path) -> None:
    runs = wide_runs(tmp_path, ".xlsx")
    path = Path(runs[0]["file"])
    for content in (path.read_bytes()[:-700], b"PK\x03\x04" + bytes(200), b"speed,A amp\n"):
        path.write_bytes(content)
        with refused("must be a complete Excel file", str(path)):
            read(table_config(runs))


@pytest.mark.parametrize(
    ("unit", "span", "said"),
    [
        ("rpm", (3100, 3600), "is 11 speeds from 500 to 3000 rpm"),
        (
            "Hz",
            (600, 3000),
            "speeds that are 60 times too large are rpm called Hz (machine.recordings.conventions.speed)",
        ),
        ("rad/s", (600, 3000), "speeds that are 9.55 times too large are rpm called rad/s"),
        ("rpm", (30000, 180000), "speeds that are 60 times too small are Hz called rpm"),
    ],
)
def test_a_speed_range_that_a_run_does_not_cover(unit: str, span: tuple[int, int], said: str, tmp_path: Path) -> None:
    section = table_config(wide_runs(tmp_path), speeds={"start_rpm": span[0], "stop_rpm": span[1], "step_rpm": 100})
    section["conventions"] |= {"speed": unit}
    with refused("the speed range of run 'one'", said, "nothing is extrapolated"):
        read(section)


def test_runs_of_a_long_table_and_of_the_configuration(tmp_path: Path) -> None:
    section = long_table(tmp_path, long({name: seen(turn) for name, turn in TURNS.items()} | {"three": seen()}))
    with refused("'three' is not among them", "machine.recordings.leave_out"):
        read(section)
    probes = probes_config() | {"AA": {"node": 1, "angle": "0 deg"}, "AB": {"node": 1, "angle": "90 deg"}}
    for changes, *words in (
        ({"runs": [*RUNS, {"name": "onee", "unbalances": [DISC]}]}, "rows of run 'onee'", "did you mean 'one'?"),
        ({"probes": probes}, "rows of probe 'AA' in run 'one'"),
    ):
        with refused("must have", *words):
            read(section | {"leave_out": ["three"]} | changes)


def test_the_last_line_of_a_cut_table_is_warned_of(runs: Runs) -> None:
    """What was cut within its last number can't be seen otherwise."""
    path = Path(runs[0]["file"])
    path.write_text(path.read_text().rstrip("\n")[:-2])
    assert "does not end with the end of a line" in notes(table_config(runs))


@pytest.mark.parametrize(("written", "said"), [("rad", "deg"), ("deg", "rad")])
def test_phases_of_the_other_unit_are_warned_of(written: str, said: str, runs: Runs) -> None:
    """Radians that are called degrees stay within a turn in radians and yet differ widely; and the reverse."""
    for run in runs:
        wide(seen(TURNS[run["name"]]), CONVENTIONS | {"phase_unit": written}).to_csv(run["file"], index=False)
    words = "in radians" if said == "deg" else "in degrees"
    assert words in notes(table_config(runs, conventions=CONVENTIONS | {"phase_unit": said}))
    assert words not in notes(table_config(runs, conventions=CONVENTIONS | {"phase_unit": written}))


def test_lengths_that_are_a_thousand_times_too_large(tmp_path: Path) -> None:
    with refused("must have amplitudes below 1 m, but got", "check the unit", "one.csv"):
        read(table_config(wide_runs(tmp_path), conventions=CONVENTIONS | {"length": "m"}))


@pytest.mark.parametrize(
    ("probes", "angles"),
    [
        ({"A": (0, 45.0), "C": (2, 0.0), "D": (2, 90.0)}, [45.0]),
        ({"A": (0, 0.0), "B": (0, 180.0), "C": (2, 0.0), "D": (2, 90.0)}, [0.0, 180.0]),
        ({"A": (0, -40.0), "B": (0, 325.0), "E": (0, -35.0), "C": (2, 0.0), "D": (2, 90.0)}, [320.0, 325.0]),
    ],
)
def test_probes_that_do_not_give_x_and_y_stay_as_they_are(
    probes: dict[str, Any], angles: list[float], runs: Runs
) -> None:
    """Two of the same direction are averaged; x and y of the other node are as before."""
    for run in runs:
        wide(seen(TURNS[run["name"]], probes=probes)).to_csv(run["file"], index=False)
    section = table_config(runs, probes=probes_config(probes, **PAIR))
    dataset, turn = read(section), TURNS["one"]
    assert dataset.channels == (*((0, angle) for angle in angles), (2, 0.0), (2, 90.0))
    for p, (node, angle) in enumerate(dataset.channels):
        expected = seen(turn, probes={"A": (node, angle)}).of["A"]
        np.testing.assert_allclose(dataset.displacement[:, p, 0], expected, rtol=1e-6)
    assert "the probes at node 0 look along one line" in notes(section)
    assert "the probes at node 2 look" not in notes(section)


def test_three_probes_at_a_node(runs: Runs) -> None:
    probes = PROBES | {"E": (0, 100.0)}
    for sign, warned in ((1.0, False), (-1.0, True)):
        for run in runs:
            vectors = seen(TURNS[run["name"]], probes=probes).of
            wide(Vectors(GRID, {**vectors, "E": sign * vectors["E"]})).to_csv(run["file"], index=False)
        section = table_config(runs, probes=probes_config(probes, **PAIR))
        assert ("the probes at node 0 contradict each other" in notes(section)) is warned
        if not warned:
            check_read(read(section))


def test_a_baseline_run_has_data_and_no_excitation(runs: Runs, tmp_path: Path) -> None:
    base = tmp_path / "base.csv"
    wide(seen(2.0)).to_csv(base, index=False)
    dataset = read(table_config([{"name": "as found", "file": str(base)}, *runs], baseline="as found"))
    assert (dataset.runs, {e.run for e in dataset.excitations}) == (("as found", "one", "two"), {"one", "two"})


def test_slow_roll_runout_is_subtracted(runs: Runs) -> None:
    for run in runs:
        turning = seen(TURNS[run["name"]]).of
        of = {name: np.append(np.full(3, RUNOUT[name]), v + RUNOUT[name]) for name, v in turning.items()}
        wide(Vectors(np.append([100.0, 150.0, 200.0], GRID), of)).to_csv(run["file"], index=False)
    speeds = {"start_rpm": 500, "stop_rpm": 3000, "step_rpm": 250}
    check_read(read(table_config(runs, speeds=speeds, slow_roll={"below_rpm": 300})), 1e-9)
    explicit = {
        "vectors": {
            name: {"amplitude": f"{2 * abs(v) / 25.4e-6} mil", "phase": f"{-np.degrees(np.angle(v))} deg"}
            for name, v in RUNOUT.items()
        },
        "amplitude": "peak_to_peak",
        "phase": "lag",
    }
    check_read(read(table_config(runs, speeds=speeds, slow_roll=explicit)), 1e-9)
    with refused("run 'one' must have speeds below machine.recordings.slow_roll.below_rpm=50", "the lowest is 100 rpm"):
        read(table_config(runs, speeds=speeds, slow_roll={"below_rpm": 50}))


def test_forces_of_either_whirl_and_of_their_own_frequency(runs: Runs) -> None:
    """A run may be excited by forces; an asynchronous one is written with its frequency."""
    runs[1] = {
        "name": "two",
        "file": runs[1]["file"],
        "forces": [{"node": 1, "magnitude": "12 N", "phase": "20 deg", "whirl": "backward"}],
        "frequency_ratio": 0.5,
    }
    dataset = read(table_config(runs))
    force = dataset.excitations[1]
    assert (force.whirl, force.phase) == ("backward", pytest.approx(np.radians(20)))
    assert dataset.frequencies == pytest.approx(dataset.speeds[:, None] * [1.0, 0.5])


def test_how_many_readings_each_run_has_is_said(tmp_path: Path) -> None:
    """Rows as they are, those of 0.03 % apart as one; or interpolated, each run within its range."""
    runs = wide_runs(tmp_path, two=seen(1.1, np.append(GRID[2:8] * 1.0003, 2900.0)))
    found = read(table_config(runs))
    assert (found.present.sum(axis=0).tolist(), len(found.speeds)) == ([11, 7], 12)
    said = "not every run was measured at each of the 12 speeds: 'one' at 11, 'two' at 7; what is not there is left out"
    assert_says(notes(table_config(runs)), said)
    drawn = table_config(runs, speeds={"start_rpm": 600, "stop_rpm": 3600, "step_rpm": 100})
    found = read(drawn)
    assert found.speeds == pytest.approx(np.arange(600, 3001, 100) * RPM)
    assert [span.tolist() for span in found.present.T] == [[True] * 25, [False] * 5 + [True] * 19 + [False]]
    assert_says(
        notes(drawn),
        "each of the 31 speeds: 'one' at 25, 'two' at 19",
        "runs were interpolated to more speeds than they were measured at ('one' from 11 to 25, 'two' from 7 to 19)",
    )


def test_a_probe_that_lacks_a_speed_of_its_run_is_refused(tmp_path: Path) -> None:
    table = long({run["name"]: seen() for run in RUNS})
    lacking = (table["probe"] == "B") & (table["run"] == "two") & (table["speed"] == 750.0)
    with refused("every probe of a run must have the same speeds, but run 'two' has 750 rpm at probe 'A'"):
        read(long_table(tmp_path, table[~lacking]))
