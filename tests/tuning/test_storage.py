"""What a user may do wrong with a study: its search space, its values and its storage; a sentence answers each."""

from __future__ import annotations

import sqlite3
import subprocess
import sys
from collections.abc import Callable
from contextlib import closing
from functools import cache
from pathlib import Path
from typing import Any

import psutil
import pytest

from pipeline.__main__ import main
from pipeline.config.compose import compose_mapping, validate
from pipeline.config.schema import Config
from pipeline.errors import StorageError
from pipeline.tuning.storage import close_storage, open_storage
from pipeline.tuning.study import StudyProblem, open_study
from pipeline.tuning.worker import run_study
from studies import CHEAP, FOREIGN, Forks, Make, Undisturbed, finished, refused, silent, trials_of

pytestmark = pytest.mark.slow  # some of it trains


RATE = {"kind": "float", "key": "optimizer.adam.learning_rate", "low": 1e-3, "high": 1.0}
WIDTH = {"kind": "int", "key": "model.width", "low": 8, "high": 9}
ACTIVATION = {"kind": "choice", "key": "model.activation", "choices": ["tanh", "silu"]}

BAD_SPACES: dict[str, tuple[dict[str, Any], list[str]]] = {
    "low above high": ({"x": WIDTH | {"low": 10}}, ["must have low <= high, but got 10 and 9"]),
    "logarithm of zero": (
        {"x": RATE | {"low": 0, "log": True}},
        ["must have low > 0 on a logarithmic scale, but got 0"],
    ),
    "logarithm below zero": ({"x": RATE | {"low": -1, "log": True}}, ["must have low > 0", "but got -1"]),
    "no number": ({"x": RATE | {"low": "much"}}, ["tuning.space.x.low: must be a valid number, but got 'much'"]),
    "kind": ({"x": RATE | {"kind": "flaot"}}, ["tuning.space.x.kind: must be one of these", "did you mean 'float'?"]),
    "no kind": ({"x": {"key": "model.width"}}, ["tuning.space.x.kind: must be given"]),
    "unknown word": ({"x": RATE | {"lgo": True}}, ["tuning.space.x", "'lgo' is not", "log"]),
    "unknown condition": (
        {"x": RATE | {"when": {"nothing": [1]}}},
        ["stand before them", "space.x.when names 'nothing'"],
    ),
    "later condition": (
        {"x": RATE | {"when": {"later": ["tanh"]}}, "later": ACTIVATION},
        ["stand before them", "space.x.when names 'later'"],
    ),
    "its own condition": ({"x": ACTIVATION | {"when": {"x": ["tanh"]}}}, ["space.x.when names 'x'"]),
    "condition on a range": (
        {"a": WIDTH, "x": RATE | {"when": {"a": [8]}}},
        ["conditions on choices", "space.x.when names 'a'"],
    ),
    "condition that never holds": (
        {"a": ACTIVATION, "x": RATE | {"when": {"a": ["sine"]}}},
        ["can hold", "space.x.when.a has ['sine']", "['tanh', 'silu']"],
    ),
    "condition without values": ({"a": ACTIVATION, "x": RATE | {"when": {"a": []}}}, ["space.x.when.a has no value"]),
    "key outside": ({"x": WIDTH | {"key": "seed"}}, ["tuning.space.x", "but got 'seed'"]),
    "key of the judge": ({"x": WIDTH | {"key": "training.holdout_every"}}, ["but got 'training.holdout_every'"]),
    "key of the data": ({"x": WIDTH | {"key": "machine.speeds.step_rpm"}}, ["'machine.speeds.step_rpm'"]),
    "key of the rotor": ({"x": RATE | {"key": "machine.rotor.shaft.0.length"}}, ["'machine.rotor.shaft.0.length'"]),
    "key outside in a preset": (
        {"x": {"kind": "preset", "choices": {"a": {"seed": 1}}}},
        ["tuning.space.x.choices.a.seed"],
    ),
    "choice twice": ({"x": ACTIVATION | {"choices": ["tanh", "tanh"]}}, ["tuning.space.x", "must name each once"]),
    "no choice": ({"x": ACTIVATION | {"choices": []}}, ["tuning.space.x", "must have at least 1 item"]),
    "name": ({"x.y": RATE}, ["x.y", "must match pattern"]),
}


@cache
def _mapping() -> dict[str, Any]:
    return compose_mapping(CHEAP)


def configured(**tuning: Any) -> Config:
    """The configuration of the cheap study with other values of ``tuning``, as the command line checks it."""
    mapping = _mapping()
    return validate(mapping | {"stage": "tune", "tuning": mapping["tuning"] | tuning})


