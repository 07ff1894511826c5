"""One file for a machine: read from any folder, written by ``stage=new``; keys of old are refused by their new name."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import yaml
from conftest import examples, refused
from hypothesis import given
from hypothesis import strategies as st
from machine_files import UNKNOWNS, given_by, machine_file

from pipeline.__main__ import main
from pipeline.config.compose import compose_config, compose_mapping, prepare_for_hydra
from pipeline.config.loader import CONF, list_options
from pipeline.config.schema import Config
from pipeline.errors import ConfigError
from pipeline.stages.new import fill_template

pytestmark = pytest.mark.slow  # every test composes a configuration by Hydra: half a second each


def test_a_machine_of_another_folder(folder: Path) -> None:
    """Its stem is the experiment's name, its bearings say what is identified, its probes how noisy it is."""
    config = compose_config([given_by(machine_file(folder))])
    assert (config.name, config.output) == ("pump_one", "artifacts/pump_one")
    assert (config.machine.file, config.identify.unknowns) == (str(folder / "pump one.yaml"), UNKNOWNS["rolling"])
    assert (config.model.kind, config.loss.kind) == ("constant", "response")
    assert config.stated_noise.multiplicative == config.machine.probes.multiplicative == 0.01


def test_a_path_from_the_working_folder(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = machine_file(folder, "plain.yaml")
    monkeypatch.chdir(folder)
    assert compose_config(["machine.file=plain.yaml"]).machine.file == str(path)
    monkeypatch.setenv("HOME", str(folder))
    assert compose_config(["machine.file=~/plain.yaml"]).machine.file == str(path)
    other = machine_file(folder, "rig (1), ü.yaml")
    assert compose_config([f"machine.file={other}", "name=x"]).machine.file == str(other)


def test_overrides_win_over_the_file(folder: Path) -> None:
    few = ["machine.probes.multiplicative=0.02", "machine.rotor.discs.0.width=40 mm", "name=mine", "model=network"]
    config = compose_config([*few, given_by(machine_file(folder)), "identify.unknowns=[kxx]"])
    assert config.machine.probes.multiplicative == config.stated_noise.multiplicative == 0.02
    assert config.machine.rotor.discs[0].width == pytest.approx(0.04)
    assert (config.name, config.model.kind, config.identify.unknowns) == ("mine", "network", ("kxx",))


def test_an_experiment_with_a_machine_of_ones_own(folder: Path) -> None:
    """The machine is the file's, the method the experiment's; both are in the name, for both are in the results."""
    config = compose_config([given_by(machine_file(folder)), "experiment=ball_bearing"])
    assert (config.name, config.identify.unknowns, config.machine.bearings.kind) == (
        "pump_one_ball_bearing",
        ("kxx", "kyy"),
        "linear",
    )


def test_paths_in_the_file_start_in_its_folder(folder: Path) -> None:
    """Those of rotor, runs, recordings and known tables; on the command line they start in the working folder."""
    recordings = yaml.safe_load(fill_template(folder, "rolling", "tables"))["recordings"]
    recordings["runs"][1]["file"] = "/data/first.csv"
    path = machine_file(
        folder,
        rotor={"file": "rotor.toml"},
        bearings={"kind": "rotor_file"},
        recordings=recordings | {"known": "known.csv"},
        runs=None,
    )
    machine = compose_config([given_by(path)]).machine
    assert (machine.rotor.file, machine.recordings.known) == (str(folder / "rotor.toml"), str(folder / "known.csv"))
    assert [run.file for run in machine.recordings.runs] == [
        str(folder / "recordings" / "as_found.csv"),
        "/data/first.csv",
        str(folder / "recordings" / "second_disc.csv"),
    ]
    assert compose_config([given_by(path), "machine.rotor.file=other.toml"]).machine.rotor.file == "other.toml"


def test_the_path_of_a_bearings_table_starts_there_and_the_name_of_one_is_none(folder: Path) -> None:
    sizes = {"journal_diameter": 0.1, "length": 0.05, "radial_clearance": 1e-4, "static_load": 500, "load_share": 1}
    law = {"kind": "journal_table", **sizes}
    laws = {
        "oil": {"law": "constant", "viscosity": 0.02},
        "bearings": {1: law | {"table": "own.csv"}, 5: law | {"table": "elliptical", "preload": 0.3}},
    }
    read = compose_config([given_by(machine_file(folder, laws=laws))]).machine.laws
    assert [getattr(one, "table", "") for one in read.bearings.values()] == [str(folder / "own.csv"), "elliptical"]


def test_paths_of_many_files_and_of_one_for_all(folder: Path) -> None:
    recordings = yaml.safe_load(fill_template(folder, "rolling", "recordings"))["recordings"]
    for run in recordings["runs"]:
        del run["file"]
    recordings["runs"][1]["files"] = ["a.h5", "../b.h5"]
    path = machine_file(folder, recordings=recordings | {"records": "constant_speed", "file": "all.h5"})
    read = compose_config([given_by(path)]).machine.recordings
    assert read.file == str(folder / "all.h5")
    assert (read.runs[1].files, read.known) == ((str(folder / "a.h5"), str(folder.parent / "b.h5")), "bearings")


def test_a_changed_file_is_another_machine(folder: Path) -> None:
    path = machine_file(folder)
    assert compose_config([given_by(path)]).machine.bearings.kxx == 4e7
    path.write_text(path.read_text().replace("kxx: 4.0e7", "kxx: 5.0e7"))
    assert compose_config([given_by(path)]).machine.bearings.kxx == 5e7


def test_a_command_can_be_given_again(folder: Path) -> None:
    path = machine_file(folder, "a (b), 'c'.yaml")
    escaped = str(path).replace("'", "\\'")
    config = compose_config([f"machine.file='{escaped}'"])
    assert config.chosen.startswith('"') or config.chosen.startswith("'")
    import shlex

    (again,) = shlex.split(config.chosen)
    assert compose_config([again]).machine.file == str(path)
    assert compose_config(["experiment=ball_bearing"]).chosen == "experiment=ball_bearing"
    assert compose_config(["machine=one_disc"]).chosen == "machine=one_disc"


def test_a_folder_of_machines_and_experiments(folder: Path) -> None:
    """`--config-dir`: machines build upon those of conf/, experiments name them; paths start in their own folder."""
    (folder / "machine").mkdir()
    (folder / "experiment").mkdir()
    (folder / "machine" / "mine.yaml").write_text("defaults: [two_discs, _self_]\nrunns_file: x\n".replace("nn", "n"))
    (folder / "machine" / "x").write_text("speeds: {start_rpm: 500, stop_rpm: 900, step_rpm: 100}\nruns: []\n")
    text = "# @package _global_\ndefaults: [noisy_all, override /machine: mine, _self_]\nname: theirs\n"
    (folder / "experiment" / "theirs.yaml").write_text(text + "machine: {probes: {seed: 3}, runs_file: null}\n")
    config = compose_config(["experiment=theirs"], folder)
    assert (config.name, config.machine.probes.seed, config.machine.probes.at) == ("theirs", 3, "bearings")
    mapping = compose_mapping(["machine=mine"], folder)
    assert (mapping["name"], mapping["machine"]["runs_file"], len(mapping["identify"]["unknowns"])) == (
        "mine",
        str(folder / "machine" / "x"),
        8,
    )
    assert compose_mapping(["machine=mine", "experiment=noisy_direct"], folder)["name"] == "mine_noisy_direct"
    with refused("a file in conf/machine", "'mine'", kind=ConfigError):
        compose_config(["machine=mine"])  # nothing is left of it


@pytest.mark.slow
def test_the_folder_on_the_command_line(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (folder / "machine").mkdir()
    machine_file(folder / "machine", "mine.yaml")
    for option in (["--config-dir", str(folder)], [f"--config-dir={folder}"], ["-cd", str(folder)]):
        assert main([*option, "machine=mine", "--cfg", "job"]) == 0
        assert "name: mine" in capsys.readouterr().out
    assert main(["stage=configure", f"--config-dir={folder}", "machine=mine", "tracking=none"]) == 0
    assert Path("artifacts/mine/config.yaml").exists()
    command = ["-m", "stage=configure", given_by(folder / "machine" / "mine.yaml"), "seed=1,2", "tracking=none"]
    assert main(command) == 0
    assert {path.name for path in Path("artifacts/mine").iterdir()} == {"config.yaml", "seed-1", "seed-2"}


@pytest.mark.parametrize(
    ("files", "words"),
    [
        ({}, "has none: move the files there"),
        ({"machine/two_discs.yaml": "speeds: {}"}, "a name of its own, but conf/ has machine/two_discs.yaml too"),
        ({"machine/mine.yaml": "rotor: ["}, "must be YAML"),
    ],
)
def test_a_folder_that_is_refused(files: dict[str, str], words: str, folder: Path) -> None:
    for name, text in files.items():
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).write_text(text)
    with refused(words, str(folder), kind=ConfigError):
        compose_mapping([], folder)
    with refused("--config-dir must be a folder", kind=ConfigError):
        compose_mapping([], folder / "nowhere")


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("rotor: [1,\n", ["must be YAML", "line 2"]),
        ("rotor:\n\t- x\n", ["must be YAML", "line 2"]),
        ("rotor: {}\nrotor: {}\n", ["must be YAML", "duplicate key rotor"]),
        ("- a\n- b\n", ["must have keys with values"]),
        ("just words\n", ["must have keys with values"]),
        ("", ["must have keys with values"]),
        ("5\n", ["must"]),
        ("defaults: [two_discs]\nrotor: {}\n", ["complete in itself", "--config-dir"]),
        ("machine: {rotor: {}}\n", ["at its top", "below 'machine'"]),
        ("file: other.yaml\nrotor: {}\n", ["on the command line alone"]),
        ("bearing: {kind: ball}\n", ["machine.bearing: must be a key", "did you mean 'bearings'?"]),
        ("x: !!python/object/apply:os.system ['echo ran']\n", ["must"]),
        ("rotor: {file: '${oc.env:HOME}'}\n", ["refer to its own keys alone", "has ${oc.env:HOME}"]),
        ("x: " + "[" * 10**5, ["must be YAML with plain keys", "recursion"]),
        ("x0: &x0 [1, 1]\n" + "".join(f"x{i}: &x{i} [*x{i - 1}, *x{i - 1}]\n" for i in range(1, 40)), ["aliases make"]),
    ],
)
def test_a_file_that_is_no_machine(text: str, words: list[str], folder: Path) -> None:
    path = folder / "x.yaml"
    path.write_text(text)
    with refused(*words, str(path), kind=ConfigError):
        compose_config([given_by(path)])


