"""The machine at conditions of one's choice: which are allowed, what is known there, and how the bands grow outside."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from warm_rotor import CELSIUS, NOISE, SPEEDS, warm_bearings, warm_machine

from pipeline.errors import ConfigError
from pipeline.identification.fit import default_setup, fit
from pipeline.problem.measurement import Measurement
from pipeline.rotor.bearing_table import BearingTable
from pipeline.twin.at_conditions import (
    evaluate_at,
    mask_state,
    pick_middle,
    require_conditions,
    say_beyond,
    table_at,
)
from pipeline.twin.mode_deviations import deviate_modes
from pipeline.twin.modes import find_modes
from pipeline.twin.prediction import compare_held_out

KEY = "machine.prediction.operating"
MEASURED = {"oil_temperature": np.repeat(CELSIUS, 2) + 273.15, "load": np.tile([500.0, 900.0], 3)}


@pytest.mark.parametrize(
    ("asked", "measured", "words"),
    [
        ({"oil_temperature": 300.0}, MEASURED, "must say every condition of the data, but load is missing"),
        ({"oil_pressure": 1e5}, MEASURED, "got oil_pressure: they have oil_temperature, load"),
        ({"load": 1.0}, {}, "got load: they have none"),
    ],
)
def test_conditions_are_those_of_the_data(asked: dict[str, float], measured: dict[str, np.ndarray], words: str) -> None:
    require_conditions(KEY, {"load": 1.0, "oil_temperature": 300.0}, MEASURED)
    with pytest.raises(ConfigError, match=words):
        require_conditions(KEY, asked, measured)


def test_the_middle_is_a_measured_state() -> None:
    assert pick_middle(MEASURED) == {"oil_temperature": 55.0 + 273.15, "load": 500.0}
    assert pick_middle({}) == {}
    # Hot runs have one load, cold ones the other: the medians of both were never measured together.
    apart = {"oil_temperature": np.array([310.0, 310.0, 310.0, 340.0]), "load": np.array([900.0, 900.0, 900.0, 500.0])}
    assert mask_state(apart, pick_middle(apart)).any()


def test_what_lies_outside_the_data_is_said_by_condition() -> None:
    assert say_beyond(MEASURED, {"oil_temperature": 338.15, "load": 700.0}) == []
    (words,) = say_beyond(MEASURED, {"oil_temperature": 343.15, "load": 700.0})
    assert words == "oil temperature: 70 degC lies outside the measured 45 to 65 degC"
    assert say_beyond({"load": np.full(3, 500.0)}, {"load": 600.0}) == ["load: 600 N is not the measured 500 N"]


def test_known_coefficients_are_those_of_the_state_or_of_all_states() -> None:
    speeds, celsius = np.tile(SPEEDS, 2), np.repeat([45.0, 65.0], len(SPEEDS))
    table = warm_bearings(speeds, celsius)
    there = table_at(table, {"oil_temperature": 65.0 + 273.15}, KEY)
    np.testing.assert_array_equal(there.values, table.values[:, len(SPEEDS) :])
    np.testing.assert_array_equal(there.speeds, SPEEDS)
    with pytest.raises(ConfigError, match="a known coefficient depends on them, but got 70 degC"):
        table_at(table, {"oil_temperature": 70.0 + 273.15}, KEY)
    zero = table_at(replace(table, values=0 * table.values), {"oil_temperature": 343.15}, KEY)
    assert zero.operating["oil_temperature"].tolist() == [343.15] * len(SPEEDS)
    plain = replace(table, operating={})
    assert table_at(plain, {}, KEY) is plain


def test_functions_that_run_away_beyond_the_data_are_refused() -> None:
    """A constant times ``exp(a (T - 55))`` that a few states cannot hold."""
    measurement, _ = warm_machine()

    class Runaway:
        def table(self, known: BearingTable) -> BearingTable:
            celsius = known.operating["oil_temperature"] - 273.15
            size = 1e6 * np.exp(0.7 * np.maximum(celsius - 65.0, 0.0))[None, :, None]
            return replace(known, values=size * np.ones_like(known.values))

    def ask(celsius: float) -> BearingTable:
        return evaluate_at(Runaway(), measurement, {"oil_temperature": celsius + 273.15}, KEY)[1]

    assert (ask(66.0).values > 1e6).all()
    with pytest.raises(ConfigError, match="continued to, but at 80 degC kxx of node 0 leaves all bounds"):
        ask(80.0)


@pytest.fixture(scope="module")
def warm() -> tuple[Measurement, object]:
    """Readings at 45, 55 and 65 degC, and their fit by a network of speed and temperature."""
    measurement, _ = warm_machine()
    return measurement, fit(measurement, default_setup(measurement.guess))


@pytest.mark.slow
def test_bands_grow_outside_the_measured_temperatures(warm: tuple) -> None:
    """Of every coefficient at every speed; oracle of the values: the machine's own coefficients."""
    measurement, found = warm
    spread = {}
    for celsius in (45.0, 55.0, 65.0, 80.0):
        table = found.table(table_at(measurement.known, {"oil_temperature": celsius + 273.15}, KEY))
        deviation = found.deviation(table.speeds, table.operating)
        true = warm_bearings(table.speeds, np.full(len(SPEEDS), celsius)).values[..., [0, 3, 4, 7]]
        share = spread[celsius] = (deviation / np.abs(table.values))[..., [0, 3, 4, 7]]
        assert np.mean(np.abs(table.values[..., [0, 3, 4, 7]] / true - 1.0) < 3 * share) > 0.9
    inside = np.max([spread[45.0], spread[55.0], spread[65.0]], axis=0)
    assert (np.median(spread[80.0], axis=1) > np.median(inside, axis=1)).all()


@pytest.mark.slow
def test_modes_at_a_temperature_that_was_not_measured_lie_within_their_deviations(warm: tuple) -> None:
    measurement, found = warm
    there = replace(measurement, known=table_at(measurement.known, {"oil_temperature": 72.0 + 273.15}, KEY))
    table = found.table(there.known)
    modes = find_modes(there.rotor, table)
    deviations = deviate_modes(modes, there, table, found.uncertainty)
    true = find_modes(there.rotor, warm_bearings(table.speeds, np.full(len(SPEEDS), 72.0)))
    known = np.isfinite(modes.frequency) & np.isfinite(true.frequency) & (deviations.frequency > 0)
    assert known.any(axis=1).all()
    assert np.median(np.abs(modes.frequency - true.frequency)[known] / deviations.frequency[known]) < 3


def test_a_state_that_was_held_out_is_judged_by_itself() -> None:
    """The machine's own coefficients predict its readings at 65 degC to their noise, and no interpolation does."""
    measurement, bearings = warm_machine()
    training = SimpleNamespace(
        holdout_every=0, holdout_range=None, holdout_runs=(), holdout_operating={"oil_temperature": 65.0 + 273.15}
    )
    ((what, found),) = compare_held_out(measurement, bearings, None, training).items()
    assert what == "conditions, 65 degC"
    assert found["rival_error_percent"] is None
    there = measurement.dataset.at(np.arange(2 * len(SPEEDS), 3 * len(SPEEDS)))
    assert found["model_error_percent"] == pytest.approx(
        100 * NOISE / np.sqrt((np.abs(there.displacement) ** 2).mean()), rel=0.5
    )
