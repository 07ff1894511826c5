"""stage=compare: interrupted, with a mistake, and on other machines."""

from __future__ import annotations

from pathlib import Path
from unittest.mock import Mock

import pytest
from comparison.test_runner import FAST, FEW_CASES, nothing

from pipeline.__main__ import main
from pipeline.comparison.cases import Case
from pipeline.comparison.runner import compare
from pipeline.config.compose import compose_config
from pipeline.methods.catalogue import METHODS
from pipeline.methods.method import REQUIREMENTS
from pipeline.stages.compare import build_machine


@pytest.mark.slow
def test_an_interrupted_stage_says_how_to_go_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("pipeline.stages.compare.compare", Mock(side_effect=KeyboardInterrupt))
    assert main(["stage=compare", *FEW_CASES, *FAST, f"output={tmp_path}", "tracking=none"]) == 130
    assert "no finished result is lost" in capsys.readouterr().err


@pytest.mark.slow
@pytest.mark.parametrize(
    ("given", "words"),
    [
        ("comparison.methods=[krigging]", "kriging"),
        ("comparison.methods=[kalman,kalman]", "once"),
        ("comparison.noise=[2]", "less than 1"),
        ("comparison.location=99", "nodes 0 to 6"),
        ("comparison.prior.lowest_stiffness=1e10 N/m", "lowest_stiffness < highest_stiffness"),
        ("comparison.response.loss.kind=residual", "must have loss=response"),
        ("experiment=measured_demo", "modelled machine"),
    ],
)
def test_a_mistake_is_said_in_a_sentence(
    given: str, words: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["stage=compare", *FEW_CASES, given, f"output={tmp_path}", "tracking=none"]) == 2
    said = capsys.readouterr().err
    assert words in said, said
    assert "Traceback" not in said


OTHERS = ["compressor_journal_and_isotropic", pytest.param("compressor_two_journals", marks=pytest.mark.nightly)]


FIVE_SPEEDS = [f"machine.speeds.{key}" for key in ("start_rpm=800", "stop_rpm=4000", "step_rpm=800")]


FEW_STEPS = [
    "comparison.paper.optimizer.adam.steps=20",
    *(
        f"comparison.{loss}.optimizer.levenberg_marquardt.steps=20"
        for loss in ("residual", "preconditioned", "response", "trained")
    ),
]


@pytest.mark.slow
@pytest.mark.parametrize("experiment", OTHERS)
def test_every_method_says_something_of_other_machines(experiment: str, tmp_path: Path) -> None:
    own = build_machine(compose_config([f"experiment={experiment}", *FIVE_SPEEDS, *FEW_STEPS, "comparison.workers=1"]))
    items = [(method, Case(0.01, where, 5)) for where in ("bearings", "location") for method in METHODS]
    results = compare(own, items, tmp_path, nothing)
    assert {result.outcome for result in results} <= {"answered", *REQUIREMENTS}
    for result in results:
        assert result.answered == bool(result.coefficients)
        assert result.answered or result.words
