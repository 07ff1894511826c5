"""The services of compose.yaml, started here on loopback by their own commands."""

from __future__ import annotations

import json
import subprocess
import sys
import time
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any
from urllib.parse import quote

import pytest
from postgres import PASSWORD, Server, free_port, run_postgres
from test_container import compose

from studies import ENVIRONMENT

PROGRAMS = Path(sys.executable).parent


@pytest.fixture
def server() -> Iterator[Server]:
    """A running PostgreSQL, with the databases that compose.yaml makes."""
    with run_postgres() as running:
        with running.connection() as connection:
            connection.execute("create database studies")
            connection.execute(compose()["configs"]["records"]["content"])
        yield running


def read(url: str) -> Any:
    """The JSON that a page answers with, once it does."""
    ends = time.monotonic() + 90
    while True:
        with suppress(OSError), urllib.request.urlopen(url, timeout=5) as answer:
            return json.loads(answer.read() or "null")
        assert time.monotonic() < ends, f"{url} never answered"
        time.sleep(0.5)


def command_of(name: str, server: Server, folder: Path, port: int = 0) -> list[str]:
    """The command of a service, with places of this machine for those of the containers."""
    service = compose()["services"][name]
    inside = service.get("ports", [":"])[0].rpartition(":")[2]
    moves = {
        "team:${POSTGRES_PASSWORD:?}@database/": f"study:{quote(PASSWORD, safe='')}@127.0.0.1:{server.port}/",
        "0.0.0.0": "127.0.0.1",
        "=/records": f"={folder / 'records'}",
    }
    if inside:
        moves |= {f"{before}{inside}": f"{before}{port}" for before in ("localhost:", "127.0.0.1:", "--port=")}
    words = [*service["entrypoint"], *service["command"]]
    for there, here in moves.items():
        words = [word.replace(there, here) for word in words]
    return [str(PROGRAMS / words[0]), *words[1:]]


@contextmanager
def run_service(name: str, server: Server, folder: Path) -> Iterator[str]:
    """The address of a service, while it runs."""
    port = free_port()
    running = subprocess.Popen(command_of(name, server, folder, port), cwd=folder, env=ENVIRONMENT)
    try:
        yield f"http://127.0.0.1:{port}"
    finally:
        running.terminate()
        running.wait(30)


def test_a_team_sees_what_a_pipeline_did(server: Server, tmp_path: Path) -> None:
    """A run is in the records with its figures, and a study's trials on the dashboard."""
    subprocess.run(command_of("tables", server, tmp_path), cwd=tmp_path, env=ENVIRONMENT, check=True)
    with run_service("records", server, tmp_path) as records, run_service("dashboard", server, tmp_path) as dashboard:
        with suppress(ValueError):
            read(f"{records}/health")  # not JSON: it is up
        storage = f"postgresql+psycopg://study@127.0.0.1:{server.port}/studies"
        words = [
            "stage=[evaluate,tune]",
            "experiment=ball_bearing",
            f"tracking.uri={records}",
            f"tuning.storage={storage}",
        ]
        small = ["machine.speeds.step_rpm=590", "tuning.n_trials=2", "tuning.finalists=1", "tuning.seeds=[0]"]
        done = subprocess.run(
            [sys.executable, "-m", "pipeline", *words, *small, "tuning.folder=study"],
            cwd=tmp_path,
            env=ENVIRONMENT | {"PGPASSWORD": PASSWORD},
            capture_output=True,
            text=True,
        )
        assert done.returncode == 0, done.stderr
        experiments = read(f"{records}/api/2.0/mlflow/experiments/search?max_results=10")["experiments"]
        assert "ball_bearing" in {experiment["name"] for experiment in experiments}
        assert list((tmp_path / "records").rglob("*.png")), "figures were sent to the server"
        studies = read(f"{dashboard}/api/studies")["study_summaries"]
        assert [study["study_name"] for study in studies] == ["ball_bearing"]
