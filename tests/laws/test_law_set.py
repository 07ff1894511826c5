"""Laws of bearings, and their section: against ROSS, the modelled table, similarity, turned axes, differences."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from typing import Any

import numpy as np
import pytest
import torch
from pydantic import ValidationError
from training import assert_close

from pipeline.config.messages import explain_schema_errors
from pipeline.errors import ConfigError, DataError
from pipeline.laws.law_set import LawsConfig, LawSet, make_laws

SPEEDS = np.linspace(30.0, 450.0, 7)
WARM = {"oil_temperature": np.linspace(310.0, 345.0, 7)}
OIL = {"law": "exponential", "reference": "55 degC", "viscosity": "16.6 mPa s", "slope": "0.034 1/K"}
SIZES = {
    "journal_diameter": "99.8 mm",
    "length": "49.9 mm",
    "radial_clearance": "0.1 mm",
    "static_load": "892.7 N",
}
LUND = {"kind": "journal_table", "table": "lund_thomsen_two_axial_groove", **SIZES}
ELLIPTICAL = {**LUND, "table": "elliptical", "preload": 0.4}
SHORT = {"kind": "short_journal", **SIZES}
BALL = {"kind": "ball", "n_balls": 9, "ball_diameter": "12 mm", "contact_angle": "20 deg", "load": "300 N"}
VOGEL = {"law": "vogel", "reference": "40 degC", "viscosity": "30 mPa s", "b": "900 K", "c": "-95 degC"}


def constant(viscosity: float) -> dict[str, Any]:
    return {"law": "constant", "viscosity": viscosity}


def laws(*bearings: Mapping[str, Any], oil: Mapping[str, Any] = OIL) -> LawSet:
    """Laws of bearings at nodes 0, 1, ..."""
    section = LawsConfig.model_validate({"oil": oil, "bearings": dict(enumerate(bearings))})
    return make_laws(section, range(len(bearings)))


def unknown(bearing: Mapping[str, Any], *names: str) -> dict[str, Any]:
    """The bearing with these numbers unknown."""
    return {**bearing, **{name: {"guess": bearing[name], "within": 2} for name in names}}


def known(given: LawSet, speeds: np.ndarray = SPEEDS, operating: Mapping[str, np.ndarray] = WARM) -> np.ndarray:
    """(B, S, 8) at theta zero."""
    theta = torch.zeros(1, len(given.parameters), dtype=torch.float64)
    return np.asarray(given.coefficients(theta, speeds, operating)[0][0])


EVERYTHING = laws(
    unknown(LUND, "journal_diameter", "length", "radial_clearance", "static_load"),
    unknown({**SHORT, "load_angle": "40 deg"}, "journal_diameter", "length", "radial_clearance", "static_load"),
    unknown({**SHORT, "static_load": "condition", "load_share": 0.4}, "load_share"),
    unknown(BALL, "ball_diameter", "contact_angle", "load"),
    unknown(ELLIPTICAL, "radial_clearance", "preload"),
    oil=unknown(OIL, "viscosity", "slope"),
)


@pytest.mark.parametrize(
    "given", [EVERYTHING, laws(SHORT, oil=unknown(VOGEL, "viscosity", "b", "c"))], ids=["all", "vogel"]
)
@pytest.mark.parametrize("size", [0.05, 1.0], ids=["within the tables", "far outside"])
def test_slopes_are_those_of_differences(given: LawSet, size: float) -> None:
    theta = size * torch.from_numpy(np.random.default_rng(1).normal(size=(2, len(given.parameters))))
    operating = {**WARM, "load": np.linspace(800.0, 3000.0, 7)}
    values, slopes = given.coefficients(theta, SPEEDS, operating)
    assert slopes.shape == (2, len(given.nodes), 7, 8, len(given.parameters))
    for i in range(len(given.parameters)):
        step = torch.zeros_like(theta)
        step[:, i] = 1e-5
        ends = [given.coefficients(theta + sign * step, SPEEDS, operating)[0] for sign in (1, -1)]
        scale = values.abs().amax(dim=(2, 3), keepdim=True)
        assert_close((ends[0] - ends[1]) / 2e-5 / scale, slopes[..., i] / scale, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("bearing", [LUND, SHORT], ids=["table", "short"])
def test_sommerfeld_similarity(bearing: dict[str, Any]) -> None:
    """Twice the viscosity is twice the speed, but for the speed in the damping; and so for clearance and load."""
    thin, thick = (known(laws(bearing, oil=constant(eta)))[0] for eta in (0.01, 0.02))
    fast = known(laws(bearing, oil=constant(0.01)), 2 * SPEEDS)[0]
    np.testing.assert_allclose(fast, thick / np.repeat([1.0, 2.0], 4), rtol=1e-10)
    for twice, eta, times in (({"radial_clearance": "0.2 mm"}, 0.04, 0.5), ({"static_load": "1785.4 N"}, 0.02, 2.0)):
        np.testing.assert_allclose(known(laws(bearing | twice, oil=constant(eta)))[0], times * thin, rtol=1e-10)


def test_a_turned_bearing_is_the_same_in_turned_axes() -> None:
    straight, turned = known(laws(LUND))[0], known(laws({**LUND, "load_angle": "30 deg"}))[0]
    cos, sin = np.cos(np.pi / 6), np.sin(np.pi / 6)
    turn = np.array([[cos, -sin], [sin, cos]])
    np.testing.assert_allclose(turned, (turn @ straight.reshape(7, 2, 2, 2) @ turn.T).reshape(7, 8), rtol=1e-9)
    quarter = known(laws({**LUND, "load_angle": "90 deg"}))[0]
    np.testing.assert_allclose(quarter[:, [3, 2, 1, 0]], straight[:, :4] * [1, -1, -1, 1], rtol=1e-9, atol=1e-3)


def test_a_record_of_laws_makes_the_same_laws_without_files() -> None:
    copy = LawSet.from_record(json.loads(json.dumps(EVERYTHING.to_record())))
    operating = {**WARM, "load": np.full(7, 900.0)}
    np.testing.assert_array_equal(known(copy, operating=operating), known(EVERYTHING, operating=operating))
    assert copy.parameters == EVERYTHING.parameters
    assert copy.inputs == EVERYTHING.inputs == ("load", "oil_temperature")


def test_unknown_numbers_have_names_units_and_guesses() -> None:
    assert [f"{one.name} {one.unit}" for one in EVERYTHING.parameters][:6] == [
        *("oil.viscosity Pa * s", "oil.slope 1 / K"),
        *("0.journal_diameter m", "0.length m", "0.radial_clearance m", "0.static_load N"),
    ]
    assert [one.member for one in EVERYTHING.parameters[:3]] == [None, None, 0]
    theta = np.zeros(len(EVERYTHING.parameters))
    theta[0] = np.log(2)
    np.testing.assert_allclose(EVERYTHING.numbers(theta)[:2], [0.0332, 0.034])


@pytest.mark.parametrize(
    ("law", "operating", "words"),
    [
        (LUND, {"load": np.ones(7)}, "oil_temperature, but the data have load.*column oil_temperature_degC"),
        ({**LUND, "static_load": "condition"}, {**WARM, "load": np.zeros(7)}, "load above zero"),
    ],
)
def test_a_condition_that_a_law_needs_and_does_not_get_is_named(
    law: dict[str, object], operating: dict[str, np.ndarray], words: str
) -> None:
    with pytest.raises(DataError, match=words):
        known(laws(law), operating=operating)


@pytest.mark.parametrize(
    ("law", "nodes", "words"),
    [
        ({**ELLIPTICAL, "preload": None}, (0,), "bearings.0 must have a preload .*has from 0 to 0.75: give preload"),
        ({**LUND, "preload": 0.4}, (0,), "has none: leave out preload"),
        (LUND, (0, 5), "must have a law for node 5, but it has 0"),
    ],
)
def test_what_a_law_must_have_is_named(law: dict[str, object], nodes: tuple[int, ...], words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        make_laws(LawsConfig.model_validate({"oil": OIL, "bearings": {0: law}}), nodes)


GUESSED_OIL = {
    "law": "exponential",
    "reference": "55 degC",
    "viscosity": {"guess": "20 mPa s", "within": 5},
    "slope": 0.03,
}


GUESSED_SIZES = {"journal_diameter": "99.6 mm", "length": "49.9 mm", "static_load": "892.7 N"}


EARLY_VOGEL = {"law": "vogel", "reference": "20 degC", "viscosity": "1 Pa s", "b": "900 K", "c": "30 degC"}


def mapping(oil: Any = GUESSED_OIL, **changes: Any) -> dict[str, Any]:
    """The section with one bearing's law."""
    bearing = {"kind": "short_journal", **GUESSED_SIZES, "radial_clearance": {"guess": "0.1 mm"}, **changes}
    return {"oil": oil, "bearings": {1: bearing}}


