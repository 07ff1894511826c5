"""Tables, and progress of long steps, as a bar and as lines of a file."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from pipeline.reporting.console import count_progress, log_steps, table, training_progress


def test_the_steps_of_a_bar_are_lines_of_a_log(tmp_path: Path) -> None:
    """Also where nobody sees the bar; a log goes on where another command left it, and without a step there is none."""
    folder = tmp_path / "new"
    with log_steps(folder):
        pass
    assert not folder.exists()
    for _ in range(2):
        with log_steps(folder), count_progress("study", 3) as show, training_progress("rig") as progress:
            show(1, "trials")
            for step in range(1, 401):
                progress("adam", step, 400, 0.5 / step)
    lines = (folder / "log.txt").read_text().splitlines()
    assert [line.partition(" study: ")[2] for line in lines[::3]] == ["1 of 3 trials"] * 2
    assert (lines[2].partition(" rig ")[2], len(lines)) == ("adam: step 400 of 400, loss 0.00125", 6)
    assert all(re.match(r"\d{4}-\d\d-\d\d \d\d:\d\d:\d\d", line) for line in lines)


def test_a_long_reason_takes_no_room_from_the_other_columns(capsys: pytest.CaptureFixture[str]) -> None:
    table("can it be trusted?", ["coefficient", "verdict", "why"], [["node 1 kxx", "with care", 60 * "reason "]])
    shown = capsys.readouterr().out
    assert (len(re.findall("node 1 kxx +with care +reason", shown)), shown.count("reason")) == (1, 60)
