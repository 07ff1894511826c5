"""stage=ingest: data of every format become the files that training reads; what does not say enough is refused."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Mapping
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from conftest import MachineFactory, refused
from measured_files import (
    CONVENTIONS,
    PROBES,
    Vectors,
    long,
    probes_config,
    rotating,
    table_config,
    tacho_of,
    uff_set,
    vectors_of,
    wide,
    write_hdf5,
    write_tdms,
    write_uff,
)
from pydantic import TypeAdapter, ValidationError

from pipeline.__main__ import main
from pipeline.config.compose import compose_config, compose_mapping, validate
from pipeline.config.loader import list_options
from pipeline.config.measured import convert_phase
from pipeline.config.recordings import RecordingsConfig
from pipeline.config.schema import Config
from pipeline.data.dataset import VibrationDataset
from pipeline.data.tables import TextFormat, read_table
from pipeline.data.vibration_files import read_dataset, write_excitation, write_vibration
from pipeline.errors import ConfigError
from pipeline.ingest.dataset import read_measured_runs
from pipeline.ingest.known import read_known
from pipeline.ingest.plausibility import note_size, note_whirl
from pipeline.stages import ingest, run_stage

RPM = np.pi / 30
GRID = np.arange(500.0, 3001.0, 250.0)
DISC = {"node": 1, "magnitude": "20 g mm", "phase": "30 deg"}


def response(node: int, turn: float = 0.0, rpm: np.ndarray = GRID) -> tuple[np.ndarray, np.ndarray]:
    """x and y (S,) of a node, complex, in m: an elliptic orbit that grows and turns with the speed."""
    ratio = rpm / 2200
    size = (8e-6 + 3e-6 * node) * ratio**2 / (1 - ratio**2 + 0.24j * ratio) * np.exp(1j * turn)
    return size, -0.7j * size * np.exp(0.2j * node)


def seen(turn: float = 0.0, rpm: np.ndarray = GRID, probes: Mapping[str, Any] = PROBES) -> Vectors:
    """What the probes of a run see."""
    x, y = (lambda node: response(node, turn, rpm)[0]), (lambda node: response(node, turn, rpm)[1])
    return vectors_of(rpm, x, y, probes)


TURNS = {"one": 0.0, "two": 1.1}
RUNS = [{"name": "one", "unbalances": [DISC]}, {"name": "two", "unbalances": [DISC | {"magnitude": "4e-5 kg m"}]}]


def parsed(mapping: dict[str, Any]) -> Any:
    """The section ``ingest`` as the schema makes it."""
    return TypeAdapter(RecordingsConfig).validate_python(mapping)


def read(mapping: dict[str, Any]) -> VibrationDataset:
    """The data set of a section ``ingest``."""
    return read_measured_runs(parsed(mapping)).dataset


def notes(mapping: dict[str, Any]) -> str:
    """What the reading warns of."""
    return "\n".join(read_measured_runs(parsed(mapping)).notes)


def wide_runs(folder: Path, ending: str = ".csv", **more: Vectors) -> list[dict[str, Any]]:
    """A wide table a run in ``folder``, and the runs of the configuration."""
    runs = []
    for run in RUNS:
        name = str(run["name"])
        path = folder / f"{name}{ending}"
        table = wide(more.get(name, seen(TURNS[name])))
        table.to_excel(path, index=False) if ending == ".xlsx" else table.to_csv(path, index=False)
        runs.append(run | {"file": str(path)})
    return runs


def check_read(dataset: VibrationDataset, tolerance: float = 1e-12, rpm: np.ndarray = GRID) -> None:
    """x and y of both nodes in both runs, as they were made."""
    assert dataset.channels == ((0, 0.0), (0, 90.0), (2, 0.0), (2, 90.0))
    assert dataset.runs == ("one", "two")
    assert dataset.speeds == pytest.approx(rpm * RPM, rel=1e-9)
    for r, turn in enumerate(TURNS.values()):
        for n, node in enumerate((0, 2)):
            for d, true in enumerate(response(node, turn, rpm)):
                found = dataset.displacement[:, 2 * n + d, r]
                assert np.abs(found - true).max() < tolerance * np.abs(true).max()


# --- conventions ------------------------------------------------------------------------------------


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
    lean = dataset.displacement[0, :, 0]  # along the force e^{jp} [1, -j]
    assert force.phase == pytest.approx(np.radians(tacho + shaft))
    assert lean[:2] == pytest.approx(5e-6 * np.exp(1j * force.phase) * np.array([1, -1j]))
    assert lean[2:] == pytest.approx(lean[:2])


def test_angles_on_the_shaft() -> None:
    """With the rotation, against it, or from x at the pulse."""
    assert convert_phase(0.3, "with_rotation", 1.0) == pytest.approx(1.3)
    assert convert_phase(0.3, "against_rotation", 1.0) == pytest.approx(0.7)
    assert convert_phase(0.3, "from_x", None) == pytest.approx(0.3)


MISSING = ["length", "amplitude", "phase", "phase_unit", "speed"]


@pytest.mark.parametrize("convention", MISSING)
def test_a_missing_convention_is_refused_by_name(convention: str) -> None:
    """Nothing is guessed, and nothing has a default."""
    said = {key: value for key, value in CONVENTIONS.items() if key != convention}
    with refused(f"machine.recordings.conventions.{convention}: must be given", kind=ConfigError):
        with_ingest(table_config([RUNS[0] | {"file": "a.csv"}], conventions=said))


@cache
def _mapping() -> str:
    return json.dumps(compose_mapping(["experiment=ball_bearing", "tracking=none"]))


def with_ingest(section: dict[str, Any], **more: Any) -> Config:
    """The configuration of ball_bearing with a section ``ingest``."""
    mapping = json.loads(_mapping())
    mapping["machine"]["recordings"] = section
    return validate(mapping | {"stage": "ingest"} | more)


ONE = RUNS[0] | {"file": "a.csv"}
BARE = {"name": "two", "file": "b.csv"}
VOLTS: dict[str, Any] = {"channel": lambda name: name, "scale": lambda name: "8 V/mm"}


def waves(**changes: Any) -> dict[str, Any]:
    """A section for time signals."""
    return {
        "format": "waveform",
        "records": "run_up",
        "signal_unit": "V",
        "sample_rate": "5 kHz",
        "tacho": {"channel": "tacho", "edge": "rising"},
        "probes": probes_config(**VOLTS),
        "shaft_angle": "from_x",
        "speeds": {"start_rpm": 800, "stop_rpm": 2500, "step_rpm": 100},
        "runs": [ONE],
    } | changes


BAD_CONFIG: dict[str, tuple[dict[str, Any], str]] = {
    "an unknown unit": (
        table_config([ONE], conventions=CONVENTIONS | {"length": "umm"}),
        "um, mil or mm), but got 'umm'",
    ),
    "a unit of something else": (
        table_config([ONE], conventions=CONVENTIONS | {"length": "kg"}),
        "must be a unit of m",
    ),
    "a sense of phase": (table_config([ONE], conventions=CONVENTIONS | {"phase": "lagg"}), "did you mean 'lag'?"),
    "degrees without a unit": (
        table_config([ONE], probes={"A": {"node": 0, "angle": 45}}),
        "must carry its unit (such as 45 deg)",
    ),
    "a run without excitation": (
        table_config([ONE, BARE]),
        "run 'two' must have unbalances or forces, but it has none",
    ),
    "an excited baseline": (
        table_config([ONE], baseline="one"),
        "must have nothing that excites the baseline run 'one'",
    ),
    "no such baseline": (table_config([ONE], baseline="zero"), "must have the baseline among its runs ['one']"),
    "two runs of one name": (table_config([ONE, ONE]), "must give every run a name of its own"),
    "no meaning of angles": (table_config([ONE], shaft_angle=None), "must say in shaft_angle how phases of unbalances"),
    "no angle of the tacho": (table_config([ONE], shaft_angle="with_rotation"), "must give tacho.angle"),
    "no file": (table_config([RUNS[0]]), "run 'one' must have a file, but it has none"),
    "no columns": (table_config([ONE], probes=probes_config()), "probe 'A' must have columns in the wide layout"),
    "no phase of an unbalance": (
        table_config([{"name": "one", "file": "a", "unbalances": [{"node": 1, "magnitude": "1 g mm"}]}]),
        "machine.recordings.runs.0.unbalances.0.phase: must be given",
    ),
    "unbalances at a frequency of their own": (
        table_config([ONE | {"frequency_hz": 30}]),
        "run 'one' must have no unbalances where its forces have a frequency",
    ),
    "slow roll both ways": (
        table_config([ONE], slow_roll={"below_rpm": 300, "vectors": {"A": {"amplitude": "1 um", "phase": "1 rad"}}}),
        "must give either below_rpm or vectors, but got both",
    ),
    "slow roll of some probes": (
        table_config(
            [ONE],
            slow_roll={
                "vectors": {"A": {"amplitude": "1 um", "phase": "1 rad"}},
                "amplitude": "rms",
                "phase": "lag",
            },
        ),
        "must have one vector a probe (A, B, C, D)",
    ),
    "slow roll without conventions": (
        table_config([ONE], slow_roll={"vectors": {"A": {"amplitude": "1 um", "phase": "1 rad"}}}),
        "must give amplitude (zero_to_peak, peak_to_peak or rms) and phase",
    ),
    "comma twice": (table_config([ONE], csv={"decimal": ","}), "must have a delimiter that is not the decimal mark"),
    "no unit of signals": (waves(signal_unit=None), "signal_unit"),
    "no kind of records": (waves(records=None), "must give records (constant_speed or run_up)"),
    "a run-up without speeds": (waves(speeds=None), "must give speeds"),
    "no scale": (waves(probes=probes_config(channel=lambda name: name)), "probe 'A' must have a scale"),
    "a scale without unit": (
        waves(probes=probes_config(channel=lambda name: name, scale=lambda name: 8)),
        "must carry its unit (such as 7.87 V/mm or 200 mV/mil)",
    ),
    "a scale for lengths": (waves(signal_unit="um"), "must have no scale where signals are in um"),
    "teeth without a mark": (
        waves(tacho={"channel": "tacho", "edge": "rising", "pulses_per_revolution": 20}),
        "must give mark_channel where there are 20 pulses a revolution",
    ),
    "no edge": (waves(tacho={"channel": "tacho"}), "machine.recordings.tacho.edge: must be given"),
    "two clocks": (waves(sample_rate_attribute="fs"), "must give at most one of time, sample_rate and"),
    "no unit of time": (waves(sample_rate=None, time="t"), "must give time_unit"),
    "several files of a run-up": (
        waves(runs=[RUNS[0] | {"files": ["a.h5", "b.h5"]}]),
        "must have one file for a run-up, but it has 2",
    ),
    "file and files": (waves(runs=[ONE | {"files": ["a.h5"]}]), "must have file or files, but it has both"),
    "an unknown key": (table_config([ONE], convention={}), "did you mean 'conventions'?"),
    "an unknown format": ({"format": "tabel"}, "did you mean 'table'?"),
}


@pytest.mark.parametrize("case", BAD_CONFIG)
def test_a_configuration_that_says_too_little(case: str) -> None:
    """The key, the law, what came."""
    section, words = BAD_CONFIG[case]
    with refused(words, "machine.recordings", kind=ConfigError):
        with_ingest(section)


@pytest.mark.slow
@pytest.mark.parametrize("name", list_options("machine"))
def test_the_machines_are_configurations(name: str) -> None:
    """Each file of conf/machine fits the schema, and again after it was one; alone it has its own name."""
    config = compose_config([f"machine={name}"])
    assert config.name == name
    assert Config.model_validate(config.model_dump()).model_copy(update={"chosen_by": config.chosen_by}) == config


# --- tables ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("ending", [".csv", ".xlsx"])
def test_wide_tables(ending: str, tmp_path: Path) -> None:
    """CSV and Excel, at the speeds of the tables."""
    check_read(read(table_config(wide_runs(tmp_path, ending))))


@pytest.mark.parametrize("ending", [".csv", ".xlsx"])
def test_long_tables(ending: str, tmp_path: Path) -> None:
    """One file of all runs; rows in any order, and a run that is left out."""
    table = long({name: seen(turn) for name, turn in TURNS.items()} | {"spare": seen()}).sample(frac=1, random_state=1)
    path = tmp_path / f"all{ending}"
    table.to_excel(path, index=False) if ending == ".xlsx" else table.to_csv(path, index=False)
    check_read(read(table_config(RUNS, "long", file=str(path), leave_out=["spare"])))


def test_a_table_as_written_elsewhere(tmp_path: Path) -> None:
    """Semicolons, decimal commas and lines before the header, said in the configuration."""
    runs = wide_runs(tmp_path)
    for run in runs:
        path = Path(run["file"])
        table = pd.read_csv(path)
        path.write_text("made by: someone\n\n" + table.to_csv(sep=";", decimal=",", index=False))
    said = {"delimiter": ";", "decimal": ",", "skip_rows": 2}
    check_read(read(table_config(runs, csv=said)))


def test_other_columns_in_one_run(tmp_path: Path) -> None:
    """A run may call its columns otherwise."""
    runs = wide_runs(tmp_path)
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
    vectors = seen(0.0, rpm)
    noisy = {name: v * np.where(rpm == 1500.001, 1.05, 1.0) for name, v in vectors.of.items()}
    runs = wide_runs(tmp_path, one=Vectors(rpm, noisy), two=seen(1.1, rpm))
    speeds = {"start_rpm": 500, "stop_rpm": 3000, "step_rpm": 50}
    found = read(table_config(runs, speeds=speeds)).displacement[..., 0]
    assert np.abs(found).max() < 1.1 * max(np.abs(v).max() for v in noisy.values()) * 2**0.5


def test_speeds_that_are_nearly_the_same(tmp_path: Path) -> None:
    """Without a grid, speeds of two runs are one where they differ by less than 0.1 %."""
    runs = wide_runs(tmp_path, two=Vectors(GRID * 1.0004, seen(1.1).of))
    assert read(table_config(runs)).speeds == pytest.approx(GRID * 1.0002 * RPM, rel=1e-9)


Damage = Callable[[pd.DataFrame], pd.DataFrame | str]


def put(column: str, value: object, row: int = 3) -> Damage:
    """A change of one cell."""

    def change(table: pd.DataFrame) -> pd.DataFrame:
        table = table.astype({column: object})
        table.loc[row, column] = value
        return table

    return change


BAD_TABLES: dict[str, tuple[Damage, str, str]] = {
    "NaN": (put("A amp", np.nan), "must have finite numbers in the column 'A amp'", "row 4"),
    "infinite": (put("B ph", np.inf), "must have finite numbers in the column 'B ph'", "row 4"),
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
    "another delimiter": (lambda t: t.to_csv(index=False, sep=";"), "must have the column 'speed'", "speed;A amp"),
    "decimal commas": (
        lambda t: t.to_csv(index=False).replace(".", ","),
        "must be a CSV table",
        "",
    ),
    "empty": (lambda t: "", "must be a CSV table", ""),
    "binary": (lambda t: "\x00\x01\x02", "must", ""),
    "other speeds": (
        lambda t: t.iloc[:-2],
        "all runs must have the same speeds where machine.recordings.speeds is null",
        "all of them cover 500 to 2500 rpm",
    ),
    "far speeds": (
        lambda t: t.assign(speed=t["speed"] * 1.01),
        "must have the same speeds",
        "give machine.recordings.speeds=",
    ),
    "a row cut off": (lambda t: t.to_csv(index=False)[:-60], "must", ""),
}


@pytest.mark.parametrize("case", BAD_TABLES)
def test_a_damaged_table_is_refused(case: str, tmp_path: Path) -> None:
    """Every damage of a table has its sentence, with the file's name."""
    damage, words, more = BAD_TABLES[case]
    runs = wide_runs(tmp_path)
    path = Path(runs[1]["file"])
    damaged = damage(pd.read_csv(path))
    path.write_text(damaged) if isinstance(damaged, str) else damaged.to_csv(path, index=False)
    with refused(words, more, str(path)):
        read(table_config(runs))