BAD_VALUES = [
    ({"sampler": "tpee"}, ["tuning.sampler: must be one of these, but got 'tpee'", "did you mean 'tpe'?"]),
    ({"pruner": "medain"}, ["tuning.pruner: must be one of these", "did you mean 'median'?"]),
    ({"changed": "restrat"}, ["tuning.changed: must be one of these", "did you mean 'restart'?"]),
    ({"n_trials": 0}, ["tuning.n_trials: must be greater than 0, but got 0"]),
    ({"workers": 0}, ["tuning.workers: must be greater than or equal to 1, but got 0"]),
    ({"startup_trials": -1}, ["tuning.startup_trials: must be greater than 0, but got -1"]),
    ({"timeout_seconds": 0}, ["tuning.timeout_seconds: must be greater than 0"]),
    ({"seeds": []}, ["tuning.seeds: must have at least 1 item"]),
    ({"least_gain": 0.5}, ["tuning.least_gain: must be greater than or equal to 1, but got 0.5"]),
    ({"storage": ""}, ["tuning.storage: must have at least 1 character"]),
    ({"storage": "studies/optuna.log"}, ["must be the URL of a database: sqlite:///studies/optuna.db", "earlier"]),
    ({"storage": "u:secret@host/x"}, ["must be the URL of a database", "postgresql+psycopg://"]),
    ({"n_trails": 5}, ["tuning.n_trails", "did you mean 'n_trials'?"]),
]


@pytest.mark.parametrize(
    ("tuning", "fragments"), [*(({"space": space}, words) for space, words in BAD_SPACES.values()), *BAD_VALUES]
)
def test_a_mistake_in_a_study(tuning: dict[str, Any], fragments: list[str]) -> None:
    """It is answered before anything runs, by a sentence that names the dimension or the key."""
    with refused(*fragments):
        configured(**tuning)


BAD_STUDIES: dict[str, tuple[dict[str, Any], list[str]]] = {
    "empty": ({}, ["must have a search space", "tuning.space is empty", "tuning=network"]),
    "default outside of the presets": (
        {"x": {"kind": "preset", "choices": {"one": {"optimizer.adam.steps": 1}}}},
        ["must contain the configured default", "optimizer.adam.steps = 40", "choices of x are one"],
    ),
    "key of another model": ({"x": WIDTH}, ["'model.width' is not one of ball_bearing", "tuning=constant"]),
    "values that the schema refuses": (
        {"x": RATE | {"key": "training.tolerance", "high": 5}},
        ["tuning.space.x must give values that the schema takes", "training.tolerance"],
    ),
}


@pytest.mark.parametrize("mistake", BAD_STUDIES)
def test_a_space_that_does_not_fit_the_experiment(mistake: str, make: Make, tmp_path: Path) -> None:
    space, fragments = BAD_STUDIES[mistake]
    with refused(*fragments):
        open_study(make(space=configured(space=space).tuning.space))
    assert list(tmp_path.iterdir()) == []


BAD_STORAGES = {
    "refused port": ("postgresql+psycopg://u:secret@127.0.0.1:1/x", ["127.0.0.1:1", "refused"]),
    "unknown driver": ("postgresql+nothing://u:secret@h/x", ["postgresql.nothing"]),
    "unknown scheme": ("mongodb://u:secret@h/x", ["mongodb"]),
    "no host": ("postgresql+psycopg://u:secret@no.such.host.invalid/x", ["no.such.host.invalid"]),
    "no number": ("postgresql+psycopg://u:secret@h:port/x", ["must"]),
    "a place that can't be written": ("sqlite:////proc/x.db", ["'sqlite:////proc/x.db' says: unable to open"]),
    "a folder": ("sqlite:///.", ["'sqlite:///.'", "Is a directory"]),
    "below a file": ("sqlite:///file/x.db", ["'sqlite:///file/x.db' says: File exists"]),
    "a name that is too long": (f"sqlite:///{'x' * 256}", ["File name too long"]),
}


