"""Rotors and modelled coefficients that are kept: of their conditions and file; a cone of one diameter."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from parameters.test_as_built import small

from pipeline.rotor.stored import load_modelled_bearings, load_rotor
from rotor.test_bearings import OIL, ROTOR, SHORT, SPEEDS, TABLE, bearings


def test_a_cone_of_one_diameter_is_a_cylinder() -> None:
    """ROSS's tapered element beside its cylindrical one; elements of a cone meet at their ends."""
    rotor = small("machine=overhung").machine.rotor
    (segment,) = rotor.shaft
    straight = rotor.model_copy(update={"shaft": (segment.model_copy(update={"end_diameter": 0.05}),)})
    assert load_rotor(straight).stiffness == pytest.approx(load_rotor(rotor).stiffness, rel=1e-12)
    cone = (segment.model_copy(update={"end_diameter": 0.04}),)
    halves = tuple(
        segment.model_copy(update={"length": 0.6, "elements": 4, "outer_diameter": a, "end_diameter": b})
        for a, b in ((0.05, 0.045), (0.045, 0.04))
    )
    whole, cut = (load_rotor(rotor.model_copy(update={"shaft": shaft})).stiffness for shaft in (cone, halves))
    assert cut == pytest.approx(whole, rel=1e-9)


def test_kept_coefficients_are_those_of_their_conditions_and_file(tmp_path: Path) -> None:
    """The cache asks for the conditions and for what the table's file holds."""
    film = bearings({**SHORT, "static_load": "500 N", "oil_viscosity": OIL})
    cold, warm = (load_modelled_bearings(ROTOR, film, SPEEDS, {"oil_temperature": np.full(15, t)}) for t in (310, 330))
    assert not np.allclose(cold.values, warm.values, rtol=0.01)
    again = load_modelled_bearings(ROTOR, film, SPEEDS, {"oil_temperature": np.full(15, 330)})
    np.testing.assert_array_equal(again.values, warm.values)
    assert again.operating["oil_temperature"][0] == 330
    path, found = tmp_path / "own.csv", []
    for stiffness in (1, 2):
        rows = [f"{s},{stiffness},1,-1,1,1,0,0,1" for s in (0.001, 0.1, 10, 1000)]
        path.write_text("\n".join(["S,Kxx,Kxy,Kyx,Kyy,Bxx,Bxy,Byx,Byy", *rows]), encoding="utf-8")
        given = bearings({**TABLE, "table": str(path), "static_load": "500 N", "oil_viscosity": 0.02})
        found.append(load_modelled_bearings(ROTOR, given, SPEEDS).coefficient("kyy"))
    np.testing.assert_allclose(found[1], 2 * found[0])