def test_a_missing_file_is_refused(tmp_path: Path) -> None:
    """By its name."""
    with refused("must exist, but there is no such file", "nowhere.csv"):
        read(table_config([RUNS[0] | {"file": str(tmp_path / "nowhere.csv")}]))


def test_a_truncated_excel_file_is_refused(tmp_path: Path) -> None:
    """Half a file, and one that is no Excel file."""
    runs = wide_runs(tmp_path, ".xlsx")
    path = Path(runs[0]["file"])
    for content in (path.read_bytes()[:-700], b"PK\x03\x04" + bytes(200), b"speed,A amp\n"):
        path.write_bytes(content)
        with refused("must be a complete Excel file", str(path)):
            read(table_config(runs))


def test_a_speed_range_that_a_run_does_not_cover(tmp_path: Path) -> None:
    """Nothing is extrapolated: the run and its range are named."""
    section = table_config(wide_runs(tmp_path), speeds={"start_rpm": 400, "stop_rpm": 3000, "step_rpm": 100})
    with refused("the speed range of run 'one' is 11 speeds from 500 to 3000 rpm", "nothing is extrapolated"):
        read(section)


def test_runs_of_a_long_table_and_of_the_configuration(tmp_path: Path) -> None:
    """A run without an excitation, and an excitation without its run."""
    path = tmp_path / "all.csv"
    long({name: seen(turn) for name, turn in TURNS.items()} | {"three": seen()}).to_csv(path, index=False)
    with refused("'three' is not among them", "machine.recordings.leave_out"):
        read(table_config(RUNS, "long", file=str(path)))
    with refused("must have rows of run 'onee'", "did you mean 'one'?"):
        more = [*RUNS, {"name": "onee", "unbalances": [DISC]}]
        read(table_config(more, "long", file=str(path), leave_out=["three"]))
    with refused("must have rows of probe 'AA' in run 'one'"):
        probes = probes_config() | {"AA": {"node": 1, "angle": "0 deg"}, "AB": {"node": 1, "angle": "90 deg"}}
        read(table_config(RUNS, "long", file=str(path), leave_out=["three"], probes=probes))