@pytest.mark.parametrize("mistake", BAD_STORAGES)
def test_a_storage_that_cannot_be_used(
    mistake: str, make: Make, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    storage, fragments = BAD_STORAGES[mistake]
    (tmp_path / "file").write_text("a file")
    with refused("tuning.storage must", *fragments, kind=StorageError):
        run_study(make(storage=storage, timeout_seconds=4.0), silent)
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def _other_database(path: Path) -> None:
    with closing(sqlite3.connect(path)) as connection, connection:
        connection.execute("create table experiments (name text)")


STRANGERS: dict[str, tuple[Callable[[Path], object], str]] = {
    "a journal": (lambda path: path.write_text('{"op_code":0,"study_name":"x"}\n'), "an Optuna journal of an earlier"),
    "another database": (_other_database, "has tables that are not of Optuna"),
    "a picture": (lambda path: path.write_bytes(b"\x89PNG\r\n\x1a\n" + bytes(range(256)) * 9), "something else"),
    "a text": (lambda path: path.write_text("a word"), "something else"),
}


@pytest.mark.parametrize("stranger", STRANGERS)
def test_a_file_that_is_no_database_of_studies_is_left_as_it_is(stranger: str, make: Make, tmp_path: Path) -> None:
    """A storage that names a file of another kind by mistake is refused, and not a byte of it changes."""
    write, what = STRANGERS[stranger]
    write(tmp_path / "studies.db")
    before = (tmp_path / "studies.db").read_bytes()
    with refused("must be a database of studies", what, "tuning.storage=sqlite:///", kind=StorageError):
        run_study(make(), silent)
    assert (tmp_path / "studies.db").read_bytes() == before


def test_a_database_that_is_damaged(make: Make, tmp_path: Path) -> None:
    """The database says so in a sentence of ours; an empty file, as a full disk leaves it, is no obstacle."""
    path = tmp_path / "studies.db"
    path.touch()
    run_study(make(n_trials=1), silent)
    assert len(trials_of(make())) == 1
    content = path.read_bytes()
    logs = path.parent.glob(f"{path.name}-wal")  # the last connection that closes takes it away
    assert all(log.stat().st_size == 0 for log in logs), "all is in the file itself"
    path.write_bytes(content[:4096] + b"\x00" * (len(content) - 4096))
    with refused("tuning.storage must be a database that can be used", "malformed", kind=StorageError):
        run_study(make(n_trials=2), silent)


def test_a_second_look_at_a_database_keeps_the_locks_on_it(make: Make, tmp_path: Path) -> None:
    """Another process that closes it is not the last, and leaves its log: the database would read as malformed."""
    storage = open_storage(make().config.tuning)
    close_storage(open_storage(make().config.tuning))
    script = "import sqlite3, sys; sqlite3.connect(sys.argv[1]).execute('select * from studies').fetchall()"
    subprocess.run([sys.executable, "-c", script, str(tmp_path / "studies.db")], check=True)
    assert (tmp_path / "studies.db-wal").exists()
    close_storage(storage)
    assert not (tmp_path / "studies.db-wal").exists()


def test_a_database_that_another_process_makes_is_opened_again(
    make: Make, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The first attempt, which found half of the tables, keeps no connection."""
    from optuna.storages import RDBStorage
    from sqlalchemy.exc import OperationalError

    real, calls = RDBStorage.__init__, []

    def fails_once(self: RDBStorage, *arguments: Any, **options: Any) -> None:
        real(self, *arguments, **options)
        calls.append(self)
        if len(calls) == 1:
            raise OperationalError("create table studies", None, Exception("table studies already exists"))

    monkeypatch.setattr(RDBStorage, "__init__", fails_once)
    close_storage(open_storage(make().config.tuning))
    assert len(calls) == 2
    assert not [file.path for file in psutil.Process().open_files() if file.path.startswith(str(tmp_path))]


def test_braces_in_the_name_of_a_storage(make: Make, tmp_path: Path) -> None:
    """Optuna takes the URL of a storage for a template."""
    open_storage(make(storage=f"sqlite:///{tmp_path}/{{a}}.db").config.tuning)
    assert (tmp_path / "{a}.db").exists()


@pytest.mark.parametrize(
    ("override", "fragments"),
    [
        ("tuning.sampler=tpee", ["did you mean 'tpe'?"]),
        ("tuning.storage=studies/optuna.log", ["sqlite:///studies/optuna.db"]),
        ("training.holdout_every=0", ["must judge its trials on held-out speeds", "training.holdout_every is 0"]),
        ("optimizer.adam.steps=100", ["must contain the configured default", "optimizer.adam.steps = 100"]),
        ("tuning.storage='postgresql+psycopg://u:secret@127.0.0.1:1/x'", ["u:***@127.0.0.1:1/x", "refused"]),
    ],
)
def test_mistakes_on_the_command_line(
    override: str,
    fragments: list[str],
    cheap: StudyProblem,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    places = [f"output='{cheap.config.output}'", "tuning.storage=sqlite:///studies.db", "tuning.folder=best"]
    assert main(["stage=tune", *CHEAP, *places, override]) == 2
    err = capsys.readouterr().err
    assert [fragment for fragment in fragments if fragment not in err] == [], err
    assert [word for word in FOREIGN if word in err] == [], err
    assert len(err.splitlines()) <= 2, err
    assert list(tmp_path.iterdir()) == []


def test_a_disk_that_is_full_in_the_middle_of_a_study(
    start: Forks, make: Make, undisturbed: Undisturbed, tmp_path: Path
) -> None:
    run_study(make(n_trials=1), silent)
    runner = start(make(), room=(tmp_path / "studies.db").stat().st_size + 2000)
    assert runner.end() == 2, runner.said
    assert runner.said.startswith("StorageError: tuning.storage must be a database that can be used"), runner.said
    assert runner.said.count("\n") == 1
    assert "disk" in runner.said
    run_study(make(), silent)
    assert finished(make()) == undisturbed()
