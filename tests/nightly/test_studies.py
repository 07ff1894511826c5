"""Studies that are stopped, shared and starved, in more ways than by day."""

from __future__ import annotations

import signal
import time
from pathlib import Path

import numpy as np
import psutil
import pytest
import tuning.test_storage as mistakes
import tuning.test_study_database as database_tests
import tuning.test_worker as resume
from postgres import Server
from running import at_night

from pipeline.tuning.storage import repeat_stopped
from pipeline.tuning.study import open_study
from studies import (
    ALONE,
    TRIALS,
    Forks,
    Make,
    Undisturbed,
    ended,
    finished,
    lengthen,
    told,
    trials_of,
    wait_until,
    with_tuning,
)

pytestmark = pytest.mark.slow
database, server = database_tests.database, database_tests.server
test_a_killed_worker_loses_no_trial = at_night(database_tests.test_a_killed_worker_loses_no_trial, "kind", ["sqlite"])
test_machines_that_make_a_study_together = at_night(
    database_tests.test_machines_that_make_a_study_together, "kind", ["sqlite"]
)
test_a_study_that_is_stopped = at_night(
    resume.test_a_study_that_is_stopped_at_random_moments_ends_as_if_it_had_not_been,
    ("number", "sampler"),
    [*((signal.SIGKILL, name) for name in ("random", "gp")), *((signal.SIGINT, name) for name in ("tpe", "gp"))],
)
test_the_trial_of_a_worker_that_dies_is_taken_over = at_night(
    resume.test_the_trial_of_a_worker_that_dies_is_taken_over, "workers", [3]
)
test_ctrl_c_stops_every_worker = at_night(
    resume.test_ctrl_c_stops_every_worker,
    ("moment", "whole_group"),
    [("in a trial", False), ("at the start", True), ("at the start", False)],
)
test_mistakes_on_the_command_line = at_night(
    mistakes.test_mistakes_on_the_command_line,
    ("override", "fragments"),
    [("tuning.storage='postgresql+psycopg://u:secret@10.255.255.1/x'", ["u:***@10.255.255.1/x"])],
)


def test_two_processes_that_make_one_study_at_once(
    start: Forks, make: Make, undisturbed: Undisturbed, tmp_path: Path
) -> None:
    """Into no file at all: there is one default trial, the total is exact, and no trial is run twice."""
    workers = []
    for attempt in range(4):
        problem = make(**ALONE, storage=f"sqlite:///{tmp_path}/{attempt}.db")
        begins = time.time() + 0.2
        runners = [start(problem, begins=begins) for _ in range(2)]
        assert [(runner.end(), runner.said) for runner in runners] == [(0, "")] * 2
        assert finished(problem) == undisturbed(**ALONE)
        results = [trial for trial in trials_of(problem) if trial.state.name == "COMPLETE"]
        assert len(results) == TRIALS
        workers.append(len({trial.user_attrs["worker"] for trial in results}))
    assert max(workers) == 2


def test_three_processes_of_which_any_dies_at_any_time(
    start: Forks, make: Make, undisturbed: Undisturbed, rng: np.random.Generator
) -> None:
    """Each is started again where it dies; together they find what one alone would have found."""
    problem = make(**ALONE, n_trials=30)
    runners = [start(problem) for _ in range(3)]
    for _ in range(6):
        time.sleep(rng.uniform(0.5, 2.0))
        first = runners.pop(0)
        if first.ended is None and psutil.pid_exists(first.pid):
            first.signal(signal.SIGKILL)
        first.end()
        runners.append(start(problem))
    assert [(runner.end(), runner.said) for runner in runners] == [(0, "")] * 3
    assert finished(problem) == undisturbed(**ALONE, n_trials=30)


@pytest.mark.parametrize("steps", [1000, 10**6], ids=["short", "no point of a curve for minutes"])
def test_workers_end_with_the_process_that_started_them(steps: int, start: Forks, make: Make) -> None:
    problem = lengthen(make(**ALONE, n_trials=4, workers=2), steps, last=2)
    runner = start(problem, others=1)
    workers = wait_until(runner.workers)
    wait_until(lambda: sum("adam" in t.params for t in trials_of(problem) if t.state.name == "RUNNING") == 2)
    runner.kill()
    wait_until(lambda: ended(workers), 10)
    study, config = open_study(problem), problem.config.tuning
    wait_until(lambda: "RUNNING" not in {trial.state.name for trial in repeat_stopped(study, config)})


def test_a_slow_machine_keeps_its_trial(server: Server, start: Forks, make: Make, undisturbed: Undisturbed) -> None:
    """A worker keeps its trial as long as it gives heartbeats; one that stood still, as a laptop that slept, has lost
    it when it wakes up: its result changes nothing, and it ends well."""
    problem = make(**ALONE, storage=server.database(), n_trials=4)
    far = start(problem, halts=True)
    number = far.halt()
    near = start(problem)
    wait_until(lambda: len(told(problem)) == 3)
    time.sleep(4.0)  # longer than the three heartbeats after which a worker is given up
    assert trials_of(problem)[number].state.name == "RUNNING"
    far.signal(signal.SIGSTOP)
    assert (near.end(), near.said) == (0, "")
    assert finished(problem) == undisturbed(**ALONE)[:4]
    far.go_on()
    far.signal(signal.SIGCONT)
    assert (far.end(), far.said) == (0, "")
    assert finished(problem) == undisturbed(**ALONE)[:4]


def test_a_server_that_stops_in_the_middle(server: Server, start: Forks, make: Make, undisturbed: Undisturbed) -> None:
    """Both workers of a command end with one sentence; when the server is back, the study goes on where it was."""
    problem = make(**ALONE, storage=server.database(), workers=2, timeout_seconds=3.0)
    worker = start(problem, halts=True)
    worker.halt()
    wait_until(lambda: told(problem))
    server.stop()
    try:
        time.sleep(1.5)  # a heartbeat finds nobody
        worker.go_on()
        assert worker.end() == 2
    finally:
        server.start()
    said = worker.said
    assert "tuning.storage must be a database that can be used, but 'postgresql+psycopg://study:***@" in said
    assert said.endswith("No finished trial is lost; the same command goes on\n")
    assert said.count("\n") == 1, said
    again = start(with_tuning(problem, workers=1))
    assert (again.end(), again.said) == (0, "")
    assert finished(problem) == undisturbed(**ALONE)