def test_the_last_line_of_a_cut_table_is_warned_of(tmp_path: Path) -> None:
    """What was cut within its last number can't be seen otherwise."""
    runs = wide_runs(tmp_path)
    path = Path(runs[0]["file"])
    path.write_text(path.read_text().rstrip("\n")[:-2])
    assert "does not end with the end of a line" in notes(table_config(runs))


@pytest.mark.parametrize(("written", "said"), [("rad", "deg"), ("deg", "rad")])
def test_phases_of_the_other_unit_are_warned_of(written: str, said: str, tmp_path: Path) -> None:
    """Radians that are called degrees stay within a turn in radians and yet differ widely; and the reverse."""
    runs = wide_runs(tmp_path)
    for run in runs:
        wide(seen(TURNS[run["name"]]), CONVENTIONS | {"phase_unit": written}).to_csv(run["file"], index=False)
    words = "in radians" if said == "deg" else "in degrees"
    assert words in notes(table_config(runs, conventions=CONVENTIONS | {"phase_unit": said}))
    assert words not in notes(table_config(runs, conventions=CONVENTIONS | {"phase_unit": written}))


def test_lengths_that_are_a_thousand_times_too_large(tmp_path: Path) -> None:
    """More than a metre is no vibration."""
    with refused("must have amplitudes below 1 m, but got", "check the unit", "one.csv"):
        read(table_config(wide_runs(tmp_path), conventions=CONVENTIONS | {"length": "m"}))


# --- probes ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("probes", "words"),
    [
        ({"A": (0, 45.0), "C": (2, 0.0), "D": (2, 90.0)}, "node 0 has one only: 'A'"),
        ({"A": (0, 0.0), "B": (0, 180.0)}, "lie within 10 deg of one line: 'A' at 0 deg, 'B' at 180 deg"),
        ({"A": (0, 40.0), "B": (0, 45.0)}, "those of node 0 lie within 10 deg of one line"),
    ],
)
def test_probes_that_do_not_give_x_and_y(probes: dict[str, Any], words: str) -> None:
    """One only, opposite ones, and neighbours; said before any file is opened."""
    pair = {"columns": lambda name: {"amplitude": f"{name} amp", "phase": f"{name} ph"}}
    with refused(words, kind=ConfigError):
        read(table_config([ONE], probes=probes_config(probes, **pair)))


def test_three_probes_at_a_node(tmp_path: Path) -> None:
    """Least squares where they agree, and a warning where they do not."""
    probes = PROBES | {"E": (0, 100.0)}
    pair = {"columns": lambda name: {"amplitude": f"{name} amp", "phase": f"{name} ph"}}
    runs = wide_runs(tmp_path)
    for sign, warned in ((1.0, False), (-1.0, True)):
        for run in runs:
            vectors = seen(TURNS[run["name"]], probes=probes)
            of = dict(vectors.of) | {"E": sign * vectors.of["E"]}
            wide(Vectors(GRID, of)).to_csv(run["file"], index=False)
        section = table_config(runs, probes=probes_config(probes, **pair))
        assert ("the probes at node 0 contradict each other" in notes(section)) is warned
        if not warned:
            check_read(read(section))


