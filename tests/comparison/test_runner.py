"""The comparison: its files, in processes, resumed, damaged; means and wins of its summary."""

from __future__ import annotations

import json
import os
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pandas as pd
import pytest
from comparing import machine
from conftest import Artifacts

from pipeline.__main__ import main
from pipeline.comparison import runner
from pipeline.comparison.cases import Case, Machine, Result
from pipeline.comparison.runner import compare, hash_inputs, name_file
from pipeline.config.compose import compose_config
from pipeline.errors import PipelineError
from pipeline.reporting.comparison import Comparison, format_noise

FEW_CASES = ("experiment=hydrostatic_stiffness", "machine.speeds.step_rpm=500")
FAST = [
    "comparison.methods=[least_squares,kalman,multi_frequency]",
    "comparison.noise=[0,0.01]",
    "comparison.sensors=[bearings,location]",
    "comparison.speeds=[4,12]",
    "comparison.data_sets=2",
]
WRITTEN = {"comparison.csv", "comparison.json", "comparison.md", "figures/comparison.png", "log.txt"}


def setup_of(**changed: Any) -> Machine:
    """A comparison at few speeds."""
    few = machine(*FEW_CASES)
    return replace(few, settings=few.settings.model_copy(update=changed))


RUNS = [("least_squares", Case(noise, "bearings", 12)) for noise in (0.0, 0.001, 0.01)]


def nothing(done: int, total: int, result: Result) -> None:
    """No bar."""


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small comparison, as the command makes it."""
    folder = tmp_path_factory.mktemp("a comparison") / "x"
    assert main(["stage=compare", *FEW_CASES, *FAST, f"output={folder}", "tracking=none", "comparison.workers=1"]) == 0
    return folder


@pytest.mark.slow
def test_the_stage_writes_tables_numbers_and_a_figure(made: Path) -> None:
    assert {str(p.relative_to(made)) for p in made.rglob("*.*") if p.parent.name != "comparison"} == WRITTEN
    columns = set(pd.read_csv(made / "comparison.csv"))
    assert {"median_error_percent", "within_interval_percent", "seconds"} <= columns
    summary = json.loads((made / "comparison.json").read_text())
    assert summary["methods"]["kalman"]["median_error_percent"]["location"]["0_percent"] < 1e-8
    assert "| per-speed least squares |" in (made / "comparison.md").read_text()


@pytest.mark.slow
def test_what_a_method_cannot_do_is_a_row_with_its_name(made: Path) -> None:
    rows = pd.read_csv(made / "comparison.csv")
    silent = rows[rows["coefficient"].isna()]
    found = set(zip(silent["method"], silent["sensors"], silent["outcome"], strict=True))
    assert ("least_squares", "location", "bearings_not_measured") in found
    assert ("multi_frequency", "bearings", "one_frequency") in found
    assert "bearings not measured" in (made / "comparison.md").read_text()


def test_what_is_done_is_not_done_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    own = setup_of(workers=1)
    with pytest.raises(KeyboardInterrupt):
        compare(own, RUNS, tmp_path, Mock(side_effect=[None, KeyboardInterrupt]))
    judge = Mock(wraps=runner.judge_method)
    monkeypatch.setattr(runner, "judge_method", judge)
    results = compare(own, RUNS, tmp_path, nothing)
    assert [r.case for r in results] == [case for _, case in RUNS]
    assert compare(own, RUNS, tmp_path, nothing) == results
    assert [item for _, item in (call.args for call in judge.call_args_list)] == RUNS[2:]


@pytest.mark.parametrize("damage", ["{", '{"fingerprint": "0"}', "[]", '{"fingerprint": "0", "result": {}}'])
def test_a_damaged_or_old_result_is_made_again(damage: str, tmp_path: Path) -> None:
    own = setup_of(workers=1)
    first = compare(own, RUNS[:1], tmp_path, nothing)
    path = tmp_path / name_file(*RUNS[0])
    path.write_text(damage)
    assert compare(own, RUNS[:1], tmp_path, nothing)[0].coefficients == first[0].coefficients
    assert json.loads(path.read_text())["fingerprint"] == hash_inputs(own)


def test_results_are_of_their_settings_alone() -> None:
    """Other methods and cases leave the others' results; another guess, noise or machine does not."""
    own = setup_of()
    assert hash_inputs(setup_of(workers=7, methods=("kalman",), noise=(0.5,))) == hash_inputs(own)
    others = (setup_of(location=2), replace(own, seed=1), replace(own, noise_seed=1))
    assert hash_inputs(own) not in map(hash_inputs, others)


