"""The section machine.laws: quantities known and guessed, and what it refuses by name."""

from __future__ import annotations

import re
from typing import Any

import pytest
from pydantic import ValidationError

from pipeline.config.messages import explain_schema_errors
from pipeline.laws.law_set import LawsConfig

GUESSED_OIL = {
    "law": "exponential",
    "reference": "55 degC",
    "viscosity": {"guess": "20 mPa s", "within": 5},
    "slope": 0.03,
}
SIZES = {"journal_diameter": "99.6 mm", "length": "49.9 mm", "static_load": "892.7 N"}
VOGEL = {"law": "vogel", "reference": "20 degC", "viscosity": "1 Pa s", "b": "900 K", "c": "30 degC"}


def mapping(oil: Any = GUESSED_OIL, **changes: Any) -> dict[str, Any]:
    """The section with one bearing's law."""
    bearing = {"kind": "short_journal", **SIZES, "radial_clearance": {"guess": "0.1 mm"}, **changes}
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
        ({"oil": VOGEL}, "c below reference"),
    ],
)
def test_what_no_bearing_can_be_is_refused(changes: dict[str, Any], said: str) -> None:
    given = mapping(**changes)
    with pytest.raises(ValidationError) as error:
        LawsConfig.model_validate(given)
    assert re.search(said, explain_schema_errors(error.value, given, LawsConfig))
