"""Forty mistakes of machine files, tables and commands: the first line says what is wrong, and the cure."""

from __future__ import annotations

import re
import shutil
from pathlib import Path
from typing import Any

import pytest
import yaml
from machine_files import given_by
from running import EXAMPLE

from pipeline.__main__ import main

pytestmark = pytest.mark.slow  # every test composes a configuration by Hydra: half a second each

MISTAKES = yaml.safe_load(Path(__file__).with_name("mistakes.yaml").read_text(encoding="utf-8"))


@pytest.mark.usefixtures("no_pictures")
@pytest.mark.parametrize("case", MISTAKES, ids=lambda case: case["mistake"])
def test_a_mistake_is_named_with_its_cure(
    case: dict[str, Any], folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in ("as_found.csv", "first_disc.csv", "second_disc.csv", "rotor.toml", "tables.yaml"):
        shutil.copy(EXAMPLE / name, folder)
    for key, name in (("machine", "tables.yaml"), ("table", "first_disc.csv")):
        for right, wrong in case.get(key, {}).items():
            text, count = re.subn(right, wrong, (folder / name).read_text(), flags=re.M)
            assert count, right
            (folder / name).write_text(text)
    given = [given_by(folder / "tables.yaml"), f"output='{folder / 'out'}'", "tracking=none", "stage=ingest"]
    if "given" in case:
        key = case["given"].partition("=")[0]
        given = [*(each for each in given if each.partition("=")[0] != key), case["given"]]
    ended = main(given)
    lines = capsys.readouterr().err.splitlines()
    looked_at = lines[:1] if ended else lines
    assert [line for line in looked_at if all(part in line for part in case["said"])], lines
