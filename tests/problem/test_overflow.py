"""Where functions of the speed overflow, coefficients and deviations are infinite, and nothing else is said of it."""

from __future__ import annotations

import numpy as np
from conftest import unknown_at_all

from pipeline.problem.slopes import deviate


def test_unknowns_that_overflow_are_expanded_without_a_warning() -> None:
    unknowns = unknown_at_all((1, 5), ("kxx", "cyy"), shared=True)
    values = np.array([[[np.inf, 2.0], [3.0, 4.0]]])  # of one member, at two speeds
    expanded = unknowns.expand(values, np.zeros((2, 2, 8)))
    assert not np.isfinite(expanded[:, 0]).all()
    np.testing.assert_array_equal(expanded[:, 1], [[3.0, 0, 0, 0, 0, 0, 0, 4.0]] * 2)


def test_derivatives_that_overflow_have_no_finite_deviation() -> None:
    np.testing.assert_array_equal(deviate(np.array([[1e200, 1.0], [3.0, 4.0]]), np.eye(2)), [np.inf, 5.0])
