"""Coordinates of the impedance: there and back, and their slopes against automatic derivatives."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from pipeline.impedance import to_coefficients, to_coordinates

SPEEDS = np.array([30.0, 200.0, 900.0])


def _draw(seed: int) -> np.ndarray:
    """(3, 8) any bearing with positive direct damping; stiffness of either sign."""
    generator = np.random.default_rng(seed)
    values = generator.normal(size=(3, 8)) * 10.0 ** generator.uniform(5, 8, 8)
    values[:, [4, 7]] = 10.0 ** generator.uniform(2, 6, (3, 2))
    return values


@given(st.integers(0, 10**6))
def test_coefficients_come_back(seed: int) -> None:
    """Negative stiffness included."""
    values = _draw(seed)
    back = to_coefficients(torch.as_tensor(to_coordinates(values, SPEEDS)), torch.as_tensor(SPEEDS))[0].numpy()
    size = np.abs(to_coordinates(values, SPEEDS)[:, [1, 3]]).max()  # cosh of a large one loses digits
    assert np.allclose(back, values, rtol=1e-10 * np.exp(size), atol=0)


@pytest.mark.slow
@given(st.integers(0, 10**6))
def test_slopes_are_the_derivatives(seed: int) -> None:
    """By torch's automatic differentiation."""
    at = torch.as_tensor(np.random.default_rng(seed).normal(size=(3, 8)))
    _, slopes = to_coefficients(at, torch.as_tensor(SPEEDS))
    whole = torch.autograd.functional.jacobian(lambda c: to_coefficients(c, torch.as_tensor(SPEEDS))[0], at)
    for s in range(3):
        assert torch.allclose(slopes[s], whole[s, :, s], rtol=1e-12, atol=1e-12)


def test_a_turn_by_half_a_circle_changes_nothing_but_a_quarter_swaps_the_axes() -> None:
    """x and y of a bearing that is turned by 90 degrees."""
    values = _draw(3)
    turned = values[:, [3, 2, 1, 0, 7, 6, 5, 4]] * [1, -1, -1, 1, 1, -1, -1, 1]
    there, here = to_coordinates(turned, SPEEDS), to_coordinates(values, SPEEDS)
    assert np.allclose(there, here[:, [2, 3, 0, 1, 5, 4, 7, 6]] * [1, 1, 1, 1, -1, -1, -1, -1], rtol=1e-12)
