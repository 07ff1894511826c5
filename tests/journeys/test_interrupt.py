"""Ctrl-C in training keeps the best state so far; two processes at once leave complete files."""

from __future__ import annotations

import csv
import json
import os
import pty
import select
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from unittest.mock import DEFAULT, Mock

import numpy as np
import pytest
from conftest import ANSWER, DATA, Run
from running import FEW_SPEEDS, PYTHON, ROOT, names_in, strict_json

from pipeline.config.compose import compose_config
from pipeline.identification.storage import load_model
from pipeline.stages import robustness, train

pytestmark = pytest.mark.slow  # it trains, or starts processes

ENVIRONMENT = os.environ | {"PYTHONPATH": str(ROOT), "TERM": "xterm", "COLUMNS": "120"}
COARSE = [
    "experiment=ball_bearing",
    "tracking=none",
    *FEW_SPEEDS,
    "robustness.count=3",
]
LONG = ["optimizer=adam", "optimizer.adam.steps=100000000", "optimizer.adam.patience=100000000"]


def losses(folder: Path, column: str = "held_out_loss") -> list[float]:
    """Those of history.csv by which the best state is chosen."""
    with (folder / "history.csv").open(newline="") as file:
        return [float(row[column]) for row in csv.DictReader(file)]


Progress = Callable[[str, int, int, float], None]


def interrupting(phase: str, at: int) -> Callable[[str], object]:
    """A stand-in for the progress bar: Ctrl-C at a step of a phase."""

    @contextmanager
    def progress(name: str) -> Iterator[Progress]:
        def update(now: str, step: int, total: int, loss: float) -> None:
            if (now, step) == (phase, at):
                raise KeyboardInterrupt

        yield update

    return progress


PHASES = {
    "adam": ["optimizer.adam.steps=40", "optimizer.lbfgs.steps=0", "optimizer.levenberg_marquardt.steps=5"],
    "lbfgs": ["optimizer.adam.steps=5", "optimizer.lbfgs.steps=40", "optimizer.levenberg_marquardt.steps=5"],
    "levenberg_marquardt": [
        *("optimizer.adam.steps=5", "optimizer.lbfgs.steps=0"),
        "optimizer.levenberg_marquardt.steps=40",
    ],
}