def test_a_path_that_is_no_file(folder: Path) -> None:
    path = machine_file(folder)
    (folder / "bytes").write_bytes(b"\xff\xfe\x00r")
    for overrides, *words in (
        ([given_by(folder / "pump_one.yaml")], "there is no file", "did you mean 'pump one.yaml'?", "stage=new"),
        ([given_by(folder)], "is a folder", "pump one.yaml"),
        ([given_by(folder / "bytes")], "UTF-8"),
        (["machine.file=3"], "must be the path of a machine file"),
        (["machine.file=a.yaml,b.yaml"], "must be one file"),
        (["machine=one_disc", given_by(path)], "must have one machine"),
    ):
        with refused(*words, kind=ConfigError), prepare_for_hydra(overrides, None):
            pass


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"rotr": {"file": "x"}}, ["machine.rotr: must be a key that the schema knows", "did you mean 'rotor'?"]),
        ({"bearings": {"kind": "bal"}}, ["machine.bearings.kind", "did you mean 'ball'?"]),
        ({"runs": None}, ["machine.runs: must be given"]),
        ({"speeds": None}, ["machine.speeds: must be given"]),
        ({"bearings": None}, ["machine.bearings: must be given"]),
        ({"recordings": {"format": "tabel"}}, ["machine.recordings.format", "did you mean 'table'?"]),
        ({"runs": [{"name": "a", "forces": [{"node": 99, "magnitude": 1}]}]}, ["nodes 0 to 6", "run 'a'", "node 99"]),
        ({"residual_unbalance": [{"node": 9, "magnitude": 1e-4}]}, ["residual_unbalance got node 9"]),
    ],
)
def test_values_that_no_machine_has(changes: dict[str, Any], words: list[str], folder: Path) -> None:
    path = machine_file(folder, **changes)
    with refused(*words, str(path), "Correct this value", kind=ConfigError):
        compose_config([given_by(path)])


