"""What readings determine of the physical numbers of bearing laws: closed forms of temperatures and of what is free."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import nullcontext
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from small_rotor import SPEEDS, small_machine

from pipeline.data.sensors import NoiseModel
from pipeline.errors import IdentifiabilityError
from pipeline.laws.law_set import LawsConfig, make_laws
from pipeline.problem.law_information import (
    FURTHER,
    LawInformation,
    at_state,
    inform,
    require_temperatures,
    try_warmer,
)
from pipeline.problem.measurement import Measurement

WARM = 328.15  # K, the reference
OIL = {
    "law": "exponential",
    "reference": "55 degC",
    "viscosity": {"guess": "20 mPa s", "within": 50},
    "slope": {"guess": "0.03 1/K", "within": 50},
}
KNOWN_OIL = {"law": "constant", "viscosity": "20 mPa s"}
BEARING = {
    "kind": "short_journal",
    "journal_diameter": "50 mm",
    "length": "25 mm",
    "radial_clearance": "0.1 mm",
    "static_load": "60 N",
}


def measured(
    temperatures: Sequence[float], oil: Mapping[str, Any] = OIL, bearing: Mapping[str, Any] = BEARING
) -> Measurement:
    """Readings at six speeds and each of the temperatures (K), at bearings as the laws' guesses have them."""
    made, _ = small_machine((1e6, 0, 0, 1e6, 1e3, 0, 0, 1e3), speeds=np.tile(SPEEDS, len(temperatures)))
    section = LawsConfig.model_validate({"oil": oil, "bearings": dict.fromkeys((0, 5), bearing)})
    made = replace(made, laws=make_laws(section, (0, 5)), noise=NoiseModel(1e-9, 0.0))
    return at_state(made, {"oil_temperature": np.repeat(temperatures, len(SPEEDS))})


def deviation(found: LawInformation, name: str) -> float:
    return float(found.deviation[[one.name for one in found.parameters].index(name)])


def test_the_slope_is_known_by_the_inverse_of_the_difference_of_temperatures() -> None:
    """About the reference each viscosity is known alike, and their ratio is the slope times the difference."""
    spread = {of: deviation(inform(measured([WARM - of / 2, WARM + of / 2])), "oil.slope") for of in (1.0, 2.0, 4.0)}
    assert spread[1.0] / spread[2.0] == pytest.approx(2.0, rel=0.01)
    assert spread[2.0] / spread[4.0] == pytest.approx(2.0, rel=0.01)


def test_the_slope_has_the_deviation_of_two_viscosities_over_their_distance() -> None:
    """Each by its own readings, with a bearing that is known."""
    low, high = (
        deviation(inform(measured([of], OIL | {"slope": "0.03 1/K"})), "oil.viscosity") for of in (320.0, 335.0)
    )
    both = inform(measured([320.0, 335.0]))
    assert deviation(both, "oil.slope") == pytest.approx(np.hypot(low, high) / (0.03 * 15.0), rel=1e-3)


def test_what_is_free_are_viscosity_load_and_clearance_together() -> None:
    """Forces W/c and the Sommerfeld number, with viscosity over W c^2, stay the same along (3, 1, 1)."""
    unknown = {name: {"guess": BEARING[name], "within": 3} for name in ("radial_clearance", "static_load")}
    oil = {"law": "constant", "viscosity": {"guess": "20 mPa s", "within": 3}}
    one = measured([WARM], oil, BEARING)
    sections = ({"oil": oil, "bearings": {0: BEARING | unknown, 5: of}} for of in (BEARING, BEARING | unknown))
    laws = (make_laws(LawsConfig.model_validate(section), (0, 5)) for section in sections)
    told, found = (inform(replace(one, laws=given)) for given in laws)
    assert told.determined.all()  # the oil is told by the bearing whose numbers are known
    assert [one.name for one, told in zip(found.parameters, found.determined, strict=True) if not told] == [
        "oil.viscosity"
    ]
    (shares,) = found.free
    direction = np.array([3.0, 1.0, 1.0, 1.0, 1.0]) / np.sqrt(13.0)  # the oil is that of both
    np.testing.assert_allclose([shares[one.name] for one in found.parameters], direction, atol=1e-3)


def test_combinations_that_are_free_are_told_apart() -> None:
    """At one temperature the slope is free by itself, and beside it what was free before."""
    unknown = {name: {"guess": BEARING[name], "within": 3} for name in ("radial_clearance", "static_load")}
    found = inform(measured([WARM], OIL, BEARING | unknown))
    first, second = sorted(found.free, key=len)
    assert first == {"oil.slope": pytest.approx(1.0)}
    assert second.keys() == {one.name for one in found.parameters} - {"oil.slope"}


def test_a_warmer_oil_is_read_as_if_it_had_been_measured() -> None:
    """The information of one more temperature adds up."""
    temperature, found = try_warmer(measured([WARM])) or pytest.fail("no temperature to add")
    np.testing.assert_allclose(temperature, WARM + FURTHER)
    np.testing.assert_allclose(found.deviation, inform(measured([WARM, WARM + FURTHER])).deviation, rtol=1e-6)
    assert try_warmer(measured([WARM], KNOWN_OIL, BEARING | {"static_load": {"guess": "60 N"}})) is None


@pytest.mark.parametrize(
    ("temperatures", "oil", "words"),
    [
        ([328.15], OIL, "two oil temperatures or more, but all readings are at 55 degC"),
        ([328.15, 328.5], OIL, "two oil temperatures"),
        ([328.15], OIL | {"viscosity": "20 mPa s"}, "oil.slope must be read"),  # at the reference nothing shows it
        ([320.0, 335.0], OIL, ""),
        ([320.0], OIL | {"viscosity": "20 mPa s"}, ""),
        ([320.0], OIL | {"slope": "0.03 1/K"}, ""),
        (
            [320.0, 335.0],
            {"law": "vogel", "reference": "55 degC"}
            | {"viscosity": {"guess": "20 mPa s"}, "b": {"guess": "900 K"}, "c": {"guess": "-95 degC"}},
            "three oil temperatures or more, but they are at 46.85 to 61.85 degC",
        ),
    ],
)
def test_too_few_temperatures_are_a_named_error(temperatures: list[float], oil: Mapping[str, Any], words: str) -> None:
    laws = make_laws(LawsConfig.model_validate({"oil": oil, "bearings": {0: BEARING}}), (0,))
    law = rf"(?s){words}.*measure at a further oil temperature, 15 K apart"
    with pytest.raises(IdentifiabilityError, match=law) if words else nullcontext():
        require_temperatures(laws, {"oil_temperature": np.array(temperatures)})
