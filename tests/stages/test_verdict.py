"""stage=verdict on what `make reproduce` made."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from conftest import Run

from pipeline.data.sensors import NOMINAL_95
from pipeline.errors import ConfigError

ARTIFACTS = Path(__file__).resolve().parents[2] / "artifacts"


def read(experiment: str | Path) -> dict[str, Any]:
    path: Path = ARTIFACTS / experiment / "verdicts.json"
    return json.loads(path.read_text(encoding="utf-8"))


@pytest.mark.slow  # of what `make reproduce` makes
@pytest.mark.parametrize("experiment", ["realistic", "measured_demo"])
def test_the_cases_to_judge_by_are_good(experiment: str) -> None:
    found = read(experiment)
    assert found["machine"]["verdict"] == "good"
    assert {one["verdict"] for one in found["verdicts"]} == {"good"}
    assert all(one["next"] is None and one["reasons"] for one in found["verdicts"])


@pytest.mark.slow
@pytest.mark.parametrize("experiment", ["realistic", "measured_demo"])
def test_no_good_coefficient_is_outside_its_band(experiment: str) -> None:
    metrics = json.loads((ARTIFACTS / experiment / "metrics.json").read_text(encoding="utf-8"))["coefficients"]
    for one in read(experiment)["verdicts"]:
        error = metrics[str(one["node"])][one["coefficient"]]["median_error_percent"]
        assert error < one["checks"]["band"]["percent"]


@pytest.mark.slow
def test_a_tolerance_that_nobody_fitted_is_named_with_its_cure(run: Run, tmp_path: Path) -> None:
    """kyy of noisy_direct: one degree of the probes moves it by a tenth."""
    data = [f"data.{name}={ARTIFACTS / 'noisy_direct' / file}" for name, file in FILES.items()]
    asked = ["experiment=noisy_direct", "identify.usual_tolerances=true", "tracking=none", *data]
    for stage in ("train", "verdict"):
        run(stage, asked, tmp_path)
    own = {(one["node"], one["coefficient"]): one for one in read(tmp_path)["verdicts"]}
    assert own[5, "kyy"]["verdict"] == "with care"
    assert "probe angle" in own[5, "kyy"]["reasons"][0]
    assert "identify.model_parameters.probe_angle" in own[5, "kyy"]["next"]
    assert own[1, "cxx"]["verdict"] == "good"


FILES = {"vibration": "vibration.parquet", "excitation": "excitation.csv", "known": "known_coefficients.csv"}


@pytest.mark.slow
def test_a_loss_without_deviations_is_never_good() -> None:
    found = read("ball_bearing")
    assert {one["verdict"] for one in found["verdicts"]} == {"with care"}
    assert "loss=response" in found["machine"]["next"]


@pytest.mark.slow
def test_a_range_where_nothing_holds_the_functions_is_no_bug(run: Run, tmp_path: Path) -> None:
    """The lowest speeds held out at 2 % noise: exponentials overflow there, and nothing else is said of them."""
    asked = [
        *("experiment=realistic", "machine=overhung", "machine.probes.multiplicative=0.02"),
        *("training.holdout_range=[400 rpm,1500 rpm]", "force=true"),
    ]
    for stage in ("train", "verdict", "evaluate"):
        run(stage, asked, tmp_path)
    training = json.loads((tmp_path / "training.json").read_text(encoding="utf-8"))
    assert training["fit"]["held_out_speeds"] == {"mean_square_over_noise": None, "error_percent": None}
    held_out = json.loads((tmp_path / "metrics.json").read_text(encoding="utf-8"))["held_out"]
    assert [entry["model_error_percent"] for entry in held_out.values()] == [None]
    # what the training says of a coefficient the verdict says, too
    for entry in read(tmp_path)["verdicts"]:
        determined = training["determined"]["coefficients"][str(entry["node"])][entry["coefficient"]]
        band, deviation = entry["checks"]["band"]["percent"], determined["deviation_percent"]
        assert band == pytest.approx(deviation and NOMINAL_95 * deviation)
    with pytest.raises(ConfigError, match="leave all bounds"):
        run("predict", asked, tmp_path)