def test_known_numbers_and_guesses_are_si() -> None:
    laws: Any = LawsConfig.model_validate(mapping(static_load="condition", load_share=0.5))
    assert (laws.oil.reference, laws.oil.viscosity.guess, laws.oil.viscosity.within) == (328.15, 0.02, 5)
    bearing = laws.bearings[1]
    assert (bearing.radial_clearance.guess, bearing.radial_clearance.within) == (1e-4, 3)
    assert (bearing.static_load, bearing.load_share) == ("condition", 0.5)
    assert LawsConfig.model_validate(laws.model_dump(mode="json")) == laws


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"radial_clearance": "60 mm"}, "smaller than the journal's radius, but it is 60 mm and the radius 49.8 mm"),
        ({"radial_clearance": {"guess": "60 mm"}}, "smaller than the journal's radius"),
        ({"radial_clearance": "-0.1 mm"}, "bearings.1.radial_clearance: must be above zero .*but got '-0.1 mm'"),
        ({"radial_clearance": {"guess": "0 mm"}}, "must be above zero"),
        ({"radial_clearance": {"guess": "0.1 mm", "within": 1}}, "within: must be greater than 1, but got 1"),
        ({"radial_clearance": {"guess": "0.1 N"}}, "must convert to m"),
        (
            {"radial_clearance": {"gues": "0.1 mm"}},
            "gues: must be a key that the schema knows, but 'gues' is not; did you mean 'guess'",
        ),
        ({"radial_clearance": {"guess": "0.1 mm", "with": 2}}, "with: must be a key that the schema knows"),
        ({"radial_clearance": "condition"}, "radial_clearance: must"),
        ({"static_load": "conditions"}, "must have a known unit"),
        ({"load_share": 0.5}, "load_share must be left out"),
        ({"kind": "journal_table"}, "table: must be given"),
        ({"kind": "journal_table", "table": "x", "preload": 1.5}, "preload must be between 0 and 1"),
        ({"oil": None}, "must have an oil for the journal bearing of node 1"),
        ({"oil": EARLY_VOGEL}, "c below reference"),
    ],
)
def test_what_no_bearing_can_be_is_refused(changes: dict[str, Any], said: str) -> None:
    given = mapping(**changes)
    with pytest.raises(ValidationError) as error:
        LawsConfig.model_validate(given)
    assert re.search(said, explain_schema_errors(error.value, given, LawsConfig))
