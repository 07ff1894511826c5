"""What the tests of studies share: a study of cheap trials, and processes that run it and can be killed."""

from __future__ import annotations

import json
import os
import pickle
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import conftest
import psutil
import running

from pipeline.config.compose import compose_config
from pipeline.errors import ConfigError, PipelineError
from pipeline.stages.measurement import load_measurement
from pipeline.stages.tune import pose_study
from pipeline.tuning.storage import close_storage, list_results, open_storage
from pipeline.tuning.study import StudyProblem

if TYPE_CHECKING:
    import optuna

ENVIRONMENT = running.ENVIRONMENT | {"COLUMNS": "120", "OMP_NUM_THREADS": "1"}
PYTHON = [sys.executable, "-W", "error", "-W", "ignore::ResourceWarning"]
"""An interrupt may come between opening a file and closing it."""
TRIALS = 10
CHEAP = [
    *("experiment=ball_bearing", "tracking=none", "machine.speeds.step_rpm=245", "tuning=study"),
    *("tuned=false", "optimizer=adam_levenberg_marquardt", "loss.scaling=per_speed", "model.parametrisation=log"),
    *("tuning.startup_trials=3", "tuning.finalists=1", "tuning.seeds=[0]", "tuning.heartbeat_seconds=1"),
    *(f"tuning.n_trials={TRIALS}", "optimizer.adam.steps=40", "optimizer.levenberg_marquardt.steps=2"),
    "+tuning.space.output={kind: choice, key: model.parametrisation, choices: [log, scaled]}",
    "+tuning.space.optimizer={kind: preset, choices: {adam: {optimizer.levenberg_marquardt.steps: 0}, both: {}}}",
    "+tuning.space.rate={kind: float, key: optimizer.adam.learning_rate, low: 1e-3, high: 1.0, log: true}",
    "+tuning.space.adam={kind: int, key: optimizer.adam.steps, low: 20, high: 60, log: true}",
    "+tuning.space.damping={kind: float, key: optimizer.levenberg_marquardt.initial_damping, low: 1e-3, high: 1.0, "
    "log: true, when: {optimizer: [both]}}",
]
"""Trials of a tenth of a second, whose losses differ."""
ALONE = {"sampler": "random", "pruner": "none"}
"""Values of ``tuning`` with which a trial does not depend on those beside it."""


def cheap_problem(folder: Path) -> StudyProblem:
    """The problem of all studies here; ``folder`` gets its data. Its storage is each test's own."""
    config = compose_config([*CHEAP, f"output='{folder}'"])
    return pose_study(config, load_measurement(config))


def with_tuning(problem: StudyProblem, **tuning: Any) -> StudyProblem:
    """``problem`` with other values of ``tuning``."""
    return with_config(problem, tuning=problem.config.tuning.model_copy(update=tuning))


def with_config(problem: StudyProblem, **sections: Any) -> StudyProblem:
    """``problem`` with other sections of its configuration."""
    return replace(problem, config=problem.config.model_copy(update=sections))


def with_other_data(problem: StudyProblem) -> StudyProblem:
    """The same problem on data that differ in their last bits."""
    dataset = problem.measurement.dataset
    other = replace(dataset, displacement=dataset.displacement * (1 + 1e-15))
    return replace(problem, measurement=replace(problem.measurement, dataset=other))


