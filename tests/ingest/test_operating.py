"""Operating conditions of recordings: of a run, in a file, in a column; recordings that become one run."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from conftest import refused
from measured_files import long, table_config, wide
from pydantic import ValidationError
from reading import DISC, GRID, RPM, RUNS, check_read, long_table, notes, parsed, read, response, seen, waves, wide_runs

from pipeline.data.dataset import VibrationDataset
from pipeline.ingest.dataset import read_measured_runs
from pipeline.ingest.operating import find_conditions
from pipeline.ingest.tracks import RunTracks, Track

STATES = (45.0, 65.0)
KELVIN = [celsius + 273.15 for celsius in STATES]


def at(celsius: float) -> dict[str, Any]:
    return {"operating": {"oil_temperature": f"{celsius} degC"}}


def recordings(folder: Path, name: str = "{run} at {celsius:g}") -> list[dict[str, Any]]:
    """Both runs at both temperatures: the warmer one turned further."""
    runs = []
    for run in RUNS:
        for celsius in STATES:
            path = folder / f"{run['name']}{celsius:g}.csv"
            wide(seen((run["name"] == "two") * 1.1 + celsius / 100)).to_csv(path, index=False)
            runs.append(run | at(celsius) | {"name": name.format(run=run["name"], celsius=celsius), "file": str(path)})
    return runs


def check_states(found: VibrationDataset, runs: tuple[str, ...]) -> None:
    assert (found.runs, found.complete) == (runs, True)
    np.testing.assert_allclose(found.speeds, np.tile(GRID * RPM, 2))
    np.testing.assert_allclose(found.operating["oil_temperature"], np.repeat(KELVIN, len(GRID)))
    for r, turn in enumerate((0.0, 1.1)):
        true = np.concatenate([response(0, turn + celsius / 100)[0] for celsius in STATES])
        np.testing.assert_allclose(found.displacement[:, 0, r], true, rtol=1e-9)


def test_recordings_of_one_excitation_are_one_run_at_several_states(tmp_path: Path) -> None:
    section = table_config(recordings(tmp_path))
    check_states(read(section), ("one at 45", "two at 45"))
    assert "one at 45, one at 65 have the same excitation at other conditions: they are one run" in notes(section)


def test_a_run_may_come_again_at_other_conditions(tmp_path: Path) -> None:
    section = table_config(recordings(tmp_path, "{run}"))
    check_states(read(section), ("one", "two"))
    assert "they are one run" not in notes(section)
    measured = read_measured_runs(parsed(section))
    assert measured.recorded.runs == ("one, 45 degC", "one, 65 degC", "two, 45 degC", "two, 65 degC")
    assert len(measured.recorded.speeds) == len(GRID)


def test_runs_of_other_excitation_need_not_share_conditions(tmp_path: Path) -> None:
    """What one of them has and the other lacks was not measured in that one."""
    runs = [run for i, run in enumerate(recordings(tmp_path)) if i in (0, 3)]
    found = read(table_config(runs))
    assert (found.runs, found.complete) == (("one at 45", "two at 65"), False)
    assert found.present.tolist() == [[True, False]] * len(GRID) + [[False, True]] * len(GRID)
    joined = read(table_config([runs[0], runs[1] | at(45.2)], same_conditions={"oil_temperature": "0.5 K"}))
    assert joined.complete
    assert joined.operating["oil_temperature"] == pytest.approx(np.full(len(GRID), 318.25))


def test_a_baseline_may_be_measured_at_every_state(tmp_path: Path) -> None:
    runs = recordings(tmp_path, "{run}")
    bare = [{key: value for key, value in run.items() if key != "unbalances"} | {"name": "found"} for run in runs[:2]]
    found = read(table_config([*runs, *bare], baseline="found"))
    assert (found.runs, found.complete) == (("one", "two", "found"), True)


def test_oil_that_warms_during_a_run_up_by_speed(tmp_path: Path) -> None:
    """Straight lines between what was written down; every recording has its own temperature at a speed."""
    log = tmp_path / "oil.csv"
    log.write_text("run,speed_rpm,oil_temperature_degC\none,500,40\none,3000,50\ntwo,3000,55\ntwo,400,45\n")
    found = read(table_config(wide_runs(tmp_path), conditions_file=str(log)))
    warm = 40 + 10 * (GRID - 500) / 2500
    assert not found.complete
    at_one = found.present[:, 0]
    np.testing.assert_allclose(
        found.operating["oil_temperature"][at_one][found.speeds[at_one].argsort()], warm + 273.15
    )
    assert (np.diff(found.operating["oil_temperature"]) >= 0).all()


def test_oil_that_warms_during_a_run_up_by_time(tmp_path: Path) -> None:
    log = tmp_path / "oil.csv"
    log.write_text("run,time_s,oil_temperature_degC\none,0,40\none,20,50\n")
    section = parsed(waves(conditions_file=str(log)))

    def conditions(last: float) -> np.ndarray:
        speeds = np.array([100.0, 150.0, 200.0])
        tracks = RunTracks("one", "a", {"A": Track(speeds, 0j * speeds)}, times=np.array([2.0, 6.0, last]))
        return find_conditions(section, [tracks], speeds)["oil_temperature"][:, 0]

    np.testing.assert_allclose(conditions(14.0) - 273.15, [41, 43, 47])
    with refused("must cover run 'one' (time_s 2 to 24), but it has 0 to 20: nothing is extrapolated"):
        conditions(24.0)


@pytest.mark.parametrize("layout", ["wide", "long"])
def test_a_column_of_the_table(layout: str, tmp_path: Path) -> None:
    columns = {"speed": "speed", "conditions": {"oil_temperature": {"column": "T oil", "unit": "degF"}}}
    warm = {"one": 45.0, "two": 65.0}
    if layout == "wide":
        runs = wide_runs(tmp_path)
        for run in runs:
            warmed = {"T oil": 1.8 * warm[run["name"]] + 32}
            pd.read_csv(run["file"]).assign(**warmed).to_csv(run["file"], index=False)
        found = read(table_config(runs, columns=columns))
    else:
        rows = long({"one": seen(), "two": seen(1.1)})
        rows["T oil"] = [1.8 * warm[name] + 32 for name in rows["run"]]
        found = read(long_table(tmp_path, rows, columns=columns))
    assert found.operating["oil_temperature"] == pytest.approx(np.repeat(KELVIN, len(GRID)))


def test_without_conditions_nothing_changes(tmp_path: Path) -> None:
    section = table_config(wide_runs(tmp_path))
    check_read(read(section))
    measured = read_measured_runs(parsed(section))
    assert measured.dataset is measured.recorded


@pytest.mark.parametrize(
    ("rows", "words"),
    [
        ("run,speed_rpm,oil_temperature_degC\none,500,40\none,3000,50\n", "must have rows of run 'two'"),
        ("run,oil_temperature_degC\none,40\ntwo,\n", "must have oil_temperature in every row, but row 2 has none (run"),
        ("run,oil_temperature\none,40\ntwo,50\n", "must have its unit in the name of the column"),
        ("run,comment\none,40\ntwo,50\n", "must have columns of operating conditions, such as oil_temperature_degC"),
        ("run,oil_temperature_degC\none,40\ntwo,45\ntwo,50\n", "must have one row a run where it has no speed_rpm"),
        ("run,time_s,oil_temperature_degC\none,1,40\ntwo,2,45\n", "may have time_s for run-ups alone"),
        ("run,speed_rpm,load_N\none,600,4\none,3000,5\ntwo,500,4\n", "must cover run 'one' (speed_rpm 500 to 3000)"),
        ("run,speed_rpm,load_N\none,600,4\none,600,5\ntwo,500,4\n", "each speed_rpm of a run once, but run 'one'"),
        ("run,speed_rpm,time_s,load_N\none,600,1,4\n", "must have speed_rpm or time_s, but it has both"),
    ],
)
def test_a_file_of_conditions_that_breaks_a_law_is_named(rows: str, words: str, tmp_path: Path) -> None:
    (tmp_path / "oil.csv").write_text(rows)
    with refused(words):
        read(table_config(wide_runs(tmp_path), conditions_file=str(tmp_path / "oil.csv")))


def test_a_condition_that_a_run_lacks_is_named(tmp_path: Path) -> None:
    runs = wide_runs(tmp_path)
    runs[0] |= at(45)
    with refused("every run must have every operating condition, but run 'two' has no oil_temperature (1 of 2 runs)"):
        read(table_config(runs))
    runs = recordings(tmp_path, "{run}")[:2]
    with refused("some of run 'one' have a speed at the same ones"):
        read(table_config(runs, same_conditions={"oil_temperature": "30 K"}))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda runs: runs.append(dict(runs[0])), "or operating conditions of its own, but 'one' is there 2 times"),
        (lambda runs: runs.append(runs[0] | at(45) | {"unbalances": [DISC | {"node": 0}]}), "those of 'one' differ"),
        (lambda runs: runs[0].update(operating={"oil_temperature": "45 N"}), "oil_temperature must convert to kelvin"),
        (lambda runs: runs[0].update(operating={"mood": "45 N"}), "must name a condition by a last word"),
    ],
)
def test_what_a_run_may_not_say(change: Any, words: str, tmp_path: Path) -> None:
    runs = wide_runs(tmp_path)
    change(runs)
    with pytest.raises(ValidationError, match=re.escape(words)):
        parsed(table_config(runs))


def test_a_column_must_have_a_unit_of_its_condition(tmp_path: Path) -> None:
    columns = {"speed": "speed", "conditions": {"oil_temperature": {"column": "T", "unit": "bar"}}}
    with pytest.raises(ValidationError, match="oil_temperature must convert to kelvin"):
        parsed(table_config(wide_runs(tmp_path), columns=columns))


def test_a_log_must_cover_what_a_run_has_alone(tmp_path: Path) -> None:
    """A run with fewer speeds than another is at fewer points, and its oil is asked for there only."""
    log = tmp_path / "oil.csv"
    log.write_text("run,speed_rpm,oil_temperature_degC\none,500,40\none,3000,40\ntwo,1000,40\ntwo,2000,40\n")
    found = read(table_config(wide_runs(tmp_path, two=seen(1.1, GRID[2:7])), conditions_file=str(log)))
    assert (found.speeds, found.present.sum(axis=0).tolist()) == (pytest.approx(GRID * RPM), [11, 5])
    assert found.displacement[2:7, 0, 1] == pytest.approx(response(0, 1.1, GRID[2:7])[0])
