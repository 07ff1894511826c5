"""Operating conditions of a configuration: names, quantities, units, and what is none."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from conftest import refused
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import TypeAdapter, ValidationError
from running import composed
from stages.test_measurement import BASE

from pipeline.config.operating import UNITS, WRITTEN, Differences, States, column_of, find_column, to_quantity
from pipeline.errors import ConfigError

NAMES = [f"oil_{word}" for word in WRITTEN] + [f"drain_{unit}" for unit in UNITS]


@settings(max_examples=40)
@given(name=st.sampled_from(NAMES), values=st.lists(st.floats(100.0, 1e6), min_size=1, max_size=3))
def test_the_column_of_a_name_gives_name_and_values_back(name: str, values: list[float]) -> None:
    column = column_of(name)
    assert find_column(column.column) == {name: column}
    assert column.to_si(column.from_si(np.array(values))) == pytest.approx(values, rel=1e-10)


@pytest.mark.parametrize(
    ("name", "given", "difference", "expected"),
    [
        ("oil_temperature", "45 degC", False, 318.15),
        ("oil_temperature", "113 degF", False, pytest.approx(318.15)),
        ("oil_temperature", 318.15, False, 318.15),
        ("oil_supply_pressure", "1.5 bar", False, pytest.approx(1.5e5)),
        ("drain_degC", "45 degC", False, 318.15),
        ("oil_temperature", "0.5 degC", True, pytest.approx(0.5)),
        ("oil_temperature", "0.5 K", True, 0.5),
    ],
)
def test_quantities_are_in_si_and_degrees_exact(name: str, given: Any, difference: bool, expected: Any) -> None:
    assert to_quantity(name, given, difference=difference) == expected


def test_sections_of_conditions_are_in_si() -> None:
    assert TypeAdapter(States).validate_python(None) == {}
    assert TypeAdapter(States).validate_python({"load": "2 kN"}) == {"load": (2000.0,)}
    assert TypeAdapter(Differences).validate_python({"oil_temperature": "0.5 degC"}) == {
        "oil_temperature": pytest.approx(0.5)
    }


@pytest.mark.parametrize(
    ("value", "words"),
    [
        ({"oil_temperature": ["45 N"]}, "must convert to kelvin (such as 45 degC), but got '45 N'"),
        ({"oil_temperature": [45]}, "must carry its unit (such as 45 degC): a number alone is in K, but got 45"),
        ({"oil_temperature": ["-300 degC"]}, "must be above absolute zero"),
        ({"oil_temperature": ["warm"]}, "must have a known unit (such as 45 degC), but got 'warm'"),
        ({"oil_temperature": ["45 degC", "318.15 K"]}, "must have values that differ"),
        ({"oil_temperature": []}, "must have values that differ"),
        ({"colour": [1]}, "a last word that says what it is (temperature, pressure"),
        ({"load": [True]}, "must be a quantity"),
        ({"load": ["9**9**9**9 N"]}, "must be a quantity"),
        ({"load": ["inf N"]}, "must be"),
        ([1], "must be conditions by name"),
    ],
)
def test_what_is_no_condition_is_refused_by_name(value: Any, words: str) -> None:
    with pytest.raises(ValidationError) as error:
        TypeAdapter(States).validate_python(value)
    assert words in str(error.value)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("key", "given", "words"),
    [
        ("machine.operating", "[45]", "oil_temperature must carry its unit"),
        ("data.same_conditions", "5 N", "(such as 0.5 K)"),
    ],
)
def test_what_is_no_condition_is_named_with_its_key(key: str, given: str, words: str) -> None:
    with refused(f"{key}: ", words, kind=ConfigError):
        composed(*BASE, f"{key}={{oil_temperature: {given}}}")
