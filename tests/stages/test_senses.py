"""stage=senses writes every sense and the sentence."""

from __future__ import annotations

from pathlib import Path

import pytest
from conftest import Run
from running import FEW_SPEEDS, composed, strict_json
from small_rotor import FITTED


@pytest.mark.slow
def test_the_stage_writes_every_sense_and_the_sentence(run: Run, tmp_path: Path) -> None:
    """Modelled data are written as the program reads them, with all weights at one angle."""
    run("senses", composed(*FITTED, *FEW_SPEEDS, "machine.speeds.step_rpm=1000"), tmp_path)
    found = strict_json(tmp_path / "senses.json")
    assert len(found["senses"]) == 8
    flags = ("phase_as_lag", "weights_against_rotation", "rotation_from_y_to_x")
    (written,) = [one for one in found["senses"] if not any(one[flag] for flag in flags)]
    assert not written["told_from_the_best"]
    assert "the data" in found["sentence"]
