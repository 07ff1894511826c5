"""What README prints below a command of the study pipeline is what the command prints."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from running import ROOT, python

pytestmark = pytest.mark.slow

_NUMBER = re.compile(r"\d+(?:\.\d+)?(?:e[+-]?\d+)?")


def read_outputs() -> dict[str, list[str]]:
    """Command -> the lines printed below it."""
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    section = text[text.index("## The study pipeline") : text.index("## Against the paper")]
    outputs: dict[str, list[str]] = {}
    for line in re.findall(r"^    (.+)$", section, re.M):
        if line.startswith("  "):
            outputs[list(outputs)[-1]].append(line.strip())
        else:
            outputs[line] = []
    return outputs


def is_printed(line: str, said: str) -> bool:
    """Word for word up to ``...``, and its numbers to a fifth: times and last digits are of the machine."""
    begin, _, _ = line.partition(" ...")
    words, numbers = _NUMBER.sub("#", begin).split(), [float(one) for one in _NUMBER.findall(begin)]
    for other in said.splitlines():
        same = _NUMBER.sub("#", other).split()[: len(words)] == words
        theirs = [float(one) for one in _NUMBER.findall(other)][: len(numbers)]
        if same and theirs == pytest.approx(numbers, rel=0.2):
            return True
    return False


@pytest.mark.parametrize(
    "start", ["python -m pipeline stage=train", pytest.param("python -m pipeline -m ", marks=pytest.mark.nightly)]
)
def test_readme_prints_what_a_command_prints(start: str, tmp_path: Path) -> None:
    """In an empty folder: training, and a multirun with its table."""
    command, lines = next((one, of) for one, of in read_outputs().items() if one.startswith(start))
    done = python(*(word.strip("'") for word in command.split()[1:]), "tracking=none", cwd=tmp_path)
    assert (done.returncode, bool(lines)) == (0, True), done.stderr
    assert [line for line in lines if not is_printed(line, done.stdout)] == [], done.stdout


def test_every_use_has_its_command() -> None:
    uses = (
        "stage=train",
        "model.width=8,16,32",
        "stage=tune",
        "make dashboard",
        "mlflow ui",
        "dvc repro",
        "stage=check",
    )
    assert [use for use in uses if use not in " ".join(read_outputs())] == []