def lengthen(problem: StudyProblem, steps: int = 1000, last: int = 0) -> StudyProblem:
    """``problem`` with trials of ``steps`` of Adam and a third more or less, and ``last`` of Levenberg-Marquardt."""
    optimizer, space = problem.config.optimizer, problem.config.tuning.space
    phases = {
        "adam": optimizer.adam.model_copy(update={"steps": steps, "patience": 10**9}),
        "levenberg_marquardt": optimizer.levenberg_marquardt.model_copy(update={"steps": last}),
    }
    around = space["adam"].model_copy(update={"low": 2 * steps // 3, "high": 4 * steps // 3})
    longer = with_config(problem, optimizer=optimizer.model_copy(update=phases))
    return with_tuning(longer, space=dict(space) | {"adam": around})


def ended(processes: list[psutil.Process]) -> bool:
    """Whether none of them runs any more; one that nobody waited for is a zombie."""
    return not any(p.is_running() and p.status() != psutil.STATUS_ZOMBIE for p in processes)


def silent(_: optuna.Study) -> None:
    """Shows no progress."""


@contextmanager
def stored(problem: StudyProblem) -> Iterator[optuna.Study | None]:
    """The study as it is stored; None where there is none yet."""
    import optuna

    config = problem.config.tuning
    if config.storage.startswith("sqlite") and not Path(config.storage.removeprefix("sqlite:///")).exists():
        yield None
        return
    storage = open_storage(config)  # its process may make the tables in this very moment
    try:
        study = optuna.load_study(study_name=config.study, storage=storage)
    except KeyError:
        study = None
    try:
        yield study
    finally:
        close_storage(storage)


def trials_of(problem: StudyProblem) -> list[optuna.trial.FrozenTrial]:
    """All trials in the storage, repeated ones too."""
    with stored(problem) as study:
        return study.get_trials() if study else []


Make = Callable[..., StudyProblem]
Told = tuple[int, str, dict[str, Any], float | None, dict[int, float], dict[str, Any]]
Undisturbed = Callable[..., list[Told]]


def told(problem: StudyProblem) -> list[Told]:
    """Everything that a report could tell of the finished trials, but for times and workers."""
    own = {"worker", "training_seconds", "repeats"}
    with stored(problem) as study:
        return [
            (
                *(place, t.state.name, t.params, t.value, t.intermediate_values),
                {name: value for name, value in t.user_attrs.items() if name not in own},
            )
            for place, t in (list_results(study) if study else {}).items()
        ]


def finished(problem: StudyProblem) -> list[Told]:
    """The same of a study that is through: all that were asked for have a result, and nobody is at work."""
    trials = told(problem)
    assert [place for place, *_ in trials] == list(range(problem.config.tuning.n_trials))
    assert "RUNNING" not in {trial.state.name for trial in trials_of(problem)}
    return trials


def wait_until(condition: Callable[[], Any], seconds: float = 300.0) -> Any:
    """What ``condition`` returns as soon as that is something."""
    ends = time.monotonic() + seconds
    while not (found := condition()):
        assert time.monotonic() < ends, "it never came to that"
        time.sleep(0.05)
    return found


@contextmanager
def refused(*fragments: str, kind: type[PipelineError] = ConfigError) -> Iterator[None]:
    """As for any other mistake, in three lines at the most, and nothing secret."""
    with conftest.refused(*fragments, kind=kind) as caught:
        yield
    sentence = str(caught.value)
    assert [word for word in FOREIGN if word in sentence] == [], sentence
    assert len(sentence.splitlines()) <= 3, sentence


FOREIGN = ("Traceback", "pydantic", "Input should", "optuna.exceptions", "Background on this", "secret")


FORKS = """
import json, os, pickle, resource, signal, sys, time, traceback
from pathlib import Path
import alembic.command, filelock, optuna, optuna_dashboard, psutil, psycopg, torch, torch._dynamo
import optuna._gp.gp, optuna._gp.optim_mixed, sqlalchemy.dialects.postgresql.psycopg, sqlalchemy.dialects.sqlite
from pipeline.errors import PipelineError
from pipeline.tuning import worker

signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background job hands down an ignored one

def run(order):
    os.setpgid(0, 0)
    said = os.open(order["said"], os.O_WRONLY | os.O_CREAT | os.O_APPEND)
    os.dup2(said, 1)
    os.dup2(said, 2)
    if order["room"]:
        # Python would believe half a file of bytecode, which a short write leaves: here, and where it starts others.
        sys.dont_write_bytecode, os.environ["PYTHONDONTWRITEBYTECODE"] = True, "1"
        resource.setrlimit(resource.RLIMIT_FSIZE, (order["room"], order["room"]))
    with open(order["problem"], "rb") as file:
        problem = pickle.load(file)
    def named(study):
        return {t.user_attrs.get("worker", ":").split(":")[1] for t in study.get_trials(deepcopy=False)} - {""}
    def seen(study):
        while order["others"] and len(named(study) - {str(os.getpid())}) < order["others"]:
            time.sleep(0.05)  # starting the other workers takes longer than a trial
        order["others"] = 0
        for trial in study.get_trials(deepcopy=False) if order["halts"] else ():
            own = trial.user_attrs.get("worker", "").endswith(f":{os.getpid()}")
            if own and trial.state.name == "RUNNING" and trial.intermediate_values:
                Path(order["said"] + " halts").write_text(str(trial.number))
                while not Path(order["said"] + " goes on").exists():
                    time.sleep(0.01)
                order["halts"] = False
    while time.time() < order["begins"]:
        pass
    try:
        print(*worker.run_study(problem, seen)[1], end="")
        code = 0
    except PipelineError as error:
        print(f"{type(error).__name__}: {error}")
        code = 2
    sys.stdout.flush()
    os._exit(code)

for line in sys.stdin:
    order = json.loads(line)
    if "poll" in order:
        pid, status = os.waitpid(order["poll"], os.WNOHANG)
        print(json.dumps(os.waitstatus_to_exitcode(status) if pid else None), flush=True)
        continue
    child = os.fork()
    if not child:
        try:
            run(order)
        except KeyboardInterrupt:
            os._exit(130)
        except BaseException:
            traceback.print_exc()
            os._exit(70)
    print(child, flush=True)
"""


@dataclass
class Runner:
    """A process that runs a study."""

    forks: Forks
    pid: int
    out: Path
    ended: int | None = None

    @property
    def said(self) -> str:
        """Everything that it and its workers printed."""
        return self.out.read_text() if self.out.exists() else ""

    def end(self, seconds: float = 300) -> int:
        """Its exit code."""

        def has_ended() -> bool:
            if self.ended is None:
                self.ended = self.forks.ask(poll=self.pid)
            return self.ended is not None

        wait_until(has_ended, seconds)
        self.forks.alive.discard(self.pid)
        return self.ended

    def signal(self, number: int) -> None:
        """Send a signal to this process alone."""
        os.kill(self.pid, number)

    def kill(self) -> None:
        """SIGKILL, and wait for its end."""
        self.signal(signal.SIGKILL)
        assert self.end() == -signal.SIGKILL

    def workers(self) -> list[psutil.Process]:
        """The processes that it started to work beside it."""
        return [child for child in psutil.Process(self.pid).children() if "spawn_main" in " ".join(child.cmdline())]

    def halt(self) -> int:
        """Wait until it halts in its first trial, and return that trial's number."""
        file = Path(f"{self.out} halts")
        return int(wait_until(lambda: file.exists() and file.read_text()))

    def go_on(self) -> None:
        """After a halt."""
        Path(f"{self.out} goes on").touch()


class Forks:
    """Starts processes that run a study: copies of one that has imported everything, which takes seconds."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.alive, self.count = folder, set[int](), 0
        pipe = subprocess.PIPE
        self.server = subprocess.Popen([*PYTHON, "-c", FORKS], env=ENVIRONMENT, text=True, stdin=pipe, stdout=pipe)

    def ask(self, **order: Any) -> Any:
        """The server's answer."""
        print(json.dumps(order), file=self.server.stdin, flush=True)
        return json.loads(self.server.stdout.readline())

    def __call__(
        self, problem: StudyProblem, *, begins: float = 0.0, others: int = 0, halts: bool = False, room: int = 0
    ) -> Runner:
        """A process that runs ``problem``.

        ``begins`` is a time in seconds since 1970; ``others`` is the number of workers that must have begun a trial
        before this process goes on; ``halts`` stops it in its first trial; ``room`` is the size in bytes that no file
        can exceed.
        """
        self.count += 1
        file, said = self.folder / f"{self.count}.pickle", self.folder / f"{self.count}.txt"
        file.write_bytes(pickle.dumps(problem))
        order = {"begins": begins, "others": others, "halts": halts, "room": room}
        pid = self.ask(problem=str(file), said=str(said), **order)
        self.alive.add(pid)
        return Runner(self, pid, said)

    def close(self) -> None:
        """End what a failed test left."""
        for pid in self.alive:
            with suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
        self.server.stdin.close()
        self.server.wait(30)
        self.server.stdout.close()