@pytest.mark.slow
def test_processes_give_the_bits_of_one(tmp_path: Path) -> None:
    """What is sent to them is all that a result follows from."""
    one, two = (compare(setup_of(workers=n), RUNS, tmp_path / str(n), nothing) for n in (1, 2))
    assert [r.coefficients for r in one] == [r.coefficients for r in two]


def killed(*_: object) -> Result:
    """What the operating system does to a process where the memory is spent."""
    os._exit(1)


@pytest.mark.slow
def test_a_killed_process_is_said_in_words(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(runner, "judge_method", killed)
    with pytest.raises(PipelineError, match=r"run the same command again, with comparison\.workers=1"):
        compare(setup_of(workers=2), RUNS, tmp_path, nothing)


def row(method: str, noise: float, error: float | None, data_set: int = 0, **changed: Any) -> Result:
    """A result with one coefficient, or without an answer."""
    kxx = {"median_error": error, "p95_error": error, "median_deviation": None, "within_interval": None}
    plain = {
        "method": method,
        "case": Case(noise, "bearings", 10, data_set),
        "outcome": "answered" if error is not None else "one_frequency",
        "words": "",
        "doubt": "",
        "seconds": 1.0,
        "coefficients": {} if error is None else {"1": {"kxx": kxx}},
    }
    return Result.model_validate(plain | changed)


def test_the_summary_takes_means_over_data_sets_and_names_refusals() -> None:
    main_one = Case(0.01, "bearings", 10)
    rows = (
        row("response", 0.01, 1.0),
        row("response", 0.01, 3.0, data_set=1),
        row("spline", 0.01, 4.0),
        row("kriging", 0.01, 0.5, doubt="chi-square"),
        row("multi_frequency", 0.01, None),
        row("response", 0.0, 0.1),
    )
    made = Comparison(rows, main_one, ("kxx",))
    assert (made.error("response", main_one), made.cell("multi_frequency", main_one)) == (2.0, "one frequency")
    assert made.cell("kriging", main_one) == "0.5 ?"
    assert made.best_other("response", main_one, "kxx") == ("kriging", 4.0)
    assert [format_noise(case.noise) for case in made.along("noise")] == ["0 %", "1 %"]
    assert made.outcomes() == {"multi_frequency": {"one_frequency": ""}}


@pytest.mark.slow
def test_impulses_give_all_coefficients_and_the_unbalance(artifacts: Artifacts) -> None:
    """The experiment as committed: every coefficient within 0.8 % (median), the unbalance within half a percent."""
    config = compose_config(["experiment=impulses", "tracking=none"])
    metrics = artifacts.read("impulses", "metrics")["coefficients"]
    assert max(of["median_error_percent"] for found in metrics.values() for of in found.values()) < 0.8
    table = artifacts("impulses", "residual_unbalance.csv") / "residual_unbalance.csv"
    found = pd.read_csv(table).set_index("node")["magnitude"]
    hidden = {one.node: one.magnitude for one in config.machine.residual_unbalance}
    assert all(abs(found[node] / size - 1) < 0.005 for node, size in hidden.items())


def test_a_win_is_one_beyond_the_spread_of_the_paired_differences() -> None:
    """Errors that vary together are told apart by a small steady difference; those that vary alone are not."""
    case, common = Case(0.01, "bearings", 10), [1.0, 2.0, 3.0, 4.0]
    errors = {
        "response": common,
        "spline": [error + 0.2 + 0.01 * i for i, error in enumerate(common)],
        "smoothed": [4.5, 1.0, 4.0, 1.5],
        "kriging": [5.0, None, 5.0, 5.0],
    }
    rows = [row(m, 0.01, error, data_set=i) for m, of in errors.items() for i, error in enumerate(of)]
    made = Comparison((*rows, row("tikhonov", 0.01, 0.5)), case, ("kxx",))
    assert made.level_with_best(case) == {"response", "smoothed"}
    assert made.differs("spline", "response", case)
    cells = {
        "response": "**2.5 ± 1**",
        "spline": "2.7 ± 1",
        "kriging": "5 ± 0 (3 of 4 answer)",
        "tikhonov": "0.5",  # one data set tells nothing
    }
    assert {method: made.cell(method, case) for method in cells} == cells
    assert made.label("tikhonov", [case]).endswith("(1 data set)")
