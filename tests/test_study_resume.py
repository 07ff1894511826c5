"""Studies that are killed, interrupted, torn, shared or ill: no finished trial is lost, none is drawn twice."""

from __future__ import annotations

import json
import os
import pickle
import re
import shutil
import signal
import subprocess
import sys
import time
import zlib
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import psutil
import pytest
from conftest import at_night

from pipeline.__main__ import main
from pipeline.config.compose import compose_config, composed_mapping, validated
from pipeline.config.schema import Config
from pipeline.errors import ConfigError, PipelineError, StorageError
from pipeline.identification.outcome import Outcome
from pipeline.stages.measurement import load_measurement
from pipeline.stages.tune import study_problem
from pipeline.tuning import liveness, study, worker
from pipeline.tuning.liveness import is_dead, requeue_orphans, this_worker
from pipeline.tuning.parallel import run_study
from pipeline.tuning.space import default_parameters
from pipeline.tuning.storage import open_storage
from pipeline.tuning.study import StudyProblem, open_study

pytestmark = pytest.mark.slow  # it trains, or starts processes

if TYPE_CHECKING:
    import optuna

ROOT = Path(__file__).resolve().parents[1]
ENVIRONMENT = os.environ | {"PYTHONPATH": str(ROOT), "COLUMNS": "120"}
PYTHON = [sys.executable, "-W", "error", "-W", "ignore::ResourceWarning"]
"""An interrupt may come between opening a file and closing it."""
TRIALS = 10
BALL = ["experiment=ball_bearing", "tracking=none", "machine.speeds.step_rpm=245"]
SPACE = [
    "+tuning.space.output={kind: choice, key: model.parametrisation, choices: [log, scaled]}",
    "+tuning.space.optimizer={kind: preset, choices: {adam: {optimizer.levenberg_marquardt.steps: 0}, both: {}}}",
    "+tuning.space.rate={kind: float, key: optimizer.adam.learning_rate, low: 1e-3, high: 1.0, log: true}",
    "+tuning.space.adam={kind: int, key: optimizer.adam.steps, low: 20, high: 60, log: true}",
    "+tuning.space.damping={kind: float, key: optimizer.levenberg_marquardt.initial_damping, low: 1e-3, high: 1.0, "
    "log: true, when: {optimizer: [both]}}",
]
CHEAP = [
    *BALL,
    "tuning=study",
    f"tuning.n_trials={TRIALS}",
    "tuning.startup_trials=3",
    "tuning.finalists=1",
    "tuning.seeds=[0]",
    "optimizer.adam.steps=40",
    "optimizer.levenberg_marquardt.steps=2",
    *SPACE,
]
"""Trials of a tenth of a second, whose losses differ."""


# --- the study --------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the generated data; not to be written to."""
    folder = tmp_path_factory.mktemp("study") / "data"
    load_measurement(compose_config([*CHEAP, f"output='{folder}'"]))
    return folder


@pytest.fixture(scope="module")
def cheap(data: Path) -> StudyProblem:
    """The problem of all studies here, without a storage of its own."""
    config = compose_config([*CHEAP, f"output='{data}'"])
    return study_problem(config, load_measurement(config))


Make = Callable[..., StudyProblem]


@pytest.fixture
def make(cheap: StudyProblem, tmp_path: Path) -> Make:
    """``make(n_trials=5)``: the problem with its journal in ``tmp_path`` and these values of ``tuning``."""

    def made(**tuning: Any) -> StudyProblem:
        places = {"storage": str(tmp_path / "studies.log"), "folder": str(tmp_path / "best")}
        return with_tuning(cheap, **(places | tuning))

    return made


def with_tuning(problem: StudyProblem, **tuning: Any) -> StudyProblem:
    """``problem`` with other values of ``tuning``."""
    return with_config(problem, tuning=problem.config.tuning.model_copy(update=tuning))


def with_config(problem: StudyProblem, **sections: Any) -> StudyProblem:
    """``problem`` with other sections of its configuration."""
    return replace(problem, config=problem.config.model_copy(update=sections))