# --- baseline, runout, forces -------------------------------------------------------------------------------


def test_a_baseline_run_has_data_and_no_excitation(tmp_path: Path) -> None:
    """It is written into the vibration, and has no row among the excitations."""
    runs = wide_runs(tmp_path)
    base = tmp_path / "base.csv"
    wide(seen(2.0)).to_csv(base, index=False)
    dataset = read(table_config([{"name": "as found", "file": str(base)}, *runs], baseline="as found"))
    assert dataset.runs == ("as found", "one", "two")
    assert {e.run for e in dataset.excitations} == {"one", "two"}
    write_vibration(tmp_path / "vibration.parquet", dataset)
    write_excitation(tmp_path / "excitation.csv", dataset)
    assert set(pd.read_parquet(tmp_path / "vibration.parquet")["run"]) == {"as found", "one", "two"}
    assert set(pd.read_csv(tmp_path / "excitation.csv")["run"]) == {"one", "two"}


RUNOUT = {"A": 3e-6 * np.exp(0.5j), "B": 2e-6 * np.exp(-2j), "C": 1e-6 + 0j, "D": 4e-6 * np.exp(3j)}


def test_slow_roll_runout_is_subtracted(tmp_path: Path) -> None:
    """The mean below a speed, or given vectors in conventions of their own."""
    slow = np.array([100.0, 150.0, 200.0])
    runs = wide_runs(tmp_path)
    for run in runs:
        vectors = seen(TURNS[run["name"]])
        of = {name: np.append(np.full(3, RUNOUT[name]), v + RUNOUT[name]) for name, v in vectors.of.items()}
        wide(Vectors(np.append(slow, GRID), of)).to_csv(run["file"], index=False)
    speeds = {"start_rpm": 500, "stop_rpm": 3000, "step_rpm": 250}
    check_read(read(table_config(runs, speeds=speeds, slow_roll={"below_rpm": 300})), 1e-9)
    given = {
        name: {"amplitude": f"{2 * abs(v) / 25.4e-6} mil", "phase": f"{-np.degrees(np.angle(v))} deg"}
        for name, v in RUNOUT.items()
    }
    explicit = {"vectors": given, "amplitude": "peak_to_peak", "phase": "lag"}
    check_read(read(table_config(runs, speeds=speeds, slow_roll=explicit)), 1e-9)
    with refused("run 'one' must have speeds below machine.recordings.slow_roll.below_rpm=50", "the lowest is 100 rpm"):
        read(table_config(runs, speeds=speeds, slow_roll={"below_rpm": 50}))


def test_forces_of_either_whirl_and_of_their_own_frequency(tmp_path: Path) -> None:
    """A run may be excited by forces; an asynchronous one is written with its frequency."""
    runs = wide_runs(tmp_path)
    force = {"node": 1, "magnitude": "12 N", "phase": "20 deg", "whirl": "backward"}
    runs[1] = {"name": "two", "file": runs[1]["file"], "forces": [force], "frequency_ratio": 0.5}
    dataset = read(table_config(runs))
    assert dataset.excitations[1].whirl == "backward"
    assert dataset.excitations[1].phase == pytest.approx(np.radians(20))
    assert dataset.frequencies[:, 0] == pytest.approx(dataset.speeds)
    assert dataset.frequencies[:, 1] == pytest.approx(dataset.speeds / 2)


# --- universal files ------------------------------------------------------------------------------------------

UFF = {"length": "um", "amplitude": "rms", "phase": "lead", "speed": "rpm"}
RESPONSES = {"A": [10, 1], "B": [10, 2], "C": [20, 1], "D": [20, 2]}


def uff_sets(**changes: Any) -> list[dict[str, Any]]:
    """Order-1 functions of both runs."""
    sets = []
    for run, turn in TURNS.items():
        for name, vector in seen(turn).of.items():
            sets.append(uff_set(GRID, vector * 1e6 / 2**0.5, *RESPONSES[name], texts=[name, f"run {run}"], **changes))
    return sets


def uff_config(path: Path, **changes: Any) -> dict[str, Any]:
    """Records found by their response."""
    return {
        "format": "uff58",
        "conventions": dict(UFF),
        "probes": probes_config(response=lambda name: RESPONSES[name]),
        "shaft_angle": "from_x",
        "file": str(path),
        "runs": [run | {"label": f"run {run['name']}"} for run in RUNS],
    } | changes


@pytest.mark.parametrize("binary", [0, 1])
@pytest.mark.parametrize("spacing", [0, 1])
def test_order_tracks_of_a_universal_file(binary: int, spacing: int, tmp_path: Path) -> None:
    """ASCII and binary, even and uneven abscissa, by response or by ID; pyuff writes eleven digits."""
    path = write_uff(tmp_path / "runs.uff", uff_sets(binary=binary, abscissa_spacing=spacing))
    check_read(read(uff_config(path)), 1e-9)
    check_read(read(uff_config(path, probes=probes_config(record=lambda name: name))), 1e-9)


def test_complex_numbers_whose_angle_is_a_lag(tmp_path: Path) -> None:
    """Conjugated numbers give the same with phase: lag; speeds in Hz too."""
    sets = [one | {"data": one["data"].conj(), "x": one["x"] / 60} for one in uff_sets(abscissa_spec_data_type=18)]
    path = write_uff(tmp_path / "runs.uff", sets)
    section = uff_config(path, conventions=UFF | {"phase": "lag", "speed": "Hz"})
    check_read(read(section | {"speeds": {"start_rpm": 500, "stop_rpm": 3000, "step_rpm": 250}}), 1e-3)
    assert notes(section) == ""


def test_what_a_universal_file_says_otherwise_is_warned_of(tmp_path: Path) -> None:
    """Labels of length and speed, dataset 164, and numbers per force: the configuration is followed."""
    labelled = uff_sets(ordinate_axis_units_lab="mm", abscissa_axis_units_lab="Hz", orddenom_spec_data_type=13)
    words = notes(uff_config(write_uff(tmp_path / "a.uff", labelled)))
    assert "its lengths are in 'mm', and machine.recordings.conventions.length is um" in words
    assert "its abscissa is in Hz, and machine.recordings.conventions.speed is rpm" in words
    assert "is per force" in words
    units = {"type": 164, "units_code": 5, "length": 1000.0, "force": 1000.0, "temp": 1.0, "temp_offset": 0.0}
    words = notes(uff_config(write_uff(tmp_path / "b.uff", [units, *uff_sets()])))
    assert "its lengths are in 0.001 m (dataset 164)" in words
    assert notes(uff_config(write_uff(tmp_path / "c.uff", uff_sets(ordinate_axis_units_lab="um pk-pk")))) == ""


