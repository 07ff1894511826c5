"""What is held out of a training: speeds, and conditions by their values."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.config.identification import TrainingConfig
from pipeline.errors import ConfigError
from pipeline.identification.held_out import held_out_conditions, held_out_speeds

OPERATING = {"oil_temperature": np.array([318.15, 318.15, 338.15])}


def training(**held_out: float) -> TrainingConfig:
    return TrainingConfig(holdout_every=0, tolerance=1e-6, holdout_operating=held_out)


def test_conditions_are_held_out_by_their_values() -> None:
    assert held_out_conditions(OPERATING, training(oil_temperature=338.15), 3).tolist() == [False, False, True]
    assert not held_out_conditions(OPERATING, training(), 3).any()


@pytest.mark.parametrize(
    ("held_out", "words"),
    [
        ({"load": 500.0}, "must name conditions of the data"),
        ({"oil_temperature": 300.0}, "45 degC, 65 degC"),
        ({"oil_temperature": 318.0}, "leave points"),
    ],
)
def test_held_out_conditions_must_be_measured_and_leave_others(held_out: dict[str, float], words: str) -> None:
    operating = {name: values[:2] for name, values in OPERATING.items()} if "leave" in words else OPERATING
    with pytest.raises(ConfigError, match=words):
        held_out_conditions(operating, training(**held_out), len(operating["oil_temperature"]))


@pytest.mark.usefixtures("one_thread")
@given(count=st.integers(1, 700), every=st.one_of(st.just(0), st.integers(2, 800)))
def test_held_out_speeds(count: int, every: int) -> None:
    """Every k-th speed, never the first and the last; at least half of the speeds are trained on."""
    mask = held_out_speeds(count, every)
    assert mask.shape == (count,)
    assert mask.sum() <= count / 2
    assert not mask[[0, -1]].any()
    assert (np.diff(np.flatnonzero(mask)) == every).all()
    if every and count > every + 1:
        assert abs(mask.sum() - count / every) <= 1
