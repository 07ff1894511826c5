"""``stage=new``: a template of a machine file that composes, and runs through every stage."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import scipy.io
from conftest import refused
from machine_files import UNKNOWNS, given_by, machine_file
from measured_files import uff_set, write_hdf5, write_tdms, write_uff
from running import EXAMPLE
from scipy.io import wavfile

from pipeline.__main__ import main
from pipeline.config.compose import compose_config, compose_stages
from pipeline.errors import ConfigError, DataError
from pipeline.stages import run_stage
from pipeline.stages.new import fill_template

pytestmark = pytest.mark.slow  # every test composes a configuration by Hydra: half a second each

KINDS = [
    (bearings, data, "none", "shaft")
    for bearings in ("rolling", "fluid_film")
    for data in ("simulated", "recordings", "tables", "processed")
] + [
    ("rolling", "simulated", "pedestals", "both"),
    ("fluid_film", "simulated", "base", "relative"),
    ("fluid_film", "recordings", "base", "casing"),
    ("rolling", "tables", "pedestals", "both"),
    ("rolling", "exciter", "none", "shaft"),
    ("fluid_film", "exciter", "pedestals", "casing"),
]


def made_by_new(path: Path, *overrides: str) -> Path:
    """The file that `stage=new` writes."""
    run_stage(compose_config(["stage=new", given_by(path), *overrides]))
    return path


@pytest.mark.parametrize(("bearings", "data", "supports", "probes"), KINDS)
def test_a_template_composes(bearings: str, data: str, supports: str, probes: str, folder: Path) -> None:
    """Each kind, as it is; 120 columns, comments at every section, no key that the schema does not know."""
    path = folder / "rig 2.yaml"
    text = fill_template(path, bearings, data, supports, probes)
    path.write_text(text)
    for name in ("vibration.csv", "excitation.csv"):
        (folder / name).symlink_to(EXAMPLE / name)
    assert max(map(len, text.splitlines())) <= 120
    assert text.startswith("# ")
    config = compose_config([given_by(path)])
    assert (config.name, config.identify.unknowns, config.loss.noise) == (
        "rig_2",
        UNKNOWNS[bearings],
        "stated" if data == "simulated" else "estimated",
    )
    assert (config.machine.recordings.format == "none") == (data in ("simulated", "processed"))
    assert (config.data.vibration is not None) == (data == "processed")
    ground = {"none": (0, 0), "pedestals": (2, 0), "base": (0, 2)}
    assert (len(config.machine.rotor.supports), len(config.machine.rotor.base.points)) == ground[supports]
    listed = config.machine.probes.at if data == "simulated" else config.machine.recordings.probes.values()
    relative = "shaft relative to casing"
    motions = {"both": {"casing", relative}, "casing": {"casing"}, "relative": {relative}}
    assert probes == "shaft" or {probe.measures for probe in listed} == motions[probes]
    if data == "processed":  # its speeds and runs are those of the files
        assert config.machine.speeds.model_dump() == {"start_rpm": 1500, "stop_rpm": 5800, "step_rpm": 100}
        assert [len(run.unbalances) for run in config.machine.runs] == [1, 1, 2]


def test_new_says_the_next_command(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = folder / "rig.yaml"
    assert main(["stage=new", given_by(path)]) == 0
    assert f"stage=identify 'machine.file=\\'{path}\\''" in capsys.readouterr().out.replace("'\"'\"'", "\\'")
    assert [p.name for p in folder.iterdir()] == ["rig.yaml"]
    assert list(Path().iterdir()) == []
    made_by_new(folder / "other.yaml", "new.data=tables")
    assert "stage=identify" in capsys.readouterr().out


def test_new_replaces_nothing(folder: Path) -> None:
    path = machine_file(folder)
    before = path.read_bytes()
    (folder / "link.yaml").symlink_to(folder / "nowhere.yaml")
    for name in ("pump one.yaml", "link.yaml"):
        with refused("must not replace a file", name, kind=DataError):
            made_by_new(folder / name)
    assert path.read_bytes() == before
    with refused("add machine.file=my_machine.yaml", kind=ConfigError):
        run_stage(compose_config(["stage=new"]))
    with refused("must end in .yaml", kind=ConfigError):
        made_by_new(folder / "rig.txt")
    with refused("a command of its own", kind=ConfigError):
        compose_stages(["stage=[new,train]", given_by(folder / "x.yaml")])
    with refused("new.data: must be one of these", "did you mean 'tables'?", kind=ConfigError):
        made_by_new(folder / "rig.yaml", "new.data=table")


FEW = [
    *(f"machine.speeds.{key}" for key in ("start_rpm=1000", "stop_rpm=5000", "step_rpm=250")),
    *("robustness.count=3", "robustness.workers=1", "design.simulations=3", "design.speeds=5"),
    *(f"comparison.{key}" for key in ("data_sets=1", "methods=[least_squares,response]", "workers=1", "noise=[0.01]")),
]


@pytest.mark.usefixtures("no_pictures")
@pytest.mark.parametrize("bearings", ["rolling", "fluid_film"])
def test_a_simulated_template_runs_through_every_stage(
    bearings: str, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = made_by_new(folder / "my rig.yaml", f"new.bearings={bearings}")
    out = folder / "out"
    stages = "generate,diagnose,design,train,evaluate,robustness,predict,summary,configure,compare"
    command = [f"stage=[{stages}]", given_by(path), f"output='{out}'", "tracking=none", *FEW]
    assert main(command) == 0, capsys.readouterr().err
    identified = json.loads((out / "metrics.json").read_text())["coefficients"]
    assert max(error["median_error_percent"] for node in identified.values() for error in node.values()) < 10
    said = capsys.readouterr().out
    assert "machine.runs_file=" in said
    assert "experiment=my_rig" not in said  # there is none of that name


@pytest.mark.usefixtures("no_pictures")
@pytest.mark.parametrize("data", ["recordings", "tables"])
def test_a_template_for_recordings_asks_for_paths_and_positions_alone(data: str, folder: Path) -> None:
    (folder / "recordings").symlink_to(EXAMPLE)
    (folder / "rotor.toml").symlink_to(EXAMPLE / "rotor.toml")
    path = made_by_new(folder / "rig.yaml", "new.bearings=rolling", f"new.data={data}")
    filled_in = {
        "  file: null": "  file: rotor.toml",
        "sample_rate: 10 kHz": "sample_rate: 2.5 kHz",
        "7.87 V/mm": "200 mV/mil",
        "length: um  ": "length: mil  ",
        "um pp": "mil pp",
        "left deg}": "left deg lag}",
        "right deg}": "right deg lag}",
        "speed: speed_rpm": "speed: rpm",
        "{node: 2, magnitude: 100 g mm, phase: 0 deg}]}": "{node: 2, magnitude: 200 g mm, phase: 0 deg}]}",
        "{node: 4, magnitude: 100 g mm, phase: 90 deg}]}": "{node: 4, magnitude: 200 g mm, phase: 90 deg}]}",
    }
    text = path.read_text()
    for old, new in filled_in.items():
        text = text.replace(old, new)
    path.write_text(text)
    out = folder / "out"
    command = [given_by(path), f"output='{out}'", "tracking=none", "design.simulations=0", "design.speeds=5"]
    assert main(["stage=[ingest,diagnose,train,evaluate,predict,summary,design]", *command]) == 0
    assert json.loads((out / "ingest.json").read_text())["runs"].keys() == {"as_found", "first_disc", "second_disc"}
    assert json.loads((out / "metrics.json").read_text())["fit"]["held_out_speeds"]["error_percent"] < 0.5
    for stage in ("compare", "robustness"):  # what needs a truth says so
        assert main([f"stage={stage}", *command]) == 2


def write_log(folder: Path, kind: str) -> Path:
    """The runs of the example as a logger exports them: cp1252, semicolons, decimal commas, a row of units, or
    ``groups`` of columns below the names of the probes; or a workbook."""
    tables = {name: pd.read_csv(EXAMPLE / f"{name}.csv") for name in ("as_found", "first_disc", "second_disc")}
    if kind == "workbook":
        with pd.ExcelWriter(folder / "all.xlsx") as book:
            for name, table in tables.items():
                table.to_excel(book, sheet_name=name, index=False)
        return folder / "all.xlsx"
    parts = [f"{probe} {part}" for probe in PROBES for part in ("Amp", "Phase")]
    heads = {
        "csv": [";".join(["Speed", *parts]), "rpm;" + ";".join(["µm pp;° lag"] * len(PROBES))],
        "groups": [
            ";" + ";;".join(PROBES) + ";",
            "Speed [rpm];" + ";".join(["Amp [µm pp];Phase [° lag]"] * len(PROBES)),
        ],
    }
    for name, table in tables.items():
        scaled = table * [1.0, *[25.4, 1.0] * len(PROBES)]
        rows = scaled.to_csv(sep=";", decimal=",", header=False, index=False, lineterminator="\r\n")
        (folder / f"{name}.csv").write_bytes("\r\n".join([*heads[kind], rows]).encode("cp1252"))
    return folder / "first_disc.csv"


PROBES = ("DE_left", "DE_right", "NDE_left", "NDE_right")


@pytest.mark.usefixtures("no_pictures")
@pytest.mark.parametrize("kind", ["csv", "groups", "workbook"])
def test_a_file_of_a_logger_fills_the_machine_file(kind: str, folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Three edited lines, and vibration as by the machine file that somebody wrote by hand for the same runs."""
    rotor = f"machine.rotor.file='{EXAMPLE / 'rotor.toml'}'"
    path = made_by_new(folder / "rig.yaml", "new.bearings=rolling", f"new.from='{write_log(folder, kind)}'", rotor)
    assert ("cp1252, ';' between fields, decimal commas" in capsys.readouterr().out) == (kind != "workbook")
    with refused("unbalances must be given, but is ???: write it in place of the ???", kind=ConfigError):
        compose_config([given_by(path)])
    edits = {
        '"first_disc.*"???"': "{node: 2, magnitude: 200 g mm, phase: 0 deg}",
        '"second_disc.*"???"': "{node: 4, magnitude: 200 g mm, phase: 90 deg}",
        "start_rpm: 700, stop_rpm: 5900, step_rpm: 100": "start_rpm: 1500, stop_rpm: 5800, step_rpm: 100",
    }
    text = path.read_text()
    for old, new in edits.items():
        filled = rf"\g<0>[{new}]" if "???" in old else new
        text, count = re.subn(old.replace("???", r"\?\?\?"), filled, text)
        assert count == 1, old
    path.write_text(text.replace('"???"[', "["))
    vibration = []
    for machine in (path, EXAMPLE / "tables.yaml"):
        out = folder / f"out {machine.stem}"
        assert main(["stage=ingest", given_by(machine), f"output='{out}'", "tracking=none"]) == 0
        vibration.append(pd.read_parquet(out / "vibration.parquet"))
        said = capsys.readouterr().err
        assert said.count("is read as") <= 1  # of the first file, which names the others
        assert ("; so for 'first_disc.csv'; so for 'second_disc.csv'" in said) == ("is read as" in said)
    assert np.allclose(vibration[0]["amplitude_m"], vibration[1]["amplitude_m"], rtol=1e-9)
    assert np.allclose(vibration[0]["phase_deg"], vibration[1]["phase_deg"], atol=1e-6)


