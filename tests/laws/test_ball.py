"""The ball bearing, against that of ROSS."""

from __future__ import annotations

import numpy as np
import pytest

from laws.test_law_set import BALL, known, laws
from pipeline.coefficients import COEFFICIENTS
from pipeline.rotor.ross_adapter import ross


@pytest.mark.parametrize("n_balls", [8, 9, 20])
def test_a_ball_bearing_is_that_of_ross(n_balls: int) -> None:
    theirs = ross().BallBearingElement(n=0, n_balls=n_balls, d_balls=0.012, fs=300.0, alpha=np.radians(20))
    ours = known(laws({**BALL, "n_balls": n_balls}))[0]
    table = [float(np.ravel(getattr(theirs, name))[0]) for name in COEFFICIENTS]
    np.testing.assert_allclose(ours, np.tile(table, (7, 1)), rtol=1e-12, atol=1e-6)
