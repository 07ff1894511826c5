"""Modelled coefficients at operating conditions that no run has."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from conftest import Run

from pipeline.config.compose import compose_config
from pipeline.errors import ConfigError
from pipeline.evaluation.errors import measure_unmeasured, model_unmeasured
from pipeline.units import RAD_S_PER_RPM

OIL = ("machine=compressor_oil_temperatures", "model=law", "loss=response", "robustness=refits")
SPEEDS = np.tile([1000.0, 2000.0], 3) * RAD_S_PER_RPM
EIGHT = ("kxx", "kxy", "kyx", "kyy", "cxx", "cxy", "cyx", "cyy")


def test_each_speed_once_at_each_condition() -> None:
    table = model_unmeasured(compose_config([*OIL, "machine.unmeasured.oil_temperature=[70 degC,40 degC]"]), SPEEDS)
    np.testing.assert_allclose(table.operating["oil_temperature"] - 273.15, [40, 40, 70, 70])
    np.testing.assert_allclose(table.speeds, np.tile(SPEEDS[:2], 2))
    wrong = replace(table, values=table.values * np.array([1.01, 1.01, 1.03, 1.03])[:, None])
    found = measure_unmeasured(wrong, table, [EIGHT, EIGHT])
    assert list(found) == ["40 degC", "70 degC"]
    assert found["40 degC"]["8"]["kxx"]["median_error_percent"] == pytest.approx(1.0)
    assert found["70 degC"]["21"]["cyy"]["median_error_percent"] == pytest.approx(3.0)


def test_nothing_is_asked_for() -> None:
    assert model_unmeasured(compose_config([*OIL, "machine.unmeasured=null"]), SPEEDS) is None


def test_a_condition_without_its_unit() -> None:
    with pytest.raises(ConfigError, match=r"machine\.unmeasured.*must carry its unit"):
        compose_config([*OIL, "machine.unmeasured.oil_temperature=[40,70]"])


@pytest.mark.slow
def test_refits_tell_errors_at_conditions_that_no_run_has(run: Run, tmp_path: Path) -> None:
    """Of each coefficient, and of all: the median over coefficients of the typical data set."""
    few = ("machine.speeds.step_rpm=340", "robustness.count=2", "robustness.workers=1", "tracking=none")
    run("robustness", compose_config(["experiment=oil_temperatures", *few]), tmp_path / "x")
    told = json.loads((tmp_path / "x" / "robustness.json").read_text())
    assert list(told["unmeasured"]) == list(told["all_unmeasured"]) == ["40 degC", "70 degC"]
    for words, bearings in told["unmeasured"].items():
        every = [of["median_error_percent"] for names in bearings.values() for of in names.values()]
        assert len(every) == 16
        assert told["all_unmeasured"][words]["median_error_percent"] == pytest.approx(np.median(every))
        assert max(every) < 1.0
