"""Readings of a run-up: those that agree are averaged, and an identified frequency is held against them."""

from __future__ import annotations

import pytest

from pipeline.sweep.readings import Reading, combine, compare_natural_frequency


def test_readings_that_agree_are_averaged_and_others_widen_the_band() -> None:
    agreeing = combine([Reading(1580, 4), Reading(1581, 3)])
    assert (agreeing.value, agreeing.deviation) == (pytest.approx(1580.64), pytest.approx(2.4))
    apart = combine([Reading(1570, 4), Reading(1600, 3)])
    assert 1584 < apart.value < 1588
    assert apart.deviation == pytest.approx(15, rel=0.1)
    assert combine([Reading(3, 2)]) == Reading(3, 2)


@pytest.mark.parametrize(("rpm", "deviation", "within"), [(1600.0, 10.0, True), (1650.0, 10.0, False)])
def test_an_identified_frequency_is_held_against_the_run_up(rpm: float, deviation: float, within: bool) -> None:
    found = compare_natural_frequency({"natural_frequency": {"rpm": 1586.0, "deviation_rpm": 5.0}}, rpm, deviation)
    assert found["within"] is within
    assert found["band_percent"] == pytest.approx(2.47, rel=0.01)
    assert ("agree" if within else "contradict each other") in found["sentence"]
