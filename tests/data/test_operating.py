"""Which operating points make one line over the speed, and what it is called."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.data.operating import split_states, write_condition


def test_points_without_conditions_make_one_line_without_a_name() -> None:
    ((label, points),) = split_states(np.array([10.0, 20.0, 30.0]), {})
    assert label == ""
    assert points.tolist() == [0, 1, 2]


def test_equal_conditions_belong_together_although_a_state_lacks_speeds() -> None:
    speeds = np.array([10.0, 20.0, 30.0, 20.0, 30.0, 40.0])
    kelvin = np.array([318.15] * 3 + [338.15] * 3)
    load = np.array([500.0] * 3 + [750.0] * 3)
    states = split_states(speeds, {"oil_temperature": kelvin, "load": load})
    assert [label for label, _ in states] == ["45 degC, 500 N", "65 degC, 750 N"]
    assert [points.tolist() for _, points in states] == [[0, 1, 2], [3, 4, 5]]


def test_a_run_up_whose_oil_warms_is_one_line_by_ascending_speed() -> None:
    kelvin = np.array([318.15, 319.0, 320.15, 325.15])
    ((label, points),) = split_states(np.array([10.0, 30.0, 20.0, 40.0]), {"oil_temperature": kelvin})
    assert label == "45 to 52 degC"
    assert points.tolist() == [0, 2, 1, 3]


def test_temperatures_that_waver_about_two_states_make_two_lines() -> None:
    speeds = np.array([10.0, 20.0, 30.0, 10.0, 20.0, 30.0])
    celsius = np.array([44.9, 45.0, 45.1, 64.8, 65.0, 65.2])
    states = split_states(speeds, {"oil_temperature": celsius + 273.15})
    assert [points.tolist() for _, points in states] == [[0, 1, 2], [3, 4, 5]]
    assert states[1][0] == "64.8 to 65.2 degC"


@pytest.mark.parametrize("seed", range(5))
def test_no_line_has_a_speed_twice_and_every_point_is_on_one(seed: int) -> None:
    generator = np.random.default_rng(seed)
    speeds = generator.integers(1, 6, 40).astype(float)
    states = split_states(speeds, {"oil_temperature": generator.uniform(310, 340, 40), "load": np.full(40, 500.0)})
    assert sorted(np.concatenate([points for _, points in states]).tolist()) == list(range(40))
    assert all((np.diff(speeds[points]) > 0).all() for _, points in states)


@pytest.mark.parametrize(
    ("name", "value", "written"),
    [
        ("oil_supply_pressure", 1.5e5, "1.5 bar"),
        ("static_load", 893.0, "893 N"),
        ("humidity", np.array([0.25, 0.25]), "humidity 25 %"),
        ("preheat_degC", 300.15, "preheat 27 degC"),
        ("torque", 3.0, "torque 3 N*m"),
    ],
)
def test_conditions_are_written_in_the_units_of_an_engineer(name: str, value: float | np.ndarray, written: str) -> None:
    assert write_condition(name, value) == written
