"""Errors of the numbers of bearing laws, and of coefficients at operating conditions that no run has."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from conftest import Run

from pipeline.config.compose import compose_config
from pipeline.errors import ConfigError
from pipeline.evaluation.errors import find_true_numbers, measure_numbers, measure_unmeasured, model_unmeasured
from pipeline.units import RAD_S_PER_RPM

OIL = ("machine=compressor_oil_temperatures", "model=law", "loss=response", "robustness=refits")


def test_true_numbers_are_those_of_the_modelled_bearings() -> None:
    true = find_true_numbers(compose_config(OIL).machine)
    modelled = {
        "8.radial_clearance": 0.1e-3,
        "21.radial_clearance": 0.085e-3,
        "21.static_load": 45,
        "oil.viscosity": 27.7e-3 * math.exp(-0.034 * 15),  # given at 40 degC, asked for at the 55 degC of the laws
        "oil.slope": 0.034,
    }
    assert {name: true[name] for name in modelled} == pytest.approx(modelled)


def test_the_load_of_a_ball_bearing_has_another_name_in_the_model() -> None:
    law = "{2: {kind: ball, n_balls: 8, ball_diameter: 30 mm, contact_angle: 30 deg, load: {guess: 300 N, within: 3}}}"
    balls = ("machine=one_disc", "model=law", "loss=response", "robustness=refits", f"+machine.laws.bearings={law}")
    true = find_true_numbers(compose_config(balls).machine)
    assert true["2.load"] == 500
    assert "oil.viscosity" not in true


def test_an_interval_holds_the_true_number_or_not() -> None:
    machine = compose_config(OIL).machine
    pairs = {"8.radial_clearance": (0.102e-3, 0.9e-6), "oil.slope": (0.0342, 0.0002), "oil.b": (900.0, 1.0)}
    errors = measure_numbers({name: {"value": v, "deviation": d} for name, (v, d) in pairs.items()}, machine)
    assert set(errors) == {"8.radial_clearance", "oil.slope"}
    assert errors["8.radial_clearance"]["error_percent"] == pytest.approx(2.0)
    assert (errors["8.radial_clearance"]["within"], errors["oil.slope"]["within"]) == (False, True)


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