@pytest.mark.parametrize(("step", "score"), [(1, "held_out_loss"), (4, "held_out_loss"), (4, "loss")])
@pytest.mark.parametrize("phase", PHASES)
def test_ctrl_c_in_any_phase_keeps_the_best_state(
    phase: str,
    step: int,
    score: str,
    run: Run,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """Exit code 130, a sentence, and a complete model: the best of all steps until then."""
    config = compose_config([*COARSE, *PHASES[phase], *["training.holdout_every=0"] * (score == "loss")])
    monkeypatch.setattr(train, "training_progress", interrupting(phase, step))
    with pytest.raises(SystemExit, match=r"^130$"):
        run("train", config, tmp_path / "x")
    assert "interrupted: the best state so far was kept" in capsys.readouterr().out
    assert names_in(tmp_path / "x") == DATA | ANSWER
    told = strict_json(tmp_path / "x" / "training.json")
    assert told["outcome"] == "interrupted"
    assert told[score] <= min(losses(tmp_path / "x", score)) * (1 + 1e-12)  # each bearing at its own best step
    assert 0 <= len(losses(tmp_path / "x", score)) - told["steps"] <= 1  # the last one was not finished
    assert np.isfinite(load_model(tmp_path / "x").values(np.array([100.0, 200.0]))).all()


def test_a_run_that_was_interrupted_is_the_start_of_a_longer_one(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The steps before Ctrl-C are those of the uninterrupted training, to the last bit."""
    config = compose_config([*COARSE, *PHASES["adam"]])
    run("train", config, tmp_path / "whole")
    monkeypatch.setattr(train, "training_progress", interrupting("adam", 20))
    with pytest.raises(SystemExit):
        run("train", config, tmp_path / "cut")
    cut = losses(tmp_path / "cut")
    assert 20 <= len(cut) <= 21  # the start is a row of its own
    assert cut == losses(tmp_path / "whole")[: len(cut)]


@pytest.mark.parametrize("stage", ["evaluate", "predict"])
def test_ctrl_c_in_a_training_that_another_stage_needs(
    stage: str, run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The stage that asked for it does not go on: 130, the model is kept, no metrics are written."""
    config = compose_config([*COARSE, *PHASES["adam"]])
    monkeypatch.setattr(train, "training_progress", interrupting("adam", 3))
    with pytest.raises(SystemExit, match=r"^130$"):
        run(stage, config, tmp_path / "x")
    assert names_in(tmp_path / "x") == DATA | ANSWER
    monkeypatch.undo()
    run(stage, config, tmp_path / "x")  # what was kept can be used
    assert names_in(tmp_path / "x") > DATA | ANSWER


def test_ctrl_c_in_robustness(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    config = compose_config([*COARSE, *PHASES["adam"]])
    monkeypatch.setattr(robustness, "training_progress", interrupting("adam", 6))
    with pytest.raises(SystemExit, match=r"^130$"):
        run("robustness", config, tmp_path / "x")
    assert "3 interrupted" in capsys.readouterr().out
    assert json.loads((tmp_path / "x" / "robustness.json").read_text())["outcomes"] == {"interrupted": 3}
    assert {"robustness.json", "robustness.csv", "figures"} <= names_in(tmp_path / "x")


def test_ctrl_c_before_training_leaves_nothing(run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """While data are read there is no state to keep: the interrupt passes, and no answer is written."""
    monkeypatch.setattr(train, "prepare", Mock(side_effect=KeyboardInterrupt))
    with pytest.raises(KeyboardInterrupt):
        run("train", compose_config(COARSE), tmp_path / "x")
    assert names_in(tmp_path / "x") == set()


@pytest.mark.parametrize("nth", range(1, 6))
def test_ctrl_c_while_saving_leaves_no_half_file(
    nth: int, run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """An impatient second Ctrl-C stops between two files, never in one; nothing temporary stays."""
    config = compose_config([*COARSE, *PHASES["adam"]])
    run("generate", config, tmp_path / "x")
    effects = [DEFAULT] * (nth - 1) + [KeyboardInterrupt]
    monkeypatch.setattr(os, "replace", Mock(wraps=os.replace, side_effect=effects))
    with pytest.raises(KeyboardInterrupt):
        run("train", config, tmp_path / "x")
    written = names_in(tmp_path / "x") - DATA
    assert len(written) <= nth
    assert written <= ANSWER


def command(folder: Path, *overrides: str) -> list[str]:
    return [*PYTHON, "-m", "pipeline", *COARSE, "stage=train", f"output='{folder}'", *overrides]


class Terminal:
    """A process on a terminal of its own, where Ctrl-C is typed."""

    def __init__(self, command: list[str], cwd: Path) -> None:
        self.said = ""
        self.process, self.terminal = pty.fork()
        if not self.process:
            # A shell's background job hands down an ignored SIGINT.
            signal.signal(signal.SIGINT, signal.SIG_DFL)
            os.chdir(cwd)
            os.execve(command[0], command, ENVIRONMENT)

    def read_until(self, words: str, seconds: float) -> None:
        """Read what it says until it says ``words``."""
        end = time.monotonic() + seconds
        while words not in self.said and time.monotonic() < end:
            if select.select([self.terminal], [], [], 0.2)[0]:
                try:
                    self.said += os.read(self.terminal, 65536).decode(errors="replace")
                except OSError:  # it has ended
                    break
        assert words in self.said, self.said[-2000:]

    def press_ctrl_c(self) -> None:
        """The character that the terminal turns into SIGINT."""
        os.write(self.terminal, b"\x03")

    def end(self, seconds: float) -> int:
        """The exit code; killed where it does not end in time."""
        finish = time.monotonic() + seconds
        while time.monotonic() < finish:
            if select.select([self.terminal], [], [], 0.1)[0]:
                with suppress(OSError):
                    self.said += os.read(self.terminal, 65536).decode(errors="replace")
            done, status = os.waitpid(self.process, os.WNOHANG)
            if done:
                os.close(self.terminal)
                return os.waitstatus_to_exitcode(status)
        os.kill(self.process, signal.SIGKILL)
        os.waitpid(self.process, 0)
        os.close(self.terminal)
        raise AssertionError(f"it did not end: {self.said[-2000:]}")


def test_ctrl_c_on_a_terminal(run: Run, tmp_path: Path) -> None:
    """Typed while the progress bar runs: 130, a sentence, no traceback, files that evaluate can use."""
    terminal = Terminal(command(tmp_path / "x", *LONG), tmp_path)
    terminal.read_until("steps/s", 90)
    assert "loss" in terminal.said
    time.sleep(0.5)
    terminal.press_ctrl_c()
    assert terminal.end(30) == 130
    assert "interrupted: the best state so far was kept" in terminal.said
    assert "Traceback" not in terminal.said
    assert names_in(tmp_path / "x") == DATA | ANSWER
    told = strict_json(tmp_path / "x" / "training.json")
    assert told["outcome"] == "interrupted"
    assert told["held_out_loss"] <= min(losses(tmp_path / "x")) * (1 + 1e-12)  # each bearing at its own best step
    run("evaluate", compose_config([*COARSE, *LONG]), tmp_path / "x")
    assert "metrics.json" in names_in(tmp_path / "x")
    assert names_in(tmp_path) == {"x"}  # nothing beside its folder


WRITER = """
import sys, time
from pathlib import Path
from pipeline.files import write_json
end = time.monotonic() + float(sys.argv[2])
while time.monotonic() < end:
    write_json(Path(sys.argv[1]), {"letters": sys.argv[3] * 20_000})
"""


def test_two_processes_that_write_one_file(tmp_path: Path) -> None:
    """A reader sees the file of one writer or of the other, always whole; nothing temporary stays."""
    path = tmp_path / "x.json"
    writers = [
        subprocess.Popen([sys.executable, "-c", WRITER, str(path), "0.7", letter], env=ENVIRONMENT) for letter in "ab"
    ]
    seen = set()
    while any(writer.poll() is None for writer in writers):
        if path.exists():
            letters = json.loads(path.read_text())["letters"]
            assert letters == letters[0] * 20_000
            seen.add(letters[0])
    assert [writer.returncode for writer in writers] == [0, 0]
    assert seen == {"a", "b"}
    assert names_in(tmp_path) == {"x.json"}
