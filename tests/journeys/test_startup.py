"""What a command must not wait for: packages that it does not need, and what was made before."""

from __future__ import annotations

import json
import os
import re
import signal
import sqlite3
import subprocess
import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from conftest import refused
from hypothesis import given, settings
from hypothesis import strategies as st
from running import ENVIRONMENT, FEW_SPEEDS, ROOT

from pipeline import files
from pipeline.__main__ import main
from pipeline.config.compose import compose_config, compose_stages
from pipeline.config.rotor import RotorConfig
from pipeline.config.schema import TrackingConfig
from pipeline.data.tables import read_table, write_table
from pipeline.errors import ConfigError
from pipeline.rotor import ross_adapter
from pipeline.rotor.stored import KIND, hash_rotor, load_modelled_bearings, load_rotor
from pipeline.tracking import StageRecord, recorder_beside, track, tracker

BALL = ["experiment=ball_bearing", "tracking=none", "optimizer.adam.steps=3", *FEW_SPEEDS]


@pytest.fixture
def own_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty cache for one test."""
    monkeypatch.setattr(files, "CACHE", tmp_path / "cache")
    return tmp_path / "cache"


PROGRAM = """
import contextlib, io, json, sys
from pipeline.__main__ import main
codes, said = [], []
for command in json.loads(sys.argv[1]):
    with contextlib.redirect_stderr(io.StringIO()) as err:
        codes.append(main(command))
    said.append(err.getvalue())
print(json.dumps([codes, said, sorted(sys.modules)]))
"""


def imported_by(*commands: list[str]) -> tuple[list[int], list[str], set[str]]:
    """Exit codes, what was said on stderr, and the modules imported by commands in a process of their own."""
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM, json.dumps(commands)], cwd=ROOT, capture_output=True, text=True
    )
    assert done.stdout, done.stderr
    codes, said, modules = json.loads(done.stdout.splitlines()[-1])
    return codes, said, set(modules)


@pytest.mark.slow
@pytest.mark.parametrize("stated", ["", "2"])
def test_a_script_takes_one_thread_unless_it_states_more(stated: str) -> None:
    """As torch and the BLAS of numpy themselves say; unasked, each takes every core."""
    ours = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS")
    others = {name: value for name, value in os.environ.items() if name not in ours}
    given = others | (dict.fromkeys(ours, stated) if stated else {})
    code = "import pipeline, numpy, torch; from threadpoolctl import threadpool_info as info; print(info())"
    said = subprocess.run([sys.executable, "-c", code], cwd=ROOT, env=given, capture_output=True, text=True).stdout
    assert set(re.findall(r"'num_threads': (\d+)", said)) == {stated or "1"}


@pytest.mark.slow
def test_training_again_needs_torch_and_little_else(tmp_path: Path) -> None:
    """Data there, rotor seen before, stated or in a file: neither ROSS nor pandas nor torch's compiler."""
    of_file = (
        f"machine.rotor.file='{ROOT / 'examples' / 'measured_demo' / 'rotor.toml'}'",
        *("machine.rotor.bearing_nodes=[]", "machine.bearings.kind=rotor_file"),
        "machine.runs=[{name: one, unbalances: [{node: 2, magnitude: 1e-4}]}]",
    )
    commands = [
        ["stage=train", *BALL, *rotor, f"output='{tmp_path / name}'"]
        for name, rotor in (("stated", ()), ("file", of_file))
    ]
    assert [main(command) for command in commands] == [0, 0]
    codes, _, modules = imported_by(*commands)
    assert codes == [0, 0]
    assert "torch" in modules
    unneeded = {"ross", "pandas", "torch._dynamo", "matplotlib", "mlflow", "optuna", "pyarrow.dataset"}
    assert unneeded & modules == set()


MISTAKES = [
    ("vibration", "run,speed_rpm,node,direction,amplitude_m\none,500,0,x,1e-6", "the column 'phase_deg'"),
    (
        "vibration",
        "run,speed_rpm,node,direction,amplitude_m,phase_deg\none,500,99,x,1e-6,0",
        "but got node 99",
    ),
    (
        "excitation",
        "run,kind,node,magnitude,phase_deg,whirl\none,weight,1,1e-4,0,forward",
        "'unbalance' or",
    ),
    ("known", "bearing_node,speed_rpm,kxx\n0,500,1e7", "the column"),
]


@pytest.mark.slow
def test_a_mistake_in_a_data_file_is_told_before_anything_heavy(tmp_path: Path) -> None:
    """Neither ROSS nor torch is imported for any of the sentences."""
    texts = {
        "vibration": "run,speed_rpm,node,direction,amplitude_m,phase_deg\none,500,0,x,1e-6,0\none,500,0,y,1e-6,0",
        "excitation": "run,kind,node,magnitude,phase_deg,whirl\none,unbalance,1,1e-4,0,forward",
        "known": "bearing_node,speed_rpm,cxx,cyy\n0,500,1,1\n2,500,1,1",
    }
    commands = []
    for i, (file, text, _) in enumerate(MISTAKES):
        for name, good in texts.items():
            (tmp_path / f"{i}{name}.csv").write_text(f"{text if name == file else good}\n")
        data = [f"data.{name}='{tmp_path}/{i}{name}.csv'" for name in texts]
        commands.append(["stage=train", *BALL, *data, f"output='{tmp_path}/out'"])
    codes, said, modules = imported_by(*commands)
    assert codes == [2] * len(MISTAKES)
    assert [words for sentence, (*_, words) in zip(said, MISTAKES, strict=True) if words not in sentence] == []
    assert {"ross", "torch"} & modules == set()


