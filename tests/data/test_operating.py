"""Which operating points are joined, which make one line over the speed, and what it is called."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.data.operating import join, split_states, write_condition


@pytest.mark.parametrize(
    ("speeds", "conditions", "lines"),
    [
        ([10.0, 20.0, 30.0], {}, {"": [0, 1, 2]}),
        (
            [10.0, 20.0, 30.0, 20.0, 30.0, 40.0],
            {"oil_temperature": [318.15] * 3 + [338.15] * 3, "load": [500.0] * 3 + [750.0] * 3},
            {"45 degC, 500 N": [0, 1, 2], "65 degC, 750 N": [3, 4, 5]},
        ),
        (
            [10.0, 30.0, 20.0, 40.0],
            {"oil_temperature": [318.15, 319.0, 320.15, 325.15]},
            {"45 to 52 degC": [0, 2, 1, 3]},
        ),
        (
            [10.0, 20.0, 30.0, 10.0, 20.0, 30.0],
            {"oil_temperature": [318.05, 318.15, 318.25, 337.95, 338.15, 338.35]},
            {"44.9 to 45.1 degC": [0, 1, 2], "64.8 to 65.2 degC": [3, 4, 5]},
        ),
    ],
    ids=["no conditions", "two states, one lacks speeds", "a run-up whose oil warms", "two that waver"],
)
def test_points_of_one_state_make_one_line_by_ascending_speed(
    speeds: list[float], conditions: dict[str, list[float]], lines: dict[str, list[int]]
) -> None:
    states = split_states(np.array(speeds), {name: np.array(values) for name, values in conditions.items()})
    assert [(label, points.tolist()) for label, points in states] == list(lines.items())


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


@given(
    values=st.lists(st.floats(300, 310).map(lambda v: round(v, 3)), min_size=1, max_size=30),
    within=st.sampled_from([0.0, 0.1, 0.5, 3.0, 20.0]),
)
def test_joined_values_move_by_no_more_than_the_tolerance_and_keep_their_order(
    values: list[float], within: float
) -> None:
    given_values = np.array(values)
    found = join(given_values, within)
    assert np.abs(found - given_values).max() <= within + 1e-9
    for mean in np.unique(found):
        group = given_values[found == mean]
        assert np.ptp(group) <= within + 1e-9
        assert mean == pytest.approx(np.unique(group).mean(), abs=1e-9)
    assert (np.diff(found[np.argsort(given_values)]) >= 0).all()