BAD_UFF: dict[str, tuple[Callable[[list[dict[str, Any]]], list[dict[str, Any]]], dict[str, Any], str]] = {
    "no such response": (lambda sets: sets, {"probes": probes_config(response=lambda n: [7, 1])}, "response [7, 1]"),
    "no such ID": (
        lambda sets: sets,
        {"probes": probes_config(record=lambda n: f"{n}x")},
        "must have a record with ID",
    ),
    "no such run": (lambda sets: sets[:4], {}, "ID 'run two' and response [10, 1] for probe 'A' in run 'two'"),
    "two that fit": (lambda sets: sets, {"runs": [dict(RUNS[0])]}, "must have one record with response [10, 1]"),
    "real numbers": (
        lambda sets: [s | {"data": np.abs(s["data"]), "abscissa_spec_data_type": 19} for s in sets],
        {},
        "must have complex values (amplitude and phase), but they are real",
    ),
    "time signals": (
        lambda sets: [s | {"data": np.abs(s["data"]), "abscissa_spec_data_type": 17} for s in sets],
        {},
        "must be a function of the speed, but it is one of the time",
    ),
    "accelerations": (
        lambda sets: [s | {"ordinate_spec_data_type": 12} for s in sets],
        {},
        "must hold displacements, but it says that it holds accelerations",
    ),
    "a speed twice": (lambda sets: [s | {"x": np.full(11, 600.0)} for s in sets], {}, "must have one row a speed"),
    "other datasets": (
        lambda sets: [{"type": 164, "units_code": 1, "length": 1.0, "force": 1.0, "temp": 1.0, "temp_offset": 0.0}],
        {},
        "must have datasets 58 (functions at nodal DOF), but it has datasets 164",
    ),
}


@pytest.mark.parametrize("case", BAD_UFF)
def test_a_universal_file_that_does_not_fit(case: str, tmp_path: Path) -> None:
    """What is missing, double or of another kind, by the record's name."""
    change, changes, words = BAD_UFF[case]
    path = write_uff(tmp_path / "runs.uff", change(uff_sets()))
    with refused(words, "runs.uff"):
        read(uff_config(path, **changes))


def test_numbers_that_are_none_in_a_universal_file(tmp_path: Path) -> None:
    """NaN is refused; zeros, which some programs write in its place, are warned of."""
    path = write_uff(tmp_path / "runs.uff", [s | {"data": s["data"] * (s["x"] != 750)} for s in uff_sets()])
    assert "probe 'A' of run 'one' is exactly zero at 1 of 11 speeds" in notes(uff_config(path))
    path.write_text(
        path.read_text().replace("  7.50000e+02   0.00000000000e+00", "  7.50000e+02                 nan", 1)
    )
    with refused("must have finite numbers, but record A [10, 1] has NaN"):
        read(uff_config(path))