def test_a_cache_that_cannot_be_written_costs_time_only(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "cache").write_text("in the way")
    monkeypatch.setattr(files, "CACHE", tmp_path / "cache")
    rotor = compose_config(BALL).machine.rotor
    assert load_rotor(rotor).fingerprint == load_rotor(rotor).fingerprint


def test_the_oldest_entries_go(own_cache: Path) -> None:
    for i in range(5):
        files.keep("things", f"entry{i}", b"x", most=3)
    assert len(list((own_cache / "things").iterdir())) == 3
    assert files.look_up("things", "entry4") == b"x"


def test_parts_of_an_identity_are_kept_apart() -> None:
    assert files.hash_parts("ab", "c") != files.hash_parts("a", "bc")
    assert files.hash_parts("ab", b"c") == files.hash_parts(b"ab", "c")


def test_a_kept_rotor_is_the_assembled_one(own_cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    config, speeds = compose_config(BALL), np.array([100.0, 200.0])
    first, bearings = (
        load_rotor(config.machine.rotor),
        load_modelled_bearings(config.machine.rotor, config.machine.bearings, speeds),
    )
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(ross_adapter, "assemble", None)
        patch.setattr(ross_adapter, "bearing_table", None)
        again, kept = (
            load_rotor(config.machine.rotor),
            load_modelled_bearings(config.machine.rotor, config.machine.bearings, speeds),
        )
    for name in ("mass", "damping", "gyroscopic", "stiffness", "positions"):
        assert getattr(again, name).tobytes() == getattr(first, name).tobytes()
    for name in ("bearing_nodes", "disc_nodes", "total_mass"):
        assert getattr(again, name) == getattr(first, name)
    assert (kept.nodes, kept.values.tobytes()) == (bearings.nodes, bearings.values.tobytes())
    (own_cache / KIND / hash_rotor(config.machine.rotor)).write_bytes(b"damaged")
    assert load_rotor(config.machine.rotor).fingerprint == first.fingerprint


def test_a_damaged_entry_is_no_entry(own_cache: Path) -> None:
    """Cut anywhere, with any of its bits turned, or under another name: what was kept is not believed."""
    files.keep("things", "key", b"12.5")
    path = own_cache / "things" / "key"
    kept = path.read_bytes()
    turned = [kept[:i] + bytes([kept[i] ^ 1 << bit]) + kept[i + 1 :] for i in range(len(kept)) for bit in range(8)]
    for damaged in (*(kept[:i] for i in range(len(kept))), *turned, b"12.5", kept + b"0"):
        path.write_bytes(damaged)
        assert files.look_up("things", "key") is None
    path.with_name("another").write_bytes(kept)
    assert files.look_up("things", "another") is None


def test_another_rotor_has_another_entry(tmp_path: Path) -> None:
    config = compose_config(BALL).machine.rotor
    assert hash_rotor(config) != hash_rotor(config.model_copy(update={"shear_effects": False}))
    places = [tmp_path / name for name in ("here.toml", "there.toml", "other.toml")]
    for place, text in zip(places, ("rotor", "rotor", "another"), strict=True):
        place.write_text(text)
    here, there, other = (hash_rotor(RotorConfig(file=str(place))) for place in places)
    assert here == there != other


@pytest.mark.slow
def test_stages_run_in_the_order_given(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["stage=[generate,train,evaluate]", *BALL, f"output='{tmp_path}'"]) == 0
    said = capsys.readouterr().out
    assert said.index("channels in") < said.index("coefficients in") < said.index("identified against modelled")
    assert "is missing" not in said


@pytest.mark.parametrize(
    ("stages", "words"),
    [
        ("[train,evalaute]", "did you mean 'evaluate'"),
        ("[train,train]", "each stage once"),
        ("[]", "one of the stages"),
        ("[train,[evaluate]]", "one of the stages"),
    ],
)
def test_a_wrong_list_of_stages_is_refused_before_the_first_runs(stages: str, words: str, tmp_path: Path) -> None:
    with refused(words, kind=ConfigError):
        compose_stages([f"stage={stages}", *BALL, f"output='{tmp_path / 'x'}'"])
    assert not (tmp_path / "x").exists()


@pytest.mark.slow
@pytest.mark.parametrize("killed", [False, True])
def test_a_record_is_complete_also_where_the_process_beside_is_lost(killed: bool, tmp_path: Path) -> None:
    """Logged once, by the process beside or, where that was killed, by the command itself."""

    settings = TrackingConfig(enabled=True, uri=f"sqlite:///{tmp_path}/mlflow.db", timeout_seconds=30.0)
    record = StageRecord(
        {"error": 0.5},
        {"outcome": "converged"},
        experiment="x",
        stage="train",
        started=1.0,
        ended=2.0,
        parameters={"seed": 3},
        history=[{"step": 0, "loss": 2.0}, {"step": 1, "loss": float("nan")}],
    )
    with recorder_beside(True):
        if killed:
            process, connection = tracker._running[0]
            os.kill(process, signal.SIGKILL)
            connection.poll(30.0)
        told = track(record, settings)
    assert ["loss" in sentence for sentence in told] == [True]
    with sqlite3.connect(tmp_path / "mlflow.db") as database:
        assert database.execute("SELECT name, status FROM runs").fetchall() == [("train", "FINISHED")]
        assert sorted(database.execute("SELECT key, value FROM metrics")) == [("error", 0.5), ("loss", 2.0)]
        assert database.execute("SELECT key, value FROM params").fetchall() == [("seed", "3")]
    database.close()


@pytest.mark.slow
def test_commands_share_the_process_that_imports_mlflow(tmp_path: Path) -> None:

    command = (
        "import os, psutil\n"
        "from pipeline.config.schema import TrackingConfig\n"
        "from pipeline.tracking import StageRecord, recorder_beside, track, tracker\n"
        "settings = TrackingConfig(enabled=True, uri='sqlite:///mlflow.db', timeout_seconds=30.0)\n"
        "with recorder_beside(True):\n"
        "    print(psutil.Process(tracker._running[0][0]).ppid(), os.getppid())\n"
        "    assert not track(StageRecord({'error': 0.5}, experiment='x', stage='train', ended=2.0), settings)\n"
    )
    (tmp_path / "stage.py").write_text(command)
    (tmp_path / "folder").mkdir()
    shared = [
        sys.executable,
        str(ROOT / "docs" / "recorder.py"),
        *("bash", "-c", '"$0" stage.py && cd folder && "$0" ../stage.py; exit 3'),
        sys.executable,
    ]
    ended = subprocess.run(shared, capture_output=True, text=True, cwd=tmp_path, env=ENVIRONMENT, timeout=120)
    assert (ended.returncode, ended.stderr) == (3, "")
    first, second = (line.split() for line in ended.stdout.splitlines())
    assert first[0] == second[0] != first[1]
    for folder in (tmp_path, tmp_path / "folder"):  # each command's own
        with sqlite3.connect(folder / "mlflow.db") as database:
            assert database.execute("SELECT name, status FROM runs").fetchall() == [("train", "FINISHED")]
        database.close()


def test_without_tracking_no_process_is_started() -> None:

    with recorder_beside(False):
        assert tracker._running == []


KINDS = {"run": "text", "speed_rpm": "number", "amplitude_m": "number"}
OPTIONAL = {"frequency_hz": "number or blank"}
RUNS = st.sampled_from(["one", "NA", "3", "a,b", 'say "x"', "two\nlines"])
NUMBERS = st.floats(allow_nan=False, allow_infinity=False)


@settings(max_examples=30)
@given(
    rows=st.lists(st.tuples(RUNS, NUMBERS, NUMBERS, NUMBERS | st.none()), min_size=1),
    ending=st.sampled_from(["csv", "parquet"]),
)
def test_a_table_is_read_back_to_the_same_bits(
    rows: list[tuple[str, float, float, float | None]], ending: str, tmp_path_factory: pytest.TempPathFactory
) -> None:
    """Texts, numbers and blanks, from CSV and Parquet."""
    columns = {name: [row[i] for row in rows] for i, name in enumerate([*KINDS, *OPTIONAL])}
    columns["frequency_hz"] = [np.nan if value is None else value for value in columns["frequency_hz"]]
    read = read_table(write_table(tmp_path_factory.mktemp("table") / f"x.{ending}", columns), KINDS, OPTIONAL)
    for name, values in columns.items():
        assert read[name].tolist() == values or read[name].tobytes() == np.array(values).tobytes()


@pytest.mark.parametrize(
    "text", ["run,speed_rpm,amplitude_m\none,1_000,1\n", "run,speed_rpm,amplitude_m\none,1,\n", ""]
)
def test_what_is_not_well_formed_is_refused(text: str, tmp_path: Path) -> None:
    (tmp_path / "x.csv").write_text(text)
    with refused("must"):
        read_table(tmp_path / "x.csv", KINDS)


def test_a_table_is_written_as_pandas_would(tmp_path: Path, rng: np.random.Generator) -> None:
    """The shortest text that reads back to the same bits, a blank for NaN, quotes where they are needed."""
    columns = {
        "run": ["a,b", 'say "x"', "plain"],
        "count": np.array([1, 2, 3]),
        "value": np.array([1e-5, np.nan, rng.normal()]),
    }
    ours = write_table(tmp_path / "x.csv", columns).read_text()
    assert ours == pd.DataFrame(columns).to_csv(index=False, lineterminator="\n")