TIME = np.arange(400) / 1000
SIGNALS = {"DE_left": np.sin(300 * TIME), "DE_right": np.cos(300 * TIME), "tacho": np.sign(np.sin(300 * TIME))}
WRITERS: dict[str, Callable[[Path], object]] = {
    "h5": lambda path: write_hdf5(path, {f"signals/{name}": values for name, values in SIGNALS.items()}, 1000.0),
    "tdms": lambda path: write_tdms(path, SIGNALS, 1000.0),
    "mat": lambda path: scipy.io.savemat(path, SIGNALS | {"fs": 1000.0, "title": "pump"}),
    "npz": lambda path: np.savez(path, **SIGNALS, time=TIME),
    "wav": lambda path: wavfile.write(path, 1000, np.stack(list(SIGNALS.values()), axis=1)),
    "uff": lambda path: write_uff(
        path,
        [
            uff_set(TIME, values, 1, place, [name, path.stem], abscissa_spacing=1)
            for place, (name, values) in enumerate(SIGNALS.items(), 1)
        ],
    ),
}


@pytest.mark.parametrize("ending", WRITERS)
def test_signals_of_any_format_fill_the_machine_file(ending: str, folder: Path) -> None:
    """What the libraries of the formats wrote is read by the keys that were recognised, with its times."""
    for run in ("as_found", "first"):
        WRITERS[ending](folder / f"{run}.{ending}")
    path = made_by_new(folder / "rig.yaml", f"new.from='{folder / 'first'}.{ending}'")
    text = path.read_text().replace("signal_unit: ???", "signal_unit: V").replace('channel: "???"', 'channel: "3"')
    path.write_text(text.replace('"???"', "[{node: 2, magnitude: 9 g mm, phase: 0 deg}]"))
    recordings = compose_config([given_by(path)]).machine.recordings
    loaded = recordings.load(recordings.runs[-1], Path(recordings.runs[-1].file))
    assert [run.name for run in recordings.runs] == ["as_found", "first"]
    np.testing.assert_allclose(loaded.time, TIME, atol=1e-6)
    np.testing.assert_allclose([*loaded.signals.values()][:2], [*SIGNALS.values()][:2], atol=1e-6)
