"""The short bearing, against that of ROSS."""

from __future__ import annotations

import numpy as np

from laws.test_law_set import SHORT, SPEEDS, constant, known, laws
from pipeline.coefficients import COEFFICIENTS
from pipeline.rotor.ross_adapter import ross


def test_a_short_bearing_is_that_of_ross() -> None:
    """All eight, x and y as ROSS has them, from light to heavy loads."""
    for load in (20.0, 900.0, 3e4):
        sizes = {"bearing_length": 0.0499, "journal_diameter": 0.0998, "radial_clearance": 1e-4}
        theirs = ross().CylindricalBearing(n=0, speed=SPEEDS, weight=load, oil_viscosity=0.0166, **sizes)
        ours = known(laws({**SHORT, "static_load": load}, oil=constant(0.0166)))
        table = np.stack([getattr(theirs, name) for name in COEFFICIENTS], axis=-1)  # its K(w) is a spline of these
        np.testing.assert_allclose(ours[0], table, rtol=1e-6, atol=1e-9 * np.abs(table[:, :4]).max())
