"""Which coefficients are unknown, which are tied, and their outputs."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from conftest import unknown_at_all
from hypothesis import given
from hypothesis import strategies as st

from pipeline.unknowns import outputs_of, scale_outputs, tie


@pytest.mark.usefixtures("one_thread")
@given(raw=st.floats(-5, 20), size=st.floats(1e2, 1e9), base=st.floats(-1e9, 1e9))
def test_outputs_make_the_same_of_arrays_and_of_tensors(raw: float, size: float, base: float) -> None:
    """``size exp(x)`` of what must be positive, ``base + size x`` elsewhere; without a base, the way back."""
    outputs, sizes = np.array([[raw, raw]]), np.array([size, 2 * size])
    for positive in (np.array([True, False]), np.array([True, True])):
        values, slope = scale_outputs(outputs, sizes, positive, base)
        wanted = np.where(positive, sizes * np.exp(raw), base + sizes * raw)
        np.testing.assert_allclose(values, wanted[None], rtol=1e-15)
        np.testing.assert_array_equal(slope, np.where(positive, values, sizes))
        tensors = scale_outputs(*map(torch.as_tensor, (outputs, sizes, positive)), base)
        np.testing.assert_allclose(tensors[0], values, rtol=1e-14)
        np.testing.assert_allclose(tensors[1], slope, rtol=1e-14)
        plain, _ = scale_outputs(outputs, sizes, positive)
        back = outputs_of(plain, sizes, positive)
        np.testing.assert_allclose(back, outputs, rtol=1e-12, atol=1e-12)
        np.testing.assert_allclose(outputs_of(*map(torch.as_tensor, (plain, sizes, positive))), back, rtol=1e-13)
    assert outputs_of(np.array([-1.0]), 1.0, np.array([True]), 1e-3) == np.log(1e-3)


def test_unknowns_that_overflow_are_expanded_without_a_warning() -> None:
    unknowns = unknown_at_all((1, 5), ("kxx", "cyy"), shared=True)
    values = np.array([[[np.inf, 2.0], [3.0, 4.0]]])  # of one member, at two speeds
    expanded = unknowns.expand(values, np.zeros((2, 2, 8)))
    assert not np.isfinite(expanded[:, 0]).all()
    np.testing.assert_array_equal(expanded[:, 1], [[3.0, 0, 0, 0, 0, 0, 0, 4.0]] * 2)


def test_a_structure_needs_both_of_a_pair() -> None:
    with pytest.raises(ValueError, match="ties cxy and cyx: both must be unknown or neither"):
        tie(("kxx", "cxy"), "symmetric_damping")
