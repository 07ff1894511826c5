"""What the weight says: against statics of a beam on two supports, and the shaft as configured."""

from __future__ import annotations

import numpy as np
import pytest
from small_rotor import STEEL

from pipeline.config.rotor import RotorConfig
from pipeline.rotor.model import RotorModel
from pipeline.rotor.stored import load_rotor
from pipeline.rotor.weight import GRAVITY, estimate_journals, find_static_loads


def _rotor(nodes: list[int]) -> RotorModel:
    shaft = [{"length": 1.2, "outer_diameter": 0.05, "inner_diameter": 0.0, "elements": 8}]
    discs = [{"node": 3, "mass": 20.0, "diametral_inertia": 0.05, "polar_inertia": 0.09}]
    config = {"material": STEEL, "shaft": shaft, "discs": discs, "bearing_nodes": nodes, "shear_effects": True}
    return load_rotor(RotorConfig.model_validate(config))


def test_two_bearings_share_the_weight_by_their_levers() -> None:
    """Statics: moments about the first bearing."""
    rotor = _rotor([1, 6])
    shaft = 7810.0 * np.pi / 4 * 0.05**2 * 1.2
    lever = (shaft * (0.6 - 0.15) + 20.0 * (0.45 - 0.15)) / (0.9 - 0.15)
    assert find_static_loads(rotor) == pytest.approx(GRAVITY * np.array([shaft + 20.0 - lever, lever]), rel=1e-2)


def test_a_bearing_that_carries_nothing_has_a_tenth_of_the_weight() -> None:
    """The load of the outer one of three follows from the bending of the shaft; their sum is the weight and more."""
    rotor = _rotor([2, 4, 8])
    loads = find_static_loads(rotor)
    weight = GRAVITY * rotor.total_mass
    assert (loads >= 0.0999 * weight).all()
    assert loads.sum() >= 0.999 * weight


def test_journals_have_the_diameter_of_a_steel_shaft() -> None:
    """To the density, which is 7850 kg/m3 by assumption."""
    assert estimate_journals(_rotor([1, 6])) == pytest.approx(0.05 * np.sqrt(7810 / 7850), rel=1e-2)
