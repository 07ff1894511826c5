"""The verdict on each coefficient: limits, words, and that the deviation foretold is the one of the fit."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from conftest import Run

from pipeline.coefficients import COEFFICIENTS
from pipeline.problem.determination import (
    WEAKLY_BELOW,
    WELL_BELOW,
    Determined,
    Verdict,
    describe_determined,
    judge_determined,
    read_determined,
    summarize_determined,
)
from pipeline.rotor.bearing_table import BearingTable
from pipeline.units import RAD_S_PER_RPM


@pytest.mark.parametrize(
    ("deviation", "verdict"),
    [
        (0.99 * WELL_BELOW, Verdict.GOOD),
        (WELL_BELOW, Verdict.WITH_CARE),
        (0.99 * WEAKLY_BELOW, Verdict.WITH_CARE),
        (WEAKLY_BELOW, Verdict.NO),
        (np.inf, Verdict.NO),
        (np.nan, Verdict.NO),
    ],
)
def test_the_limits(deviation: float, verdict: Verdict) -> None:
    assert Determined(1, "kxx", deviation).verdict is verdict


def judged() -> tuple[Determined, ...]:
    """kxx well but for a quarter of the speeds, kyy without limit, of one bearing at four speeds."""
    values = np.full((1, 4, 8), 2.0)
    values[0, 0, 0] = 0.0
    deviation = np.full((1, 4, 8), np.nan)
    deviation[0, :, COEFFICIENTS.index("kxx")] = 0.02
    deviation[0, :, COEFFICIENTS.index("kyy")] = np.inf
    return judge_determined(
        BearingTable((3,), np.arange(10.0, 50.0, 10.0) * RAD_S_PER_RPM, values, deviation=deviation)
    )


def test_a_median_over_the_speeds_and_where_it_does_not_hold() -> None:
    """What is not identified gets no verdict; a coefficient of zero is not known in percent of itself."""
    first = Determined(3, "kxx", 0.01, 0.25, "below 20 rpm")
    assert judged() == (first, Determined(3, "kyy", np.inf, 1.0, "at 100 % of the speeds"))
    said = describe_determined(judged())
    assert said == "kxx well determined (+- 1 %); kyy not determined (no limit); kxx not below 20 rpm"


def test_the_summary_is_json_and_is_read_back() -> None:
    written = json.loads(json.dumps(summarize_determined(judged()), allow_nan=False))
    assert written["3"]["kyy"]["deviation_percent"] is None
    assert tuple(read_determined(written)) == judged()


FEW = ["machine.speeds.start_rpm=500", "machine.speeds.stop_rpm=5500", "machine.speeds.step_rpm=100"]


@pytest.mark.slow
def test_the_fit_ends_at_the_deviations_that_were_foretold(
    run: Run, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Before the fit, as smooth functions; after it, its own. Each speed by itself would have said several times more,
    and a number of the model that is not known widens both.
    """
    told: dict[str, dict[str, tuple[float, float]]] = {}
    for name, more in (("stated", []), ("not_known", ["identify.model_parameters.unbalance_magnitude=0.1"])):
        folder = tmp_path / name
        for stage in ("diagnose", "train"):
            run(stage, ["experiment=noisy_direct", *FEW, *more], folder)
        before = json.loads((folder / "diagnosis.json").read_text())
        after = json.loads((folder / "training.json").read_text())["determined"]
        assert before["determined"]["by"] == "smooth functions over all speeds"
        assert after["by"] == "by this fit at 1 % noise"
        told[name] = {}
        for node, own in after["coefficients"].items():
            for coefficient, of in own.items():
                foretold = before["determined"]["coefficients"][node][coefficient]["deviation_percent"]
                alone = before["bearings"][node]["median_deviation_percent"][coefficient]
                assert 0.4 < of["deviation_percent"] / foretold < 1.3
                assert alone > 2 * foretold or name == "not_known"
                told[name][f"{coefficient} {node}"] = (foretold, of["deviation_percent"])
    for key in ("cxx 1", "cyy 1", "cxx 5", "cyy 5"):  # damping goes with the weights' sizes
        (foretold, found), (wider, found_wider) = told["stated"][key], told["not_known"][key]
        assert wider > 1.4 * foretold
        assert found_wider > 1.4 * found
    assert "at 1 % noise, smooth functions over all speeds: all well determined" in capsys.readouterr().out
    assert set(pd.read_csv(tmp_path / "stated" / "diagnosis.csv")["kxx_verdict"]) == {"well determined"}