@pytest.mark.slow
@examples(30)
@given(content=st.binary(max_size=60) | st.text(max_size=60).map(str.encode))
def test_whatever_the_file_holds_the_answer_is_a_sentence(
    content: bytes, tmp_path_factory: pytest.TempPathFactory
) -> None:
    path = tmp_path_factory.mktemp("any") / "x.yaml"
    path.write_bytes(content)
    with pytest.raises(ConfigError, match="must"):
        compose_config([given_by(path)])


def test_recorded_runs_stand_for_those_of_a_design(folder: Path) -> None:
    """Speeds and runs of a measured machine are those of its recordings: angles from x, the baseline left out."""
    path = folder / "rig.yaml"
    path.write_text(
        fill_template(path, "rolling", "recordings").replace("tacho: {angle: 0 deg", "tacho: {angle: 90 deg")
    )
    config = compose_config([given_by(path)])
    machine = config.machine
    assert machine.speeds == machine.recordings.speeds
    assert [run.name for run in machine.runs] == ["first_disc", "second_disc"]
    assert [run.unbalances[0].phase for run in machine.runs] == pytest.approx([1.5707963, 3.1415927])
    assert (config.data.baseline, config.loss.noise) == ("as_found", "estimated")
    assert Config.model_validate(config.model_dump()).machine == machine


