"""How the readings move with what is unknown: deviations of derivatives that overflow."""

from __future__ import annotations

import numpy as np

from pipeline.problem.slopes import deviate


def test_derivatives_that_overflow_have_no_finite_deviation() -> None:
    np.testing.assert_array_equal(deviate(np.array([[1e200, 1.0], [3.0, 4.0]]), np.eye(2)), [np.inf, 5.0])
