"""The numbers of bearing laws against those of the modelled machine."""

from __future__ import annotations

import math

import pytest

from pipeline.config.compose import compose_config
from pipeline.evaluation.errors import find_true_numbers, measure_numbers

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
