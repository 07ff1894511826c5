"""``stage=new``: a template of a machine file that composes, and runs through every stage."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from conftest import refused
from machine_files import UNKNOWNS, given_by, machine_file

from pipeline.__main__ import main
from pipeline.config.compose import compose_config, compose_stages
from pipeline.config.loader import CONF
from pipeline.errors import ConfigError, DataError
from pipeline.stages import run_stage
from pipeline.stages.new import fill_template

pytestmark = pytest.mark.slow  # every test composes a configuration by Hydra: half a second each

EXAMPLE = CONF.parent / "examples" / "measured_demo"
KINDS = [
    (bearings, data)
    for bearings in ("rolling", "fluid_film")
    for data in ("simulated", "recordings", "tables", "processed")
]


def made_by_new(path: Path, *overrides: str) -> Path:
    """The file that `stage=new` writes."""
    run_stage(compose_config(["stage=new", given_by(path), *overrides]))
    return path


@pytest.mark.parametrize(("bearings", "data"), KINDS)
def test_a_template_composes(bearings: str, data: str, folder: Path) -> None:
    """Each kind, as it is; 120 columns, comments at every section, no key that the schema does not know."""
    path = folder / "rig 2.yaml"
    text = fill_template(path, bearings, data)
    path.write_text(text)
    for name in ("vibration.csv", "excitation.csv"):
        (folder / name).symlink_to(EXAMPLE / name)
    assert max(map(len, text.splitlines())) <= 120
    assert text.startswith("# ")
    config = compose_config([given_by(path)])
    assert config.identify.unknowns == UNKNOWNS[bearings]
    assert (config.machine.recordings.format == "none") == (data in ("simulated", "processed"))
    assert (config.data.vibration is not None) == (data == "processed")
    assert config.loss.noise == ("stated" if data == "simulated" else "estimated")
    assert config.name == "rig_2"
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


FEW = [f"machine.speeds.{key}" for key in ("start_rpm=1000", "stop_rpm=5000", "step_rpm=250")]
FEW += ["robustness.count=3", "design.simulations=3", "design.speeds=5", "comparison.data_sets=1"]
FEW += ["comparison.methods=[least_squares,response]", "comparison.workers=1", "comparison.noise=[0.01]"]


@pytest.mark.slow
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
    worst = max(error["median_error_percent"] for node in identified.values() for error in node.values())
    assert worst < 10
    said = capsys.readouterr().out
    assert "machine.runs_file=" in said
    assert "experiment=my_rig" not in said  # there is none of that name


@pytest.mark.slow
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
    held_out = json.loads((out / "metrics.json").read_text())["fit"]["held_out_speeds"]
    assert held_out["error_percent"] < 0.5
    for stage in ("compare", "robustness"):  # what needs a truth says so
        assert main([f"stage={stage}", *command]) == 2