def lengthy(problem: StudyProblem, steps: int = 1000, last: int = 0) -> StudyProblem:
    """``problem`` with trials of ``steps`` of Adam and a third more or less, and ``last`` of Levenberg-Marquardt."""
    optimizer, space = problem.config.optimizer, problem.config.tuning.space
    phases = {
        "adam": optimizer.adam.model_copy(update={"steps": steps, "patience": 10**9}),
        "levenberg_marquardt": optimizer.levenberg_marquardt.model_copy(update={"steps": last}),
    }
    around = space["adam"].model_copy(update={"low": 2 * steps // 3, "high": 4 * steps // 3})
    longer = with_config(problem, optimizer=optimizer.model_copy(update=phases))
    return with_tuning(longer, space=dict(space) | {"adam": around})


def silent(_: optuna.Study) -> None:
    """Shows no progress."""


def trials_of(problem: StudyProblem) -> list[optuna.trial.FrozenTrial]:
    """The trials in the journal; none where there is no study yet."""
    import optuna
    from optuna.storages import JournalStorage
    from optuna.storages.journal import JournalFileBackend

    config = problem.config.tuning
    if not Path(config.storage).exists():
        return []
    storage = JournalStorage(JournalFileBackend(config.storage))
    if config.study not in [known.study_name for known in storage.get_all_studies()]:
        return []
    return optuna.load_study(study_name=config.study, storage=storage).get_trials()


Told = tuple[int, str, dict[str, Any], float | None, dict[int, float], dict[str, Any]]


def told(trials: list[optuna.trial.FrozenTrial]) -> list[Told]:
    """Everything that a trial says but for its times and its worker."""
    own = {"worker", "training_seconds"}
    return [(t.number, t.state.name, t.params, t.value, t.intermediate_values, drop(t.user_attrs, own)) for t in trials]


def drop(mapping: Mapping[str, Any], names: set[str]) -> dict[str, Any]:
    """``mapping`` without ``names``."""
    return {name: value for name, value in mapping.items() if name not in names}


def finished(problem: StudyProblem) -> list[Told]:
    """The trials of a study that is through: all that were asked for, each finished; a spare one only waits."""
    trials, total = trials_of(problem), problem.config.tuning.n_trials
    assert [t.number for t in trials] == list(range(len(trials)))
    assert [t.number for t in trials[:total] if not t.state.is_finished()] == []
    assert [(t.number, t.state.name) for t in trials[total:] if t.state.name != "WAITING" or t.params] == []
    assert len(trials) >= total
    return told(trials[:total])


def taken(problem: StudyProblem) -> Counter[int]:
    """How often each trial was begun, by the journal's own order of events."""
    running, waiting = 0, 4
    states: list[int] = []
    begun: Counter[int] = Counter()
    for line in Path(problem.config.tuning.storage).read_text().splitlines():
        record = json.loads(line)
        if record["op_code"] == 4:  # a trial is created
            states.append(record.get("state", running))
            begun[len(states) - 1] += states[-1] == running
        elif record["op_code"] == 6:  # its state is set
            trial = record["trial_id"]
            begun[trial] += (states[trial], record["state"]) == (waiting, running)
            if states[trial] in (running, waiting):
                states[trial] = record["state"]
    return begun


# --- processes --------------------------------------------------------------------------------------

FORKS = """
import json, os, pickle, resource, signal, sys, time, traceback
import filelock, optuna, optuna_dashboard, psutil, sqlalchemy, torch, torch._dynamo
import optuna._gp.gp, optuna._gp.optim_mixed
from optuna.storages.journal import JournalFileBackend, _file
from pipeline.errors import PipelineError
from pipeline.tuning import liveness, parallel, study

signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background job hands down an ignored one

def dies_at(record, written):
    "SIGKILL at a record of the journal, of which a fraction is written."
    left, append = [record], JournalFileBackend.append_logs
    def append_logs(self, logs):
        left[0] -= 1
        if left[0]:
            return append(self, logs)
        with _file.get_lock_file(self._lock), open(self._file_path, "ab") as file:
            text = "".join(json.dumps(log, separators=(",", ":")) + "\\n" for log in logs).encode()
            file.write(text[:round(written * len(text))])
            file.flush()
            os.kill(os.getpid(), signal.SIGKILL)
    JournalFileBackend.append_logs = append_logs

def run(order):
    os.setpgid(0, 0)
    said = os.open(order["said"], os.O_WRONLY | os.O_CREAT | os.O_APPEND)
    os.dup2(said, 1)
    os.dup2(said, 2)
    study._CREATION_SECONDS = liveness._NAMELESS_SECONDS = 0.5
    if order["dies_at"]:
        dies_at(*order["dies_at"])
    if order["slow"]:
        enqueue = optuna.Study.enqueue_trial
        optuna.Study.enqueue_trial = lambda *a, **b: (time.sleep(order["slow"]), enqueue(*a, **b))
    if order["room"]:
        resource.setrlimit(resource.RLIMIT_FSIZE, (order["room"], order["room"]))
    with open(order["problem"], "rb") as file:
        problem = pickle.load(file)
    def seen(study):
        "Wait until the other workers are there: starting takes them longer than a trial."
        names = lambda: {trial.user_attrs.get("worker") for trial in study.get_trials(deepcopy=False)}
        while len(names() - {None, liveness.this_worker()}) < order["others"]:
            time.sleep(0.05)
        order["others"] = 0
    while time.time() < order["begins"]:
        pass
    try:
        print(*parallel.run_study(problem, seen)[1])
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

    def code(self, seconds: float) -> int | None:
        """Its exit code, or None where it has not ended within ``seconds``."""
        ends = time.monotonic() + seconds
        while self.ended is None:
            self.ended = self.forks.ask(poll=self.pid)
            if self.ended is not None:
                self.forks.alive.discard(self.pid)
            elif time.monotonic() > ends:
                return None
            else:
                time.sleep(0.005)
        return self.ended

    def end(self, seconds: float = 60) -> int:
        """Its exit code."""
        code = self.code(seconds)
        assert code is not None, f"it did not end: {self.said}"
        return code

    def signal(self, number: int) -> None:
        """Send a signal to this process alone."""
        os.kill(self.pid, number)

    def workers(self) -> list[psutil.Process]:
        """The processes that it started to work beside it."""
        children = psutil.Process(self.pid).children()
        return [child for child in children if "spawn_main" in " ".join(child.cmdline())]


class Forks:
    """Starts processes that run a study: copies of one that has imported everything, which takes seconds."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.alive, self.count = folder, set[int](), 0
        self.server = subprocess.Popen(
            [*PYTHON, "-c", FORKS],
            env=ENVIRONMENT,
            text=True,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
        )

    def ask(self, **order: Any) -> Any:
        """The server's answer."""
        assert self.server.stdin is not None
        assert self.server.stdout is not None
        print(json.dumps(order), file=self.server.stdin, flush=True)
        return json.loads(self.server.stdout.readline())

    def __call__(
        self,
        problem: StudyProblem,
        *,
        dies_at: tuple[int, float] | None = None,
        begins: float = 0.0,
        slow: float = 0.0,
        others: int = 0,
        room: int = 0,
    ) -> Runner:
        """A process that runs ``problem``.

        ``dies_at`` is a record of the journal and how much of it is still written; ``begins`` is a time in seconds
        since 1970; ``slow`` are seconds between making the study and its first trial; ``others`` is the number of
        workers that must have begun a trial before this process itself does; ``room`` is the size in bytes that no
        file can exceed.
        """
        self.count += 1
        file, said = self.folder / f"{self.count}.pickle", self.folder / f"{self.count}.txt"
        file.write_bytes(pickle.dumps(problem))
        order = {"dies_at": dies_at, "begins": begins, "slow": slow, "others": others, "room": room}
        pid = self.ask(problem=str(file), said=str(said), **order)
        self.alive.add(pid)
        return Runner(self, pid, said)

    def close(self) -> None:
        """End what a failed test left."""
        for pid in self.alive:
            os.kill(pid, signal.SIGKILL)
        assert self.server.stdin is not None
        self.server.stdin.close()
        self.server.wait(30)
        assert self.server.stdout is not None
        self.server.stdout.close()


@pytest.fixture(scope="module")
def start(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Forks]:
    """``start(problem)``: a process that runs the study."""
    forks = Forks(tmp_path_factory.mktemp("forks"))
    yield forks
    forks.close()


def wait_until(condition: Callable[[], Any], seconds: float = 60.0) -> Any:
    """What ``condition`` returns as soon as that is something."""
    ends = time.monotonic() + seconds
    while not (found := condition()):
        assert time.monotonic() < ends, "it never came to that"
        time.sleep(0.05)
    return found


@pytest.fixture(scope="module")
def in_one_go(cheap: StudyProblem, start: Forks, tmp_path_factory: pytest.TempPathFactory) -> Callable[..., list[Told]]:
    """``in_one_go(sampler="gp")``: the trials of a study with these values of ``tuning`` that nothing disturbed."""
    known: dict[str, list[Told]] = {}

    def trials(**tuning: Any) -> list[Told]:
        key = json.dumps(tuning, sort_keys=True)
        if key not in known:
            problem = with_tuning(cheap, storage=str(tmp_path_factory.mktemp("reference") / "studies.log"), **tuning)
            runner = start(problem)
            assert runner.end() == 0, runner.said
            known[key] = finished(problem)
            assert set(taken(problem).values()) == {1}
        return known[key]

    return trials


# --- killed again and again ---------------------------------------------------------------------------


def undisturbed_seconds(make: Make, start: Forks, **tuning: Any) -> float:
    """How long a study takes on this machine: what is stopped at random is stopped often, however fast that is."""
    problem = make(**tuning)
    storage = f"{problem.config.tuning.storage}.timed"
    begun = time.perf_counter()
    runner = start(with_tuning(problem, storage=storage))
    assert runner.end() == 0, runner.said
    return time.perf_counter() - begun


def stopped_again_and_again(
    start: Forks, problem: StudyProblem, number: int, longest: float, rng: np.random.Generator
) -> list[int]:
    """The exit codes of a study that gets a signal within ``longest`` seconds or a little more until it is through."""
    codes: list[int] = []
    while True:
        runner = start(problem)
        code = runner.code(rng.uniform(0.0, longest) * 1.02 ** len(codes))
        if code is None:
            runner.signal(number)
            code = runner.end()
        codes.append(code)
        if code == 0:
            return codes
        assert code == (-signal.SIGKILL if number == signal.SIGKILL else 130), runner.said
        assert "Traceback" not in runner.said
        assert len(codes) < 150


def test_a_study_that_is_undisturbed_has_trials_of_every_kind(
    in_one_go: Callable[..., list[Told]], cheap: StudyProblem
) -> None:
    """What the studies of this file are compared with: complete and pruned trials, all of them different."""
    trials = in_one_go()
    assert [number for number, *_ in trials] == list(range(TRIALS))
    assert trials[0][2] == default_parameters(cheap.config)
    assert {state for _, state, *_ in trials} == {"COMPLETE", "PRUNED"}
    assert len({value for _, _, _, value, _, _ in trials}) == TRIALS
    assert all(curve for *_, curve, _ in trials)


@pytest.mark.parametrize("number", [signal.SIGKILL, *at_night(signal.SIGINT)], ids=["SIGKILL", "SIGINT"])
def test_a_study_that_is_stopped_at_random_moments_ends_as_if_it_had_not_been(
    number: int, start: Forks, make: Make, in_one_go: Callable[..., list[Told]], rng: np.random.Generator
) -> None:
    """Numbers, states, parameters, values and learning curves are the very same, bit by bit."""
    problem = make()
    codes = stopped_again_and_again(start, problem, number, undisturbed_seconds(make, start) / 8, rng)
    assert len(codes) > 5
    assert finished(problem) == in_one_go()
    assert max(taken(problem).values()) > 1  # some were begun again


def died_again_and_again(start: Forks, problem: StudyProblem, rng: np.random.Generator, longest: int) -> int:
    """How often a study died: at each record of the journal that chance chose, which it wrote, in part or not."""
    for count in range(300):
        written = float(rng.choice([0.0, 1.0, rng.uniform(0.01, 0.99)]))
        runner = start(problem, dies_at=(int(rng.integers(1, longest)), written))
        if (code := runner.end()) != -signal.SIGKILL:
            assert code == 0, runner.said
            return count
    raise AssertionError("it was never through")


@pytest.mark.nightly
def test_a_study_that_dies_while_it_writes_its_journal(
    start: Forks, make: Make, in_one_go: Callable[..., list[Told]], rng: np.random.Generator
) -> None:
    """Before a record, in the middle of it or after it: the study goes on as if nothing had been."""
    problem = make(n_trials=4)
    assert died_again_and_again(start, problem, rng, 30) > 3
    assert finished(problem) == in_one_go()[:4]


@pytest.mark.nightly
@pytest.mark.parametrize("sampler", ["tpe", "random", "gp"])
def test_every_sampler_goes_on_where_it_died(
    sampler: str, start: Forks, make: Make, in_one_go: Callable[..., list[Told]]
) -> None:
    """Death at any record, often between two parameters of a trial, changes no later draw."""
    rng = np.random.default_rng(zlib.crc32(sampler.encode()))
    problem = make(sampler=sampler, n_trials=8)
    assert died_again_and_again(start, problem, rng, 40) > 5
    assert finished(problem) == in_one_go(sampler=sampler, n_trials=8)


def test_startup_points_are_not_drawn_twice(make: Make, in_one_go: Callable[..., list[Told]]) -> None:
    """A study resumed after each trial draws the points that it would have drawn without: no point comes again."""
    for total in range(1, 6):
        run_study(make(n_trials=total, sampler="random"), silent)
    trials = finished(make(n_trials=5, sampler="random"))
    assert [parameters for _, _, parameters, *_ in trials] == [
        parameters for _, _, parameters, *_ in in_one_go(sampler="random", n_trials=8)[:5]
    ]
    for name in ("rate",):
        drawn = [parameters[name] for _, _, parameters, *_ in trials]
        assert len(set(drawn)) == len(drawn)


# --- the total --------------------------------------------------------------------------------------


def test_the_number_of_trials_is_the_total(make: Make, in_one_go: Callable[..., list[Told]]) -> None:
    """Five, then nine, are nine; again with nine, or with fewer, runs none."""
    run_study(make(n_trials=5), silent)
    assert finished(make(n_trials=5)) == in_one_go()[:5]
    run_study(make(n_trials=9), silent)
    assert finished(make(n_trials=9)) == in_one_go()[:9]
    for total in (9, 3):
        run_study(make(n_trials=total), silent)
    assert len(trials_of(make())) == 9
    assert set(taken(make()).values()) == {1}


# --- a journal that is torn, corrupted or none ---------------------------------------------------------


@pytest.fixture(scope="module")
def journal(cheap: StudyProblem, start: Forks, tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """The journal of a study with four trials."""
    path = tmp_path_factory.mktemp("journal") / "studies.log"
    runner = start(with_tuning(cheap, storage=str(path), n_trials=4))
    assert runner.end() == 0, runner.said
    return path.read_bytes()


@pytest.mark.parametrize("seed", range(6))
def test_a_last_line_that_is_torn_is_repaired(
    seed: int, journal: bytes, make: Make, in_one_go: Callable[..., list[Told]]
) -> None:
    """A journal that ends within its last record: the next run drops the half record and goes on."""
    last = journal[:-1].rfind(b"\n") + 1
    cut = int(np.random.default_rng(seed).integers(last + 1, len(journal)))
    problem = make(n_trials=5)
    Path(problem.config.tuning.storage).write_bytes(journal[:cut])
    run_study(problem, silent)
    assert finished(problem) == in_one_go()[:5]
    assert Path(problem.config.tuning.storage).read_bytes().startswith(journal[:last])


@pytest.mark.parametrize("seed", range(8))
def test_a_journal_that_ends_anywhere_is_gone_on_with(
    seed: int, journal: bytes, make: Make, in_one_go: Callable[..., list[Told]], monkeypatch: pytest.MonkeyPatch
) -> None:
    """What a power cut leaves: whatever of the journal was not written yet is done again."""
    monkeypatch.setattr(study, "_CREATION_SECONDS", 0.2)
    problem = make(n_trials=4)
    cut = int(np.random.default_rng(seed).integers(0, len(journal)))
    Path(problem.config.tuning.storage).write_bytes(journal[:cut])
    run_study(problem, silent)
    assert finished(problem) == in_one_go()[:4]


def test_a_line_that_another_worker_tears_while_a_study_runs(make: Make, in_one_go: Callable[..., list[Told]]) -> None:
    """The half record of a worker that died is not glued to the next one of those that live."""
    problem, calls = make(n_trials=3), []
    path = Path(problem.config.tuning.storage)

    def tears(_: optuna.Study) -> None:
        calls.append(1)
        if len(calls) % 7 == 0:
            with path.open("ab") as file:
                file.write(b'{"op_code":8,"worker_id":"x')

    run_study(problem, tears)
    assert len(calls) > 14
    assert finished(problem) == in_one_go()[:3]


@contextmanager
def refused(*fragments: str, kind: type[PipelineError] = ConfigError) -> Iterator[None]:
    """The block must end in an error of ours whose one sentence has all ``fragments``."""
    with pytest.raises(kind) as caught:
        yield
    sentence = str(caught.value)
    assert [fragment for fragment in fragments if fragment not in sentence] == [], sentence
    assert "Traceback" not in sentence
    assert "\n" not in sentence
    assert len(sentence) < 800


JUNK = [b"\n", b"nothing of sense\n", b"[]\n", b'{"op_code":99}\n', b'{"op_code":6}\n', b"{}\n", b"\xff\xfe\x00\n"]


@pytest.mark.parametrize("junk", JUNK)
def test_a_corrupted_line_in_the_middle(junk: bytes, journal: bytes, make: Make) -> None:
    """No guess about what the line may have said: a sentence names the file, which stays as it is."""
    problem = make()
    path = Path(problem.config.tuning.storage)
    lines = journal.splitlines(keepends=True)
    lines[len(lines) // 2] = junk
    path.write_bytes(b"".join(lines))
    with refused("tuning.storage must be an Optuna journal", f"'{path}'", "move it away", kind=StorageError):
        run_study(problem, silent)
    assert path.read_bytes() == b"".join(lines)


def test_flipped_bits_never_look_like_a_bug_of_ours(journal: bytes, make: Make, rng: np.random.Generator) -> None:
    """A byte that changed is refused by a sentence, or is one that the study can live with."""
    problem = make(n_trials=4)
    path, refusals = Path(problem.config.tuning.storage), []
    for _ in range(80):
        raw = bytearray(journal)
        raw[int(rng.integers(0, len(raw)))] ^= 1 << int(rng.integers(0, 8))
        path.write_bytes(raw)
        try:
            run_study(problem, silent)
        except (StorageError, ConfigError) as error:
            refusals.append(str(error))
    assert len(refusals) > 10
    assert [sentence for sentence in refusals if f"'{path}'" not in sentence] == []


def sqlite(path: Path) -> None:
    """A database file."""
    import sqlite3

    connection = sqlite3.connect(path)
    with connection:
        connection.execute("create table studies (name text)")
        connection.executemany("insert into studies values (?)", [("a\nb",)] * 50)
    connection.close()


STRANGERS: dict[str, Callable[[Path], object]] = {
    "a database": sqlite,
    "a picture": lambda path: path.write_bytes(b"\x89PNG\r\n\x1a\n" + bytes(range(256)) * 9),
    "a picture without a line feed": lambda path: path.write_bytes(b"\x89PNG" + bytes(range(11, 256)) * 9),
    "a text": lambda path: path.write_text("a word"),
    "a text of lines": lambda path: path.write_text("a word\nand another"),
    "JSON": lambda path: path.write_text('{"a": 1}'),
    "JSON of lines": lambda path: path.write_text('{\n "a": 1\n}\n'),
    "JSON lines": lambda path: path.write_text('{"a": 1}\n{"a": 2}\n'),
    "a line feed": lambda path: path.write_text("\n"),
}


@pytest.mark.parametrize("stranger", STRANGERS)
def test_a_file_that_is_no_journal_is_left_as_it_is(stranger: str, make: Make) -> None:
    """A storage that names a file of another kind by mistake is refused, and not a byte of it changes."""
    problem = make()
    path = Path(problem.config.tuning.storage)
    STRANGERS[stranger](path)
    before = path.read_bytes()
    with refused("tuning.storage must be an Optuna journal", f"'{path}'", kind=StorageError):
        run_study(problem, silent)
    assert path.read_bytes() == before


def test_an_empty_file_becomes_a_journal(make: Make) -> None:
    """What a disk that was full at the first record leaves is no obstacle."""
    problem = make(n_trials=1)
    Path(problem.config.tuning.storage).touch()
    run_study(problem, silent)
    assert len(finished(problem)) == 1


def test_a_journal_of_other_studies_is_shared(make: Make) -> None:
    """Two studies in one journal don't know of each other's trials."""
    for name in ("one", "two"):
        run_study(make(study=name, n_trials=2), silent)
    assert finished(make(study="one", n_trials=2)) == finished(make(study="two", n_trials=2))


# --- what a study was made from -------------------------------------------------------------------------


def _with_space(problem: StudyProblem, **dimensions: Any) -> StudyProblem:
    return with_tuning(problem, space=dict(problem.config.tuning.space) | dimensions)


def _reordered(problem: StudyProblem) -> StudyProblem:
    space = problem.config.tuning.space
    return with_tuning(problem, space={name: space[name] for name in ("rate", *drop(space, {"rate"}))})


def _with_optimizer(problem: StudyProblem) -> StudyProblem:
    optimizer = problem.config.optimizer
    phase = optimizer.levenberg_marquardt.model_copy(update={"steps": 3})
    return with_config(problem, optimizer=optimizer.model_copy(update={"levenberg_marquardt": phase}))


CHANGES: dict[str, tuple[Callable[[StudyProblem], StudyProblem], list[str]]] = {
    "a range": (
        lambda p: _with_space(p, rate=p.config.tuning.space["rate"].model_copy(update={"high": 0.5})),
        ["the search space changed (rate)"],
    ),
    "a dimension less": (
        lambda p: with_tuning(p, space=drop(p.config.tuning.space, {"damping"})),
        ["the search space changed (damping, its order)"],
    ),
    "the order": (_reordered, ["the search space changed (its order)"]),
    "the data": (
        lambda p: replace(p, data_fingerprint="other"),
        ["the data changed (vibration, excitation and rotor)"],
    ),
    "the known coefficients": (
        lambda p: replace(p, known=replace(p.known, values=p.known.values + 1.0)),
        ["the data changed (known coefficients)"],
    ),
    "the optimiser": (_with_optimizer, ["the configuration changed (optimizer)"]),
    "the seed": (lambda p: with_config(p, seed=3), ["the configuration changed (seed)"]),
    "the sampler": (lambda p: with_tuning(p, sampler="random"), ["the sampler changed (sampler)"]),
    "its seed": (lambda p: with_tuning(p, sampler_seed=4), ["the sampler changed (sampler_seed)"]),
    "the pruner": (lambda p: with_tuning(p, pruner="none"), ["the sampler changed (pruner)"]),
    "two at once": (
        lambda p: replace(with_tuning(p, startup_trials=4), data_fingerprint="other"),
        ["the data changed", "the sampler changed (startup_trials)"],
    ),
}


@pytest.mark.parametrize("change", CHANGES)
def test_a_study_of_something_else_is_refused(change: str, journal: bytes, make: Make) -> None:
    """The sentence names the part that changed, and the study stays as it is."""
    changed, fragments = CHANGES[change]
    problem = make(n_trials=5)
    path = Path(problem.config.tuning.storage)
    path.write_bytes(journal)
    before = told(trials_of(problem))
    advice = ["tuning.study=NAME", "tuning.changed=restart", f"'{path}'", f"'{problem.config.tuning.study}'"]
    with refused(*fragments, *advice):
        run_study(changed(problem), silent)
    assert told(trials_of(problem)) == before


def test_what_is_done_with_the_trials_may_change(journal: bytes, make: Make) -> None:
    """The number of finalists, workers and such belong to no trial: the study goes on."""
    problem = make(n_trials=4, finalists=7, seeds=(5,), least_gain=3.0, changed="restart")
    Path(problem.config.tuning.storage).write_bytes(journal)
    before = told(trials_of(problem))
    run_study(problem, silent)
    assert told(trials_of(problem)) == before
    assert set(taken(problem).values()) == {1}


@pytest.mark.parametrize("change", ["a range", "the data", "the seed"])
def test_restart_begins_a_changed_study_again(change: str, journal: bytes, make: Make) -> None:
    """Its old trials are gone and its new ones are those of a new study; other studies of the journal stay."""
    changed, _ = CHANGES[change]
    path = Path(make().config.tuning.storage)
    path.write_bytes(journal)
    run_study(make(study="other", n_trials=1), silent)
    other = told(trials_of(make(study="other")))
    problem = changed(make(n_trials=2, changed="restart"))
    run_study(problem, silent)
    restarted = finished(problem)
    assert len(trials_of(problem)) == 2
    assert told(trials_of(make(study="other"))) == other
    path.unlink()
    run_study(problem, silent)
    assert finished(problem) == restarted


@pytest.mark.nightly
def test_a_worker_with_another_search_space_may_not_join(start: Forks, make: Make) -> None:
    """While a study runs, a worker of another version is refused, and the study does not notice."""
    problem = make(n_trials=6)
    runner = start(problem)
    wait_until(lambda: len(trials_of(problem)) > 1)
    with refused("the search space changed (rate)"):
        run_study(CHANGES["a range"][0](problem), silent)
    assert runner.end() == 0, runner.said
    assert len(finished(problem)) == 6
    assert set(taken(problem).values()) == {1}


# --- several processes -----------------------------------------------------------------------------------


def in_any_order(**tuning: Any) -> dict[str, Any]:
    """Values of ``tuning`` with which a trial does not depend on those beside it."""
    return {"sampler": "random", "pruner": "none"} | tuning


@pytest.mark.nightly
def test_two_processes_that_make_one_study_at_once(
    start: Forks, make: Make, in_one_go: Callable[..., list[Told]], tmp_path: Path
) -> None:
    """Both work; there is one default trial, the total is exact, and no trial is run twice."""
    undisturbed = in_one_go(**in_any_order(n_trials=6))
    workers = []
    for attempt, slow in enumerate([0.0, 0.0, 0.2, 0.2]):
        problem = make(**in_any_order(n_trials=6), storage=str(tmp_path / f"{attempt}.log"))
        begins = time.time() + 0.2
        runners = [start(problem, begins=begins, slow=slow) for _ in range(2)]
        assert [runner.end() for runner in runners] == [0, 0], [runner.said for runner in runners]
        assert finished(problem) == undisturbed
        trials = trials_of(problem)
        assert [t.number for t in trials if t.user_attrs.get("note") == "the configured default"] == [0]
        assert trials[0].params == default_parameters(problem.config)
        assert set(taken(problem).values()) == {1}
        workers.append(len({t.user_attrs["worker"] for t in trials[:6]}))
    assert max(workers) == 2


@pytest.mark.nightly
def test_three_processes_of_which_any_dies_at_any_time(
    start: Forks, make: Make, in_one_go: Callable[..., list[Told]], rng: np.random.Generator
) -> None:
    """Each is started again where it dies; together they find what one alone would have found."""
    problem = make(**in_any_order(n_trials=12))
    longest = undisturbed_seconds(make, start, **in_any_order(n_trials=12)) / 16
    runners: list[Runner] = []
    deaths = 0
    while True:
        while len(runners) < 3:
            runners.append(start(problem))
        if (code := runners[0].code(rng.uniform(0.0, longest) * 1.02**deaths)) is None:
            runners[0].signal(signal.SIGKILL)
            code = runners[0].end()
        if code == 0:
            break
        deaths += 1
        assert deaths < 150
        runners = [*runners[1:]]
    assert [runner.end() for runner in runners] == [0, 0, 0], [runner.said for runner in runners]
    assert deaths > 3
    assert finished(problem) == in_one_go(**in_any_order(n_trials=12))


def at_work(problem: StudyProblem, pids: set[int]) -> optuna.trial.FrozenTrial | None:
    """A trial on which one of these processes works, in the middle of its training."""
    for trial in trials_of(problem):
        named = trial.user_attrs.get("worker")
        if trial.state.name == "RUNNING" and named and int(named.split(":")[1]) in pids and trial.intermediate_values:
            return trial
    return None


@pytest.mark.parametrize("workers", [2, *at_night(3)])
def test_the_trial_of_a_worker_that_dies_is_taken_over(workers: int, start: Forks, make: Make) -> None:
    """The others go on with it under its number and with its parameters, and the run says that a worker ended."""
    problem = lengthy(make(**in_any_order(n_trials=5, workers=workers)))
    runner = start(problem, others=workers - 1)
    pids = wait_until(lambda: {w.pid for w in runner.workers()} if len(runner.workers()) == workers - 1 else None)
    trial = wait_until(lambda: at_work(problem, pids))
    os.kill(int(trial.user_attrs["worker"].split(":")[1]), signal.SIGKILL)
    assert runner.end() == 0, runner.said
    assert "a worker ended with exit code -9; the others took over its trial" in runner.said
    after = trials_of(problem)[trial.number]
    assert after.state.name == "COMPLETE"
    assert after.params == trial.params
    assert after.user_attrs["worker"] != trial.user_attrs["worker"]
    assert trial.intermediate_values.items() <= after.intermediate_values.items()
    assert len(finished(problem)) == 5
    times = taken(problem)
    assert times[trial.number] == 2
    assert {times[number] for number in range(5) if number != trial.number} == {1}


def ended(processes: list[psutil.Process]) -> bool:
    """Whether none of them runs any more; one that nobody waited for is a zombie."""
    return not any(p.is_running() and p.status() != psutil.STATUS_ZOMBIE for p in processes)


@pytest.mark.nightly
def test_workers_end_with_the_process_that_started_them(start: Forks, make: Make) -> None:
    """After SIGKILL of the parent they are gone within seconds, and another process goes on with the study."""
    problem = lengthy(make(**in_any_order(n_trials=4, workers=2)))
    runner = start(problem, others=1)
    workers = wait_until(runner.workers)
    trial = wait_until(lambda: at_work(problem, {w.pid for w in workers}))
    runner.signal(signal.SIGKILL)
    assert runner.end() == -signal.SIGKILL
    wait_until(lambda: ended(workers), 10)
    complete = [t.number for t in trials_of(problem) if t.state.name == "COMPLETE"]
    again = start(with_tuning(problem, workers=1))
    assert again.end() == 0, again.said
    assert len(finished(problem)) == 4
    assert trials_of(problem)[trial.number].params == trial.params
    assert [number for number in complete if taken(problem)[number] > 1] == []


@pytest.mark.nightly
def test_a_worker_ends_with_its_parent_in_the_middle_of_a_long_phase(start: Forks, make: Make) -> None:
    """Also where no point of a learning curve is due for minutes; its trial is taken over."""
    problem = lengthy(make(**in_any_order(n_trials=2, workers=2)), 10**6, last=2)
    runner = start(problem, others=1)
    workers = wait_until(runner.workers)
    wait_until(lambda: [t.state.name for t in trials_of(problem)].count("RUNNING") == 2)
    wait_until(lambda: all("adam" in t.params for t in trials_of(problem)))
    before = [t.params for t in trials_of(problem)]
    runner.signal(signal.SIGKILL)
    assert runner.end() == -signal.SIGKILL
    wait_until(lambda: ended(workers), 10)
    again = start(with_tuning(problem, workers=1))
    wait_until(lambda: f":{again.pid}:" in str([t.user_attrs["worker"] for t in trials_of(problem)]))
    again.signal(signal.SIGKILL)
    again.end()
    assert [t.params for t in trials_of(problem)] == before


@pytest.mark.parametrize("whole_group", [True, *at_night(False)], ids=["the group", "the parent alone"])
@pytest.mark.parametrize("moment", ["in a trial", *at_night("at the start")])
def test_ctrl_c_stops_every_worker(moment: str, whole_group: bool, start: Forks, make: Make) -> None:
    """Whoever gets the signal, all end without a word of Python's, and every trial is finished or in the queue."""
    count = 2 if moment == "in a trial" else 3
    problem = lengthy(make(**in_any_order(n_trials=8, workers=count)))
    runner = start(problem, others=count - 1 if moment == "in a trial" else 0)
    workers = wait_until(lambda: runner.workers() if len(runner.workers()) == count - 1 else None)
    if moment == "in a trial":
        wait_until(lambda: at_work(problem, {w.pid for w in workers}))
    if whole_group:
        os.killpg(runner.pid, signal.SIGINT)
    else:
        runner.signal(signal.SIGINT)
    assert runner.end(20) == 130, runner.said
    assert ended(workers)
    assert "Traceback" not in runner.said, runner.said
    assert {t.state.name for t in trials_of(problem)} <= {"COMPLETE", "WAITING"}


# --- trials that fail -------------------------------------------------------------------------------------


def failing(monkeypatch: pytest.MonkeyPatch, at: int, fail: Callable[[Any], Any]) -> None:
    """The ``at``-th training returns what ``fail`` makes of its result, or raises."""
    real, calls = worker.minimise, []

    def minimise(*arguments: Any, **options: Any) -> Any:
        calls.append(1)
        batch = real(*arguments, **options)
        return fail(batch) if len(calls) == at + 1 else batch

    monkeypatch.setattr(worker, "minimise", minimise)


def _raises(error: BaseException) -> Callable[[Any], Any]:
    def fail(_: Any) -> Any:
        raise error

    return fail


def _linear_algebra() -> Exception:
    import torch

    return torch.linalg.LinAlgError("linalg.solve: the matrix is singular")


FAILURES: dict[str, tuple[Callable[[], Callable[[Any], Any]], str]] = {
    "diverged": (lambda: lambda batch: replace(batch, outcomes=(Outcome.DIVERGED,)), "diverged: the loss is not"),
    "not finite": (lambda: lambda batch: replace(batch, parameters=batch.parameters * np.nan), "diverged: the loss"),
    "linear algebra": (lambda: _raises(_linear_algebra()), "the matrix is singular"),
    "numpy's": (lambda: _raises(np.linalg.LinAlgError("Singular matrix")), "LinAlgError: Singular matrix"),
    "memory": (lambda: _raises(MemoryError("a lot")), "MemoryError: a lot"),
    "overflow": (lambda: _raises(OverflowError("too large")), "OverflowError: too large"),
    "a law": (lambda: _raises(ConfigError("x must be y")), "ConfigError: x must be y"),
}


@pytest.mark.parametrize("failure", FAILURES)
def test_a_trial_that_fails_says_why_and_the_study_goes_on(
    failure: str, make: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It is failed, with its reason, and counts as one of the total; the others are not touched."""
    fail, reason = FAILURES[failure]
    failing(monkeypatch, 1, fail())
    problem = make(n_trials=3)
    run_study(problem, silent)
    assert [state for _, state, *_ in finished(problem)] == ["COMPLETE", "FAIL", "COMPLETE"]
    attributes = trials_of(problem)[1].user_attrs
    assert reason in attributes["reason"]
    assert attributes["outcome"] in ("diverged", "failed")
    assert "\n" not in attributes["reason"]
    assert trials_of(problem)[1].value is None


@pytest.mark.parametrize("bug", [TypeError("a bug"), AttributeError("a bug"), KeyError("a bug")], ids=repr)
def test_a_bug_is_not_swallowed(
    bug: Exception, make: Make, monkeypatch: pytest.MonkeyPatch, in_one_go: Callable[..., list[Told]]
) -> None:
    """It leaves the study as it is; the trial it was at is in the queue, and runs when the bug is gone."""
    problem = make(n_trials=3)
    with monkeypatch.context() as patch:
        failing(patch, 1, _raises(bug))
        with pytest.raises(type(bug), match="a bug"):
            run_study(problem, silent)
    assert [t.state.name for t in trials_of(problem)] == ["COMPLETE", "WAITING"]
    run_study(problem, silent)
    assert finished(problem) == in_one_go()[:3]


def test_a_study_in_which_every_trial_fails(make: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    """It ends at its total."""
    monkeypatch.setattr(worker, "minimise", lambda *_, **__: _raises(RuntimeError("no"))(None))
    problem = make(n_trials=4)
    run_study(problem, silent)
    assert [state for _, state, *_ in finished(problem)] == ["FAIL"] * 4


# --- who lives ---------------------------------------------------------------------------------------------


def test_this_process_lives() -> None:
    """A worker does not take itself for dead."""
    assert not is_dead(this_worker())


def test_a_worker_that_is_gone_is_dead() -> None:
    """Its number is in no process table; or it is a zombie, which nobody has waited for yet."""
    process = subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE)
    host = this_worker().split(":")[0]
    name = f"{host}:{process.pid}:{psutil.Process(process.pid).create_time():.2f}"
    assert not is_dead(name)
    process.kill()
    wait_until(lambda: psutil.Process(process.pid).status() == psutil.STATUS_ZOMBIE)
    assert is_dead(name)
    process.communicate()
    assert is_dead(name)


def test_a_number_that_was_given_again_is_not_the_worker() -> None:
    """A process of the same number that began at another time is another one."""
    host, pid, began = this_worker().rsplit(":", 2)
    assert is_dead(f"{host}:{pid}:{float(began) - 100:.2f}")
    assert not is_dead(f"{host}:{pid}:{float(began) + 0.5:.2f}")  # the clock that it is computed from was adjusted


def test_a_worker_of_another_machine_is_not_judged_here() -> None:
    """The process table says nothing about it, whatever its number and its host's name."""
    for host in ("elsewhere", "else:where", ""):
        assert not is_dead(f"{host}:1:0.00")
        assert not is_dead(f"{host}:{2**22 + 1}:0.00")


def test_a_trial_that_was_taken_over_is_not_judged_by_its_first_worker(make: Make) -> None:
    """Before the second worker has put its name on it, a third one must not take it as well."""
    problem = make(n_trials=2)
    opened = open_study(problem)
    trial = opened.ask()
    trial.set_user_attr(liveness.WORKER, this_worker().rsplit(":", 1)[0] + ":1.00")
    assert not requeue_orphans(opened)
    assert [t.state.name for t in opened.get_trials()] == ["WAITING"]
    again = opened.ask()
    assert again.number == 0
    assert requeue_orphans(opened)  # who works on it can't be told yet
    assert [t.state.name for t in opened.get_trials()] == ["RUNNING"]


def test_a_machine_that_was_renamed_goes_on(make: Make) -> None:
    """A container has another name whenever it starts: its journal holds trials of workers elsewhere, all dead."""
    opened = open_study(make(n_trials=2))
    opened.ask().set_user_attr(liveness.WORKER, "elsewhere:1:1.00")
    assert not requeue_orphans(opened)
    assert [t.state.name for t in opened.get_trials()] == ["WAITING"]


def test_a_trial_whose_worker_never_gave_its_name_is_taken_over_after_a_while(
    make: Make, monkeypatch: pytest.MonkeyPatch, in_one_go: Callable[..., list[Told]]
) -> None:
    """Its worker died in the moment between."""
    monkeypatch.setattr(liveness, "_NAMELESS_SECONDS", 0.5)
    problem = make(n_trials=2)
    open_study(problem).ask()
    run_study(problem, silent)
    assert finished(problem) == in_one_go()[:2]
    assert taken(problem) == {0: 2, 1: 1}


# --- mistakes ------------------------------------------------------------------------------------------------

FOREIGN = ("Traceback", "pydantic", "Input should", "optuna.", "Background on this", "secret")
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
    "choice twice": ({"x": ACTIVATION | {"choices": ["tanh", "tanh"]}}, ["must name each choice once"]),
    "no choice": ({"x": ACTIVATION | {"choices": []}}, ["tuning.space.x", "must have at least 1 item"]),
    "name": ({"x.y": RATE}, ["x.y", "must match pattern"]),
}


@cache
def _mapping() -> dict[str, Any]:
    return composed_mapping(CHEAP)


def configured(**tuning: Any) -> Config:
    """The configuration of the cheap study with other values of ``tuning``, as the command line checks it."""
    mapping = _mapping()
    return validated(mapping | {"stage": "tune", "tuning": mapping["tuning"] | tuning})


def plain(caught: pytest.ExceptionInfo[PipelineError], *fragments: str) -> None:
    """The error's text must have all ``fragments`` and nothing of other programs; two short lines at most."""
    sentence = str(caught.value)
    assert [fragment for fragment in fragments if fragment not in sentence] == [], sentence
    assert [word for word in FOREIGN if word in sentence] == [], sentence
    assert len(sentence.splitlines()) <= 3, sentence
    assert all(len(line) < 400 for line in sentence.splitlines())


@pytest.mark.parametrize("mistake", BAD_SPACES)
def test_a_mistake_in_the_search_space(mistake: str) -> None:
    """It is answered before anything runs, by a sentence that names the dimension."""
    space, fragments = BAD_SPACES[mistake]
    with pytest.raises(ConfigError) as caught:
        configured(space=space)
    plain(caught, *fragments)


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
    ({"n_trails": 5}, ["tuning.n_trails", "did you mean 'n_trials'?"]),
]


@pytest.mark.parametrize(("tuning", "fragments"), BAD_VALUES)
def test_a_mistake_in_another_value_of_a_study(tuning: dict[str, Any], fragments: list[str]) -> None:
    """The same for what is not of the search space."""
    with pytest.raises(ConfigError) as caught:
        configured(**tuning)
    plain(caught, *fragments)


def _choices(problem: StudyProblem, **update: Any) -> dict[str, Any]:
    output = problem.config.tuning.space["output"].model_copy(update=update)
    return dict(problem.config.tuning.space) | {"output": output}


BAD_STUDIES: dict[str, tuple[Callable[[StudyProblem], dict[str, Any]], list[str]]] = {
    "empty": (lambda _: {"space": {}}, ["must have a search space", "tuning.space is empty", "tuning=network"]),
    "default below a range": (
        lambda p: {"space": {"adam": p.config.tuning.space["adam"].model_copy(update={"low": 50})}},
        ["must contain the configured default", "optimizer.adam.steps = 40", "adam goes from 50 to 60"],
    ),
    "default outside of the choices": (
        lambda p: {"space": _choices(p, choices=("scaled",))},
        ["must contain the configured default", "model.parametrisation = log", "choices of output are scaled"],
    ),
    "default outside of the presets": (
        lambda _: {"space": configured(space={"x": _preset({"optimizer.adam.steps": 1})}).tuning.space},
        ["must contain the configured default", "optimizer.adam.steps = 40", "choices of x are one"],
    ),
    "key of another model": (
        lambda _: {"space": configured(space={"x": WIDTH}).tuning.space},
        ["'model.width' is not one of ball_bearing", "tuning=constant"],
    ),
    "key that is none": (
        lambda _: {"space": configured(space={"x": RATE | {"key": "optimizer.adam.rate"}}).tuning.space},
        ["'optimizer.adam.rate' is not one of ball_bearing"],
    ),
    "values that the schema refuses": (
        lambda _: {"space": configured(space={"x": RATE | {"key": "training.tolerance", "high": 5}}).tuning.space},
        ["tuning.space.x must give values that the schema takes", "training.tolerance"],
    ),
}


def _preset(values: dict[str, Any]) -> dict[str, Any]:
    return {"kind": "preset", "choices": {"one": values}}


@pytest.mark.parametrize("mistake", BAD_STUDIES)
def test_a_space_that_does_not_fit_the_experiment(mistake: str, make: Make, tmp_path: Path) -> None:
    """What only the experiment can tell is a sentence too, and leaves no study behind."""
    changed, fragments = BAD_STUDIES[mistake]
    problem = make()
    with pytest.raises(ConfigError) as caught:
        open_study(with_tuning(problem, **changed(problem)))
    plain(caught, *fragments)
    assert list(tmp_path.iterdir()) == []


BAD_STORAGES = {
    "refused port": ("postgresql+psycopg://u:secret@127.0.0.1:1/x", ["127.0.0.1:1", "refused"]),
    "unknown driver": ("postgresql+nothing://u:secret@h/x", ["postgresql.nothing"]),
    "missing driver": ("mysql+pymysql://u:secret@127.0.0.1:1/x", ["driver is installed", "pymysql"]),
    "unknown scheme": ("mongodb://u:secret@h/x", ["mongodb"]),
    "no host": ("postgresql+psycopg://u:secret@no.such.host.invalid/x", ["no.such.host.invalid"]),
    "no number": ("postgresql+psycopg://u:secret@h:port/x", ["must"]),
    "no database": ("sqlite:///no/such/folder/x.db", ["sqlite:///no/such/folder/x.db", "unable to open"]),
    "a folder": (".", ["'.'", "Is a directory"]),
    "below a file": ("file/x.log", ["'file/x.log'", "must be writable"]),
    "a name that is too long": ("x" * 256, ["File name too long"]),
}


@pytest.mark.parametrize("mistake", BAD_STORAGES)
def test_a_storage_that_cannot_be_used(
    mistake: str, make: Make, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A sentence names it, without its password."""
    monkeypatch.chdir(tmp_path)
    storage, fragments = BAD_STORAGES[mistake]
    (tmp_path / "file").write_text("a file")
    with pytest.raises(StorageError) as caught:
        run_study(make(storage=storage, timeout_seconds=4.0), silent)
    plain(caught, "tuning.storage", *fragments)
    assert len(str(caught.value).splitlines()) == 1
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


@pytest.fixture
def tune(
    data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> Callable[..., tuple[int, str]]:
    """``tune(overrides)``: exit code and errors of the command line in this process, on the module's data."""
    monkeypatch.chdir(tmp_path)

    def run(*overrides: str) -> tuple[int, str]:
        arguments = ["stage=tune", *CHEAP, f"output='{data}'", "tuning.storage=studies.log", "tuning.folder=best"]
        capsys.readouterr()
        code = main([*arguments, *overrides])
        return code, capsys.readouterr().err

    return run


@pytest.mark.parametrize(
    ("override", "fragments"),
    [
        ("tuning.sampler=tpee", ["did you mean 'tpe'?"]),
        ("training.holdout_every=0", ["must judge its trials on held-out speeds", "training.holdout_every is 0"]),
        ("optimizer.adam.steps=100", ["must contain the configured default", "optimizer.adam.steps = 100"]),
        ("tuning.storage='postgresql+psycopg://u:secret@127.0.0.1:1/x'", ["u:***@127.0.0.1:1/x", "refused"]),
    ],
)
def test_mistakes_on_the_command_line(
    override: str, fragments: list[str], tune: Callable[..., tuple[int, str]], tmp_path: Path
) -> None:
    """Exit code 2 and a sentence; nothing is written."""
    code, err = tune(override)
    assert code == 2
    assert [fragment for fragment in fragments if fragment not in err] == [], err
    assert [word for word in FOREIGN if word in err] == [], err
    assert len(err.splitlines()) <= 2, err
    assert list(tmp_path.iterdir()) == []


@pytest.mark.nightly
def test_a_host_that_does_not_answer(tune: Callable[..., tuple[int, str]]) -> None:
    """A host that no packet comes back from is given up, and named."""
    code, err = tune("tuning.storage='postgresql+psycopg://u:secret@10.255.255.1/x'")
    assert code == 2
    assert "postgresql+psycopg://u:***@10.255.255.1/x" in err
    assert "secret" not in err
    assert len(err.splitlines()) == 1, err


def test_a_storage_in_a_read_only_folder(make: Make, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The system's reason is in the sentence; nothing is made."""
    import builtins
    import errno
    import io

    def read_only(real: Callable[..., Any]) -> Callable[..., Any]:
        def opened(file: Any, mode: Any = "r", *arguments: Any, **options: Any) -> Any:
            writes = mode & (os.O_WRONLY | os.O_RDWR | os.O_CREAT) if isinstance(mode, int) else set(mode) & set("wa+x")
            if writes and str(file).startswith(str(tmp_path)):
                raise OSError(errno.EROFS, os.strerror(errno.EROFS), str(file))
            return real(file, mode, *arguments, **options)

        return opened

    problem = make()
    with monkeypatch.context() as patch:
        for module in (builtins, io, os):
            patch.setattr(module, "open", read_only(module.open))
        with refused("must be writable", "Read-only file system", problem.config.tuning.storage, kind=StorageError):
            open_storage(problem.config.tuning)
    assert list(tmp_path.iterdir()) == []


def test_a_disk_that_is_full_in_the_middle_of_a_study(
    start: Forks, make: Make, in_one_go: Callable[..., list[Told]]
) -> None:
    """A sentence; with room again, the study goes on and ends as if nothing had been."""
    problem = make(n_trials=3)
    path = Path(problem.config.tuning.storage)
    run_study(make(n_trials=1), silent)
    room = path.stat().st_size + 2000
    runner = start(problem, room=room)
    assert runner.end() == 2, runner.said
    assert runner.said.startswith("StorageError: tuning.storage must be writable")
    assert f"'{path}' is not (File too large)" in runner.said
    assert path.stat().st_size == room
    run_study(problem, silent)
    assert finished(problem) == in_one_go()[:3]


# --- the command line -----------------------------------------------------------------------------------------


def test_the_command_line_goes_on_where_it_was_interrupted(
    data: Path,
    tmp_path: Path,
    make: Make,
    in_one_go: Callable[..., list[Told]],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """SIGINT is 130 and a sentence; the same command ends with the trials of an undisturbed study, then has nothing
    to do."""
    folder = shutil.copytree(data, tmp_path / "data")
    places = [f"output='{folder}'", "tuning.storage=studies.log", "tuning.folder=best"]
    command = [*PYTHON, "-m", "pipeline", "stage=tune", *CHEAP, *places]
    problem = make()
    options: dict[str, Any] = {
        "cwd": tmp_path,
        "env": ENVIRONMENT,
        "text": True,
        "stdout": subprocess.PIPE,
        "stderr": subprocess.PIPE,
        # A shell's background job hands down an ignored SIGINT.
        "preexec_fn": lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
    }
    with subprocess.Popen(command, **options) as process:
        wait_until(lambda: process.poll() is not None or len(trials_of(problem)) > 2)
        process.send_signal(signal.SIGINT)
        out, err = process.communicate(timeout=30)
    assert process.returncode == 130, err
    assert "study interrupted; no finished trial is lost, and the same command goes on" in out + err
    assert "Traceback" not in out + err
    before = told([t for t in trials_of(problem) if t.state.is_finished()])
    assert before == in_one_go()[: len(before)]
    assert 2 <= len(before) < TRIALS
    with subprocess.Popen(command, **options) as process:
        out, err = process.communicate(timeout=90)
    assert process.returncode == 0, err
    assert re.search(rf"{TRIALS} trials in", out)
    assert finished(problem) == in_one_go()
    report = {p.name: p.read_bytes() for p in (tmp_path / "best").iterdir() if p.is_file()}
    assert {"best.yaml", "README.md", "summary.json", "trials.csv", "finalists.csv"} <= report.keys()
    monkeypatch.chdir(tmp_path)
    assert main(command[command.index("stage=tune") :]) == 0
    assert f"the study has its {TRIALS} trials" in capsys.readouterr().out
    assert finished(problem) == in_one_go()
    assert set(taken(problem).values()) <= {1, 2}
    assert {p.name: p.read_bytes() for p in (tmp_path / "best").iterdir() if p.is_file()} == report
