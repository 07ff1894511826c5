"""What asks for records, weights or a run-up, on machines that have none: each is one sentence that names it."""

from __future__ import annotations

from pathlib import Path

import pytest
from conftest import refused
from running import FEW_SPEEDS, composed

from pipeline.errors import ConfigError, IdentifiabilityError, PipelineError
from pipeline.stages import run_stage

pytestmark = pytest.mark.slow
MISTAKES: dict[str, tuple[str, tuple[str, ...], type[PipelineError], str]] = {
    "balance of one run": ("balance", (), IdentifiabilityError, "add a trial weight in each plane alone"),
    "balance of records": ("balance", ("balance.records=given.csv",), PipelineError, "balance.records must be"),
    "predict of records": ("predict", ("predict.records=given.csv",), PipelineError, "predict.records must be"),
    "runup": ("runup", (), ConfigError, "machine.run_up is missing"),
    "senses of another loss": ("senses", (), ConfigError, "must have loss=response"),
}


@pytest.mark.parametrize("what", MISTAKES)
def test_a_stage_that_the_machine_has_nothing_for(what: str, tmp_path: Path) -> None:
    stage, overrides, kind, words = MISTAKES[what]
    given = ("experiment=ball_bearing", "tracking=none", *FEW_SPEEDS, f"output={tmp_path}", f"stage={stage}")
    with refused(words, kind=kind):
        run_stage(composed(*given, *overrides))