def test_wrong_recordings_are_told_alone(folder: Path) -> None:
    path = folder / "rig.yaml"
    path.write_text(fill_template(path, "rolling", "recordings").replace("edge: rising", "edge: riising"))
    with pytest.raises(ConfigError) as caught:
        compose_config([given_by(path)])
    assert [line.partition(":")[0] for line in str(caught.value).splitlines()[:-1]] == ["machine.recordings.tacho.edge"]


def test_a_new_kind_keeps_nothing_of_the_former() -> None:
    """Whole sections, single keys, one bearing of several, and the format of recordings."""
    linear = compose_config(["machine.bearings={kind: linear, kxx: 1e7, kyy: 2e7}"]).machine
    assert (linear.bearings.kind, linear.bearings.kyy) == ("linear", 2e7)
    journals = ["experiment=compressor_two_journals", "machine.bearings.nodes.21={kind: linear, kxx: 1e9, kyy: 1e9}"]
    assert compose_config(journals).machine.bearings.nodes[21].kind == "linear"
    assert compose_config(["experiment=measured_demo", "machine.recordings.format=none"]).machine.recordings.format == (
        "none"
    )
    same = compose_config(["machine.bearings.kind=cylindrical", "machine.bearings.length=31 mm"]).machine
    assert same.bearings.length == pytest.approx(0.031)


@pytest.mark.slow
@pytest.mark.parametrize("name", list_options("machine"))
def test_a_machine_alone_has_its_name_and_an_experiment_of_its_kind(name: str) -> None:
    """Rolling bearings are constants, the others functions of the speed, of recordings with a population as prior;
    recordings have noise of a size to find.
    """
    config = compose_config([f"machine={name}"])
    rolling = config.machine.bearings.kind in ("ball", "linear")
    recorded = config.machine.recordings.format != "none"
    assert (config.name, config.loss.noise, config.model.kind, config.identify.unknowns) == (
        name,
        "estimated" if recorded else "stated",
        "constant" if rolling else "bearings_network" if recorded else "network",
        UNKNOWNS["rolling" if rolling else "fluid_film"],
    )
    assert (
        Config.model_validate(config.model_dump()).model_copy(
            update={"chosen_by": config.chosen_by, "overrides": config.overrides}
        )
        == config
    )


@pytest.mark.parametrize("override", ["rotor.file=x", "~rotor.discs", "rotor=two_discs"])
def test_a_key_without_its_section_is_refused_with_it(override: str) -> None:
    with refused("must name a key", "did you mean 'machine.rotor", kind=ConfigError):
        compose_mapping([override])


def test_a_mistake_in_a_machine_file_needs_nothing_heavy(folder: Path) -> None:
    program = (
        "import sys\nfrom pipeline.__main__ import main\ncode = main(sys.argv[1:])\n"
        "print({'torch', 'ross', 'pandas', 'matplotlib', 'mlflow'} & set(sys.modules))\nsys.exit(code)"
    )
    command = [sys.executable, "-c", program, given_by(machine_file(folder, bearings={"kind": "bal"}))]
    done = subprocess.run(command, cwd=CONF.parent, capture_output=True, text=True)
    assert (done.returncode, done.stdout.strip()) == (2, "set()")
    assert "did you mean 'ball'?" in done.stderr
