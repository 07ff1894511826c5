"""The container: what is locked is what is tested, and what its files name is there."""

from __future__ import annotations

import itertools
import re
import shlex
import subprocess
import tomllib
from pathlib import Path
from typing import Any

import pytest
import yaml
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from running import ROOT


def read_lines(name: str) -> list[str]:
    """Without comments, lines that go on joined."""
    text = (ROOT / name).read_text(encoding="utf-8").replace("\\\n", " ")
    return [line for line in text.splitlines() if line.strip() and not line.startswith("#")]


def read_pins(name: str) -> dict[str, str]:
    """The version of each package of a file of pins; torch's without its build."""
    pins = (line.partition(" --hash")[0].strip(" \\").partition("==") for line in read_lines(name))
    return {canonicalize_name(package.partition("[")[0]): version.partition("+")[0] for package, _, version in pins}


def compose() -> dict[str, Any]:
    return dict(yaml.safe_load((ROOT / "compose.yaml").read_text(encoding="utf-8")))


def test_the_lock_has_the_versions_that_the_tests_pass_with() -> None:
    locked, tested = read_pins("requirements.lock"), read_pins("constraints.txt")
    assert {name: tested.get(name) for name in locked} == locked, "run `make lock`"


def test_the_lock_has_everything_that_runs_and_its_hashes() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    needed = {canonicalize_name(Requirement(text).name) for text in project["dependencies"]}
    assert needed <= set(read_pins("requirements.lock")), "run `make lock`"
    assert [s for s in read_lines("requirements.lock") if not re.search(r"--hash=sha256:[0-9a-f]{64}", s)] == []


def test_the_image_copies_what_there_is() -> None:
    sent = {line.removeprefix("!") for line in read_lines(".dockerignore") if line.startswith("!")}
    commands = [shlex.split(line) for line in read_lines("Dockerfile")]
    copies = [words[1:-1] for words in commands if words[0] == "COPY" and not words[1].startswith("--from")]
    copied = set(itertools.chain(*copies))
    assert copied == sent
    assert all((ROOT / name).exists() for name in copied)


def test_no_password_is_written_down_and_no_page_is_open_to_others() -> None:
    text = (ROOT / "compose.yaml").read_text(encoding="utf-8")
    assert re.findall(r'://\w+:([^@\s",]*)@', text) == ["${POSTGRES_PASSWORD:?}"] * 3
    ports = [port for service in compose()["services"].values() for port in service.get("ports", [])]
    assert [port.startswith("127.0.0.1:") for port in ports] == [True, True], ports


@pytest.mark.parametrize("service", ["records", "tables", "dashboard"])
@pytest.mark.slow
def test_the_servers_know_their_options(service: str) -> None:
    import sys

    described = compose()["services"][service]
    said = subprocess.run(
        [Path(sys.executable).with_name(described["entrypoint"][0]), *described["entrypoint"][1:], "--help"],
        capture_output=True,
        text=True,
        check=True,
    ).stdout
    for option in described["command"]:
        if option.startswith("--"):
            assert re.search(rf"{re.escape(option.partition('=')[0])}\b", said), option