@pytest.mark.parametrize("binary", [0, 1])
def test_a_truncated_universal_file_is_refused(binary: int, tmp_path: Path) -> None:
    """Cut anywhere but between two datasets, and a file of something else."""
    path = write_uff(tmp_path / "runs.uff", uff_sets(binary=binary))
    content = path.read_bytes()
    for at in (20, 200, len(content) // 2, len(content) - 40, len(content) - 4):
        path.write_bytes(content[:at])
        with refused("runs.uff", "must"):
            read(uff_config(path))
    path.write_bytes(b"speed,amplitude\n1,2\n")
    with refused("runs.uff", "must"):
        read(uff_config(path))


# --- time signals ------------------------------------------------------------------------------------------------

RATE = 4000.0
SCALE = {"A": 8000.0, "B": -8000.0, "C": 8000.0, "D": 200e-3 / 25.4e-6}  # V/m
SCALES = {"A": "8 V/mm", "B": "-8 mV/um", "C": "8 V/mm", "D": "200 mV/mil"}


def run_up(turn: float) -> dict[str, np.ndarray]:
    """Volts of the probes and the tacho in a run-up of 20 s from 200 to 2900 rpm, with a gap and a runout."""
    t = np.arange(int(20 * RATE)) / RATE
    rpm = 200 + 135 * t
    phi = 2 * np.pi * (200 * t + 135 * t**2 / 2) / 60 + 0.3
    vectors = seen(turn, rpm).of
    channels = {name: SCALE[name] * (rotating(vectors[name] + RUNOUT[name], phi) + 5e-4) for name in PROBES}
    return channels | {"tacho": tacho_of(phi), "time": t}


def steady(rpm: float, turn: float) -> dict[str, np.ndarray]:
    """Volts at one speed for 2 s."""
    t = np.arange(int(2 * RATE)) / RATE
    phi = 2 * np.pi * rpm * t / 60 + 0.3
    vectors = seen(turn, np.array([rpm])).of
    channels = {name: SCALE[name] * (rotating(vectors[name], phi) + 5e-4) for name in PROBES}
    return channels | {"tacho": tacho_of(phi), "time": t}


def write_csv(path: Path, channels: dict[str, np.ndarray], rate: float | None = None) -> Path:
    """Columns, with the time."""
    pd.DataFrame(channels).round(9).to_csv(path, index=False)
    return path


CONTAINERS: dict[str, tuple[Callable[..., Path], str, dict[str, Any]]] = {
    "csv": (write_csv, "", {"sample_rate": None, "time": "time", "time_unit": "s"}),
    "h5": (write_hdf5, "", {"sample_rate": None, "sample_rate_attribute": "fs"}),
    "tdms": (write_tdms, "run/", {"sample_rate": None}),
}


def signal_config(prefix: str, runs: list[dict[str, Any]], **changes: Any) -> dict[str, Any]:
    """Channels of a container."""
    probes = probes_config(channel=lambda name: f"{prefix}{name}", scale=lambda name: SCALES[name])
    tacho = {"channel": f"{prefix}tacho", "edge": "rising"}
    return waves(probes=probes, tacho=tacho, runs=runs, sample_rate=f"{RATE} Hz") | changes


TRACKED = np.arange(800.0, 2501.0, 100.0)


@pytest.mark.parametrize("ending", CONTAINERS)
def test_run_ups(ending: str, tmp_path: Path) -> None:
    """CSV, HDF5 and TDMS: the vectors of the grid within 0.02 %, runout subtracted, one negative scale."""
    write, prefix, clock = CONTAINERS[ending]
    runs = [
        run | {"file": str(write(tmp_path / f"{run['name']}.{ending}", run_up(TURNS[run["name"]]), RATE))}
        for run in RUNS[: 2 if ending == "h5" else 1]
    ]
    section = signal_config(prefix, runs, **clock)
    given = {name: {"amplitude": abs(v), "phase": f"{np.angle(v)} rad"} for name, v in RUNOUT.items()}
    explicit = {"vectors": given, "amplitude": "zero_to_peak", "phase": "lead"}
    dataset = read(section | {"slow_roll": explicit})
    if len(runs) == 2:
        check_read(dataset, 2e-4, TRACKED)
    assert np.abs(dataset.displacement[:, 0, 0] / response(0, 0.0, TRACKED)[0] - 1).max() < 5e-4


def test_slow_roll_of_a_run_up(tmp_path: Path) -> None:
    """The mean vector of the windows below the limit: the runout and what little the unbalance does there."""
    runs = [RUNS[0] | {"file": str(write_hdf5(tmp_path / "one.h5", run_up(0.0)))}]
    found = read(signal_config("", runs, slow_roll={"below_rpm": 420}))
    true = response(2, 0.0, TRACKED)[0]
    low = response(2, 0.0, np.linspace(300, 420, 10))[0].mean()
    assert np.abs(found.displacement[:, 2, 0] - (true - low)).max() < 0.1e-6
    with refused("must have data below machine.recordings.slow_roll.below_rpm=250", "windows fit from"):
        read(signal_config("", runs, slow_roll={"below_rpm": 250}))


def test_records_at_constant_speed(tmp_path: Path) -> None:
    """A file a speed, in any order, one vector each; then as they are, or interpolated."""
    speeds = [1207.0, 803.0, 1601.0]
    runs = []
    for run in RUNS:
        files = [write_hdf5(tmp_path / f"{run['name']}{rpm}.h5", steady(rpm, TURNS[run["name"]])) for rpm in speeds]
        runs.append(run | {"files": [str(path) for path in files]})
    section = signal_config("", runs, records="constant_speed", speeds=None)
    dataset = read(section)
    assert dataset.speeds == pytest.approx(np.sort(speeds) * RPM, rel=1e-6)
    for r, turn in enumerate(TURNS.values()):
        assert dataset.displacement[:, 3, r] == pytest.approx(response(2, turn, np.sort(speeds))[1], rel=1e-3)
    assert len(read(section | {"speeds": {"start_rpm": 900, "stop_rpm": 1500, "step_rpm": 100}}).speeds) == 7


def test_a_sharp_tacho_at_a_whole_number_of_samples_is_warned_of(tmp_path: Path) -> None:
    """All its phases are off together, and nothing in the record shows by how much."""
    t = np.arange(8000) / RATE
    phi = 2 * np.pi * 25 * t + 0.01
    channels = {name: SCALE[name] * rotating(np.array(1e-5), phi) for name in PROBES} | {"tacho": tacho_of(phi, 1e-6)}
    runs = [RUNS[0] | {"files": [str(write_hdf5(tmp_path / "a.h5", channels))]}]
    words = notes(signal_config("", runs, records="constant_speed", speeds=None))
    assert "all its phases may be off by 1.1 deg together" in words


def test_time_signals_of_a_universal_file(tmp_path: Path) -> None:
    """With the tacho's record, datasets 58 of the time go the way of time signals."""
    channels = {rpm: steady(rpm, 0.0) for rpm in (903.0, 1502.0)}
    files = []
    for rpm, of in channels.items():
        sets = [uff_set(of["time"], of[name], 1, 1, [name], abscissa_spacing=1) for name in [*PROBES, "tacho"]]
        files.append(str(write_uff(tmp_path / f"{rpm}.uff", sets)))
    section = {
        "format": "uff58",
        "signal_unit": "V",
        "records": "constant_speed",
        "tacho": {"record": "tacho", "edge": "rising"},
        "probes": probes_config(record=lambda name: name, scale=lambda name: SCALES[name]),
        "shaft_angle": "from_x",
        "runs": [RUNS[0] | {"files": files}],
    }
    dataset = read(section)
    true = response(0, 0.0, np.array([903.0, 1502.0]))[1]
    assert dataset.displacement[:, 1, 0] == pytest.approx(true, rel=1e-3)
    wrong = section | {"tacho": {}, "conventions": UFF, "signal_unit": None, "records": None}
    wrong["runs"] = [RUNS[0] | {"file": files[0]}]
    with refused("must be a function of the speed, but it is one of the time: give the record of the tacho"):
        read(wrong)


Change = Callable[[dict[str, np.ndarray]], dict[str, np.ndarray]]
BAD_SIGNALS: dict[str, tuple[Change, dict[str, Any], str]] = {
    "no such channel": (
        lambda c: {k: v for k, v in c.items() if k != "B"},
        {},
        "must have the dataset 'B', but it has",
    ),
    "no sample rate": (lambda c: c, {"sample_rate": None}, "must come with a sample rate, but it has none"),
    "no such attribute": (
        lambda c: c,
        {"sample_rate": None, "sample_rate_attribute": "rate"},
        "must have the attribute 'rate' at a channel, its group or the file, but it has none",
    ),
    "NaN": (lambda c: c | {"A": np.where(np.arange(len(c["A"])) == 7, np.nan, c["A"])}, {}, "'A' has nan at sample 8"),
    "unequal lengths": (lambda c: c | {"A": c["A"][:-1]}, {}, "must have as many samples in every channel"),
    "time that stands": (
        lambda c: c | {"time": np.round(c["time"], 3)},
        {"sample_rate": None, "time": "time", "time_unit": "s"},
        "must have ascending times in 'time'",
    ),
    "time that goes back": (
        lambda c: c | {"time": np.where(c["time"] > 1, c["time"] - 0.5, c["time"])},
        {"sample_rate": None, "time": "time", "time_unit": "s"},
        "is not after the one before (1 in all)",
    ),
    "no pulses": (lambda c: c | {"tacho": 0 * c["tacho"]}, {}, "must have tacho pulses, but the signal stays"),
    "too few pulses": (lambda c: {k: v[:1500] for k, v in c.items()}, {}, "must have at least 6 tacho pulses"),
    "the wrong channel": (lambda c: c | {"tacho": np.sin(np.arange(len(c["tacho"])) ** 1.7)}, {}, "evenly spaced"),
    "not the range": (
        lambda c: c,
        {"speeds": {"start_rpm": 800, "stop_rpm": 3500, "step_rpm": 100}},
        "must cover machine.recordings.speeds (800 to 3500 rpm) with windows of 8 revolutions, but it covers",
    ),
    "a speed that changes": (lambda c: c, {"records": "constant_speed"}, "must have a constant speed (to 1 %)"),
    "a table in a channel": (
        lambda c: c | {"A": np.stack([c["A"], c["A"]])},
        {},
        "must have one row of numbers in 'A'",
    ),
    "nothing": (lambda c: {k: v[:0] for k, v in c.items()}, {}, "must have samples, but its channels have 0"),
}


@pytest.mark.parametrize("case", BAD_SIGNALS)
def test_a_recording_that_does_not_fit(case: str, tmp_path: Path) -> None:
    """By the file and the channel."""
    change, changes, words = BAD_SIGNALS[case]
    path = write_hdf5(tmp_path / "one.h5", change(run_up(0.0)))
    with refused(words, "one.h5"):
        read(signal_config("", [RUNS[0] | {"file": str(path)}], **changes))


@pytest.mark.parametrize("ending", ["h5", "tdms", "csv"])
def test_a_truncated_recording_is_refused(ending: str, tmp_path: Path) -> None:
    """Half a file, a few bytes less, a file of something else, an empty one."""
    write, prefix, clock = CONTAINERS[ending]
    path = write(tmp_path / f"one.{ending}", {k: v[:4000] for k, v in run_up(0.0).items()}, RATE)
    content = path.read_bytes()
    section = signal_config(prefix, [RUNS[0] | {"file": str(path)}], **clock)
    for damaged in (content[: len(content) // 2], content[:-9], content[:30], b"", b"something else\n" * 9):
        path.write_bytes(damaged)
        with refused(path.name, "must"):
            read(section)


def test_a_file_that_says_another_rate(tmp_path: Path) -> None:
    """The configuration and a TDMS file that contradict each other."""
    path = write_tdms(tmp_path / "one.tdms", run_up(0.0), RATE)
    with refused("must have the sample rate of the configuration (5000 Hz), but it says 4000 Hz"):
        read(signal_config("run/", [RUNS[0] | {"file": str(path)}], sample_rate="5 kHz"))


def test_a_file_of_an_unknown_kind(tmp_path: Path) -> None:
    """By its ending."""
    (tmp_path / "one.mat").write_bytes(b"x")
    with refused("must end in .csv, .txt, .xlsx, .h5, .hdf5 or .tdms, but it ends in '.mat'"):
        read(signal_config("", [RUNS[0] | {"file": str(tmp_path / "one.mat")}]))


# --- the stage ----------------------------------------------------------------------------------------------------

KNOWN = ["kxy", "kyx", "cxx", "cxy", "cyx", "cyy"]


@pytest.fixture
def no_figures(monkeypatch: pytest.MonkeyPatch) -> None:
    """They take most of the time of the stage, and have a test of their own."""
    for name in ("draw_bode", "draw_measured_orbits"):
        monkeypatch.setattr(ingest, name, lambda path, *_: path)


@pytest.fixture
def ball_tables(machine: MachineFactory, tmp_path: Path) -> Path:
    """The vibration of the modelled ball-bearing rotor at its bearings, a long table, and its known coefficients."""
    made = machine("experiment=ball_bearing", "machine.speeds.step_rpm=245", TWO)
    rpm = made.speeds / RPM
    frames = {}
    for r, run in enumerate(made.runs):
        channels = {channel: made.dataset.displacement[:, i, r] for i, channel in enumerate(made.dataset.channels)}
        x, y = ({n: v for (n, a), v in channels.items() if a == axis} for axis in (0.0, 90.0))
        frames[run] = vectors_of(rpm, x.__getitem__, y.__getitem__)
    long(frames).to_csv(tmp_path / "all.csv", index=False)
    table = {"bearing_node": np.repeat(made.bearings.nodes, len(rpm)), "speed_rpm": np.tile(rpm, 2)}
    table |= {name: made.bearings.coefficient(name).ravel() for name in KNOWN}
    pd.DataFrame(table).to_excel(tmp_path / "known.xlsx", index=False)
    return tmp_path


TWO = (
    "machine.runs=[{name: one, unbalances: [{node: 1, magnitude: 1e-4}]},"
    "{name: two, unbalances: [{node: 1, magnitude: 2e-4, phase: 1}]}]"
)
BALL_RUNS = [
    {"name": "one", "unbalances": [{"node": 1, "magnitude": "100 g mm", "phase": "90 deg"}]},
    {"name": "two", "unbalances": [{"node": 1, "magnitude": "200 g mm", "phase": f"{90 - np.degrees(1)} deg"}]},
]


def ball_section(folder: Path, **changes: Any) -> dict[str, Any]:
    """Unbalances from the mark, against the rotation: p = 90 deg - s."""
    section = table_config(BALL_RUNS, "long", file=str(folder / "all.csv"), known=str(folder / "known.xlsx"))
    return section | {"shaft_angle": "against_rotation", "tacho": {"angle": "90 deg"}} | changes


@pytest.mark.slow
def test_ingest_then_train(ball_tables: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The files of the stage are those that training reads, and it finds the modelled stiffness in them."""
    out = ball_tables / "out"
    config = with_ingest(ball_section(ball_tables), output=str(out))
    run_stage(config)
    said = capsys.readouterr()
    assert "read as um, peak-to-peak, phase lag in deg, speed in rpm" in said.out
    assert "A (node 0, 45 deg)" in said.out
    assert "warning" not in said.err
    assert {p.name for p in out.iterdir()} == {
        *("vibration.parquet", "excitation.csv", "known_coefficients.csv", "ingest.json"),
        "figures",
    }
    assert json.loads((out / "ingest.json").read_text())["runs"]["two"]["speeds"] == 25
    files = {name: str(out / file) for name, file in FILES.items()}
    train = compose_config(["experiment=ball_bearing", "tracking=none", "optimizer=levenberg_marquardt"])
    update = {"output": str(ball_tables / "trained"), "data": train.data.model_copy(update=files)}
    run_stage(train.model_copy(update={"stage": "train"} | update))
    identified = pd.read_csv(ball_tables / "trained" / "identified_coefficients.csv")
    assert identified["kxx"].to_numpy() == pytest.approx(464.16883e5, rel=1e-4)
    assert identified["kyy"].to_numpy() == pytest.approx(1009.06269e5, rel=1e-4)


FILES = {"vibration": "vibration.parquet", "excitation": "excitation.csv", "known": "known_coefficients.csv"}


@pytest.mark.slow
@pytest.mark.usefixtures("no_figures")
def test_ingest_in_place_is_what_training_takes_next(ball_tables: Path, machine: MachineFactory) -> None:
    """In the experiment's own folder training reads the measured data; generate does not replace them, ingest does."""
    out = ball_tables / "out"
    config = with_ingest(ball_section(ball_tables), output=str(out))
    run_stage(config)
    with refused("generate must not replace what it did not write"):
        run_stage(config.model_copy(update={"stage": "generate"}))
    before = (out / "vibration.parquet").read_bytes()
    run_stage(config)
    assert (out / "vibration.parquet").read_bytes() == before
    rotor = machine("experiment=ball_bearing").rotor
    dataset = read_dataset(out / "vibration.parquet", out / "excitation.csv", rotor)
    assert dataset.excitations[1].phase == pytest.approx(1.0)
    assert dataset.excitations[1].magnitude == pytest.approx(2e-4)


@pytest.mark.usefixtures("no_figures")
def test_generated_and_foreign_data_are_not_replaced(ball_tables: Path) -> None:
    """Neither what generate wrote nor what somebody put there."""
    out = ball_tables / "out"
    config = with_ingest(ball_section(ball_tables), output=str(out))
    out.mkdir()
    shutil.copy(ball_tables / "all.csv", out / "vibration.parquet")
    for make in (False, True):
        if make:
            (out / "vibration.parquet").unlink()
            run_stage(config.model_copy(update={"stage": "generate"}))
        with refused("ingest must not replace what it did not write", "output=FOLDER"):
            run_stage(config)
    with refused("ingest must write the experiment's own files"):
        data = config.data.model_copy(update={"vibration": "a.csv"})
        run_stage(config.model_copy(update={"data": data}))


@pytest.mark.usefixtures("no_figures")
def test_units_that_the_model_contradicts_are_warned_of(
    ball_tables: Path, capsys: pytest.CaptureFixture[str], machine: MachineFactory
) -> None:
    """Unbalances in kg mm for g mm: a thousand times off; probes that are read the wrong way round: backward orbits."""
    section = ball_section(ball_tables)
    heavy = [run | {"unbalances": [run["unbalances"][0] | {"magnitude": "100 kg mm"}]} for run in BALL_RUNS]
    wrong = section | {"runs": heavy, "conventions": CONVENTIONS | {"phase": "lead"}}
    run_stage(with_ingest(wrong, output=str(ball_tables / "wrong")))
    warned = capsys.readouterr().err
    assert "times smaller than the rotor's on bearings of" in warned
    assert "the orbits of run 'one' turn backward at" in warned
    made = machine("experiment=ball_bearing", "machine.speeds.step_rpm=245", TWO)
    assert note_size(made.dataset, made.rotor, 1e7, 1e3) == []
    assert note_whirl(made.dataset) == []


@pytest.mark.usefixtures("no_figures")
def test_without_known_coefficients_it_says_what_training_needs(
    ball_tables: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Where all eight are unknown the file is made; where some are known somebody must give them."""
    out = ball_tables / "out"
    section = ball_section(ball_tables, known=None)
    run_stage(with_ingest(section, output=str(out)))
    assert not (out / "known_coefficients.csv").exists()
    assert "give their table as machine.recordings.known" in capsys.readouterr().out
    mapping = json.loads(_mapping())
    mapping["identify"]["unknowns"] = ["kxx", "kyy", *KNOWN]
    run_stage(with_ingest(section, output=str(out), identify=mapping["identify"]))
    assert list(pd.read_csv(out / "known_coefficients.csv")) == ["bearing_node", "speed_rpm"]


def test_known_coefficients_at_other_speeds(tmp_path: Path) -> None:
    """Interpolated within the table, refused beyond it."""
    rpm = np.linspace(500, 3000, 21)
    frame = pd.DataFrame({"bearing_node": 0, "speed_rpm": rpm, "cxx": 100 + (rpm / 1000) ** 2})
    frame.to_csv(tmp_path / "known.csv", index=False)
    of = {0: ("cxx",)}
    found = read_known(tmp_path / "known.csv", (0,), np.array([600.0, 2222.0]) * RPM, of)
    assert found.coefficient("cxx")[0] == pytest.approx([100.36, 100 + 2.222**2])
    for speeds, nodes, words in (
        ([400.0], (0,), "must cover the speeds of the data (400 to 400 rpm), but it has 500 to 3000 rpm"),
        ([600.0], (1,), "must have rows of the bearing at node 1, but it has 0"),
    ):
        with refused(words):
            read_known(tmp_path / "known.csv", nodes, np.array(speeds) * RPM, {0: ("cxx",), 1: ("cxx",)})
    pd.concat([frame, frame]).to_csv(tmp_path / "twice.csv", index=False)
    with refused("must have one row a speed, but some are there twice"):
        read_known(tmp_path / "twice.csv", (0,), np.array([600.0]) * RPM, of)


@pytest.mark.slow
@pytest.mark.usefixtures("no_figures")
def test_nothing_to_read_and_nodes_that_the_rotor_lacks(ball_tables: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The next step is named; exit code 2 on the command line."""
    assert main(["stage=ingest", "experiment=ball_bearing", "tracking=none", f"output={ball_tables}/x"]) == 2
    assert (
        "ingest must have recordings to read, but machine.recordings.format is none: say in a machine file"
        in capsys.readouterr().err
    )
    probes = probes_config({"A": (7, 0.0), "B": (7, 90.0)})
    with refused("machine.recordings.probes must use nodes 0 to 2 of the rotor, but got node 7", kind=ConfigError):
        run_stage(with_ingest(ball_section(ball_tables, probes=probes), output=str(ball_tables / "x")))
    heavy = [run | {"unbalances": [run["unbalances"][0] | {"node": 9}]} for run in BALL_RUNS]
    with refused("machine.recordings.runs, run 'one', must use nodes 0 to 2", kind=ConfigError):
        run_stage(with_ingest(ball_section(ball_tables, runs=heavy), output=str(ball_tables / "x")))
    assert not (ball_tables / "x").exists()


@pytest.mark.slow
def test_figures_show_something(tmp_path: Path) -> None:
    """Pictures of some size with curves in several colours; one speed, and a baseline that stands still, among them."""
    from matplotlib import image

    from pipeline.reporting.ingest_figures import draw_bode, draw_measured_orbits

    dataset = read(table_config(wide_runs(tmp_path)))
    displacement = dataset.displacement * np.array([0.0, 1.0])
    still = VibrationDataset(dataset.speeds, dataset.runs, dataset.channels, displacement, dataset.excitations)
    one = VibrationDataset(dataset.speeds[:1], dataset.runs, dataset.channels, displacement[:1], dataset.excitations)
    for path in (
        draw_bode(tmp_path / "a.png", still, "one"),
        draw_measured_orbits(tmp_path / "b.png", dataset, None),
        draw_measured_orbits(tmp_path / "c.png", one, "one"),
    ):
        pixels = image.imread(path)
        assert min(pixels.shape[:2]) > 500
        assert (np.ptp(pixels[..., :3], axis=-1) > 0.2).sum() > 500


# --- Excel wherever a table is read -----------------------------------------------------------------------------------


def test_an_excel_table_is_read_as_a_csv_is(tmp_path: Path) -> None:
    """Numbers, texts that look like numbers, blanks; dates and truths are no numbers."""
    frame = pd.DataFrame({"run": ["007", "NA", "x"], "a": [1.0, 2.5, -3e-7], "b": [1.0, np.nan, 3.0]})
    frame.to_csv(tmp_path / "t.csv", index=False)
    frame.to_excel(tmp_path / "t.xlsx", index=False)
    kinds = {"run": "text", "a": "number", "b": "number or blank"}
    csv, excel = (read_table(tmp_path / f"t.{ending}", kinds) for ending in ("csv", "xlsx"))
    assert csv["run"].tolist() == excel["run"].tolist() == ["007", "NA", "x"]
    for name in ("a", "b"):
        np.testing.assert_array_equal(csv[name], excel[name])
    frame.assign(a=pd.Timestamp("2026-05-01")).to_excel(tmp_path / "date.xlsx", index=False)
    frame.assign(a=True).to_excel(tmp_path / "true.xlsx", index=False)
    for name in ("date", "true"):
        with refused("must have finite numbers in the column 'a', but row 1 has"):
            read_table(tmp_path / f"{name}.xlsx", kinds)


def test_a_row_with_more_fields_than_the_header_is_refused(tmp_path: Path) -> None:
    """A decimal comma among commas would move the columns without a word."""
    path = tmp_path / "t.csv"
    path.write_text("a,b\n1,5,2\n3,5,4\n")
    with refused("must be a CSV table, but it can't be read as one"):
        read_table(path, {"a": "number", "b": "number"})
    path.write_text("a;b\n1,5;2\n3,5;4\n")
    assert read_table(path, {"a": "number"}, text=TextFormat(";", ","))["a"].tolist() == [1.5, 3.5]


def test_the_schema_of_the_section_is_closed() -> None:
    """An unknown key is refused wherever it stands."""
    with pytest.raises(ValidationError):
        parsed(table_config([ONE | {"speed": 3}]))
