"""The expansion of readings to forces and motion at the bearings."""

from __future__ import annotations

import numpy as np
import pytest
from conftest import Machine
from hypothesis import given
from hypothesis import strategies as st

from pipeline.data.sensors import project
from pipeline.problem.expansion import _gain, expand
from pipeline.problem.reference_response import SolvedRotor
from problem.test_reference_response import PROBES, STIFFNESS


@pytest.mark.parametrize("channels", [((1, 0.0), (1, 90.0), (5, 0.0), (5, 90.0)), PROBES])
def test_the_expansion_finds_force_and_motion(rotor_of: Machine, channels: tuple[tuple[int, float], ...]) -> None:
    """On clean data the residual at the bearings vanishes, whatever the sensors are."""
    dataset = project(rotor_of.dataset, channels)
    equations = SolvedRotor(rotor_of.rotor, dataset, STIFFNESS).response
    made = expand(equations, dataset.displacement, np.full(dataset.displacement.shape, 1e-9))
    residual = made.equations.residual(rotor_of.bearings.impedance())
    assert np.abs(residual).max() < 1e-6 * np.abs(made.equations.free_residual).max()


def test_too_few_sensors_have_no_expansion(rotor_of: Machine) -> None:
    dataset = project(rotor_of.dataset, PROBES[:3])
    equations = SolvedRotor(rotor_of.rotor, dataset, STIFFNESS).response
    assert expand(equations, dataset.displacement, np.full(dataset.displacement.shape, 1e-9)) is None


@given(seed=st.integers(0, 1000), n_channels=st.integers(1, 9))
def test_both_forms_of_the_gain_are_one(seed: int, n_channels: int) -> None:
    """The matrix inversion lemma."""
    generator = np.random.default_rng(seed)
    parts = generator.standard_normal((2, 3, n_channels, 4))
    through, prior = parts[0] + 1j * parts[1], generator.uniform(0.5, 2, (3, 4))
    deviation = generator.uniform(0.5, 2, (3, n_channels))
    spread = prior[..., None] * through.conj().swapaxes(1, 2)
    dense = spread @ np.linalg.inv(through @ spread + deviation[..., None] ** 2 * np.eye(n_channels))
    np.testing.assert_allclose(_gain(through, prior, deviation), dense, rtol=1e-9, atol=1e-12)
    # A single mode that hides what was known before: the mean of the channels, in the direction of the mode.
    np.testing.assert_allclose(
        _gain(np.ones((n_channels, 4)), np.ones(4), np.full(n_channels, 1e-12)), 1 / 4 / n_channels
    )
