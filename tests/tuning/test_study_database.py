"""Studies in a database that several machines share: a real PostgreSQL, real worker processes, real deaths."""

from __future__ import annotations

import gc
import socket
import time
import warnings
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import pytest
from postgres import PASSWORD, Server, free_port, run_postgres

from pipeline.errors import StorageError
from pipeline.tuning.storage import REPEATS
from pipeline.tuning.study import StudyProblem
from pipeline.tuning.worker import run_study
from studies import (
    ALONE,
    Forks,
    Make,
    Undisturbed,
    finished,
    refused,
    silent,
    stored,
    told,
    trials_of,
    wait_until,
    with_tuning,
)

pytestmark = pytest.mark.slow


@pytest.fixture(autouse=True)
def _collect_connections() -> Iterator[None]:
    """Optuna's storages leave their pools to the garbage collector, where psycopg warns of open connections."""
    yield
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ResourceWarning)
        gc.collect()


@pytest.fixture(scope="module")
def server() -> Iterator[Server]:
    """A running PostgreSQL."""
    with run_postgres() as running:
        yield running


@pytest.fixture
def database(kind: str, request: pytest.FixtureRequest, tmp_path: Path) -> str:
    """The URL of an empty database of each kind."""
    if kind == "sqlite":
        return f"sqlite:///{tmp_path}/shared.db"
    server: Server = request.getfixturevalue("server")
    return server.database()


@pytest.mark.parametrize("kind", ["postgresql"])
def test_a_killed_worker_loses_no_trial(database: str, start: Forks, make: Make, undisturbed: Undisturbed) -> None:
    """Of three workers one gets SIGKILL in mid-trial: another repeats that very trial, and all others are there.

    The two that are left may see the death at the same moment. The first repeat counts then, and a spare has no result.
    """
    problem = make(**ALONE, storage=database)
    killed = start(problem, halts=True)
    number = killed.halt()
    before = trials_of(problem)[number]
    others = [start(problem) for _ in range(2)]
    wait_until(lambda: told(problem))
    killed.kill()
    assert [(other.end(), other.said) for other in others] == [(0, "")] * 2
    assert finished(problem) == undisturbed(**ALONE)
    repeat, *spare = (trial for trial in trials_of(problem) if trial.user_attrs.get(REPEATS) == number)
    assert [trial.value for trial in spare] == [None] * len(spare)
    assert repeat.params == before.params
    assert repeat.intermediate_values.items() >= before.intermediate_values.items()


@pytest.mark.parametrize("kind", ["postgresql"])
def test_machines_that_make_a_study_together(database: str, start: Forks, make: Make, undisturbed: Undisturbed) -> None:
    """Into an empty database, at the same moment: one makes the tables and the study, and all work on it."""
    problem = make(**ALONE, storage=database)
    begins = time.time() + 0.3
    workers = [start(problem, begins=begins) for _ in range(3)]
    assert [(worker.end(), worker.said) for worker in workers] == [(0, "")] * 3
    assert finished(problem) == undisturbed(**ALONE)
    notes = [trial.user_attrs.get("note") for trial in trials_of(problem)]
    assert notes == ["the configured default"] + [None] * (len(notes) - 1)
    with stored(problem) as study:
        assert (study.user_attrs.keys(), study.metric_names) == ({"made_from"}, ["log10 of the held-out loss"])


def test_the_same_study_in_every_kind_of_storage(server: Server, make: Make, undisturbed: Undisturbed) -> None:
    """One worker's trials are the same wherever they are kept; a server goes on from 2 trials to 5 as a file does."""
    storage = server.database()
    for total in (2, 5):
        _, sentences = run_study(make(storage=storage, n_trials=total), silent)
        assert sentences == []
    assert finished(make(storage=storage, n_trials=5)) == undisturbed()[:5]


def test_a_database_that_can_not_be_used_is_one_sentence(server: Server, cheap: StudyProblem) -> None:
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
    }
    for url, reason in wrong.items():
        with pytest.raises(StorageError) as caught:
            run_study(with_tuning(cheap, storage=url), silent)
        said = str(caught.value)
        assert said.startswith("tuning.storage must "), said
        assert reason in said
        assert "\n" not in said
        assert not [part for part in ("not:the", "/one", "pass:wo", "/rd") if part in said], said


def test_a_server_that_never_answers(cheap: StudyProblem) -> None:
    """A port that takes the connection and says nothing: given up after tuning.timeout_seconds."""
    with closing(socket.create_server(("127.0.0.1", 0))) as listening:
        url = f"postgresql+psycopg://study:secret@127.0.0.1:{listening.getsockname()[1]}/x"
        with refused("tuning.storage must", kind=StorageError):
            run_study(with_tuning(cheap, storage=url, timeout_seconds=3.0), silent)
