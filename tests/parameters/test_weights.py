"""Uncertain weights, against hand calculation."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.data.dataset import Excitation, VibrationDataset
from pipeline.parameters.model import ModelParameter, set_values
from pipeline.parameters.weights import update_excitations


def test_weights_follow_the_angle_and_the_law() -> None:
    """By hand: 2 g m more at 3 % and 0.1 rad, all turned by 0.2 rad, U (1 + a |U|); a force is no weight."""
    acting = (Excitation("a", "unbalance", 3, 2e-3, 0.3), Excitation("a", "force", 1, 5.0, 0.7))
    data = VibrationDataset(np.array([100.0]), ("a",), ((0, 0.0),), np.zeros((1, 1, 1), complex), acting)
    parameters = [
        ModelParameter("unbalance_magnitude", 0.03, "", 0, "a"),
        ModelParameter("unbalance_phase", 0.1, "", 0, "a"),
        ModelParameter("weight_angle", 0.2, ""),
        ModelParameter("weight_law", 40.0, "", 0, "real"),
        ModelParameter("weight_law", 30.0, "", 0, "imaginary"),
    ]
    weight, force = update_excitations(data, set_values(parameters, [1.0, -1.0, 1.0, 2.0, -1.0])).excitations
    size = 2e-3 * 1.03
    expected = size * np.exp(0.4j) * (1 + (80.0 - 30.0j) * size)
    assert weight.magnitude * np.exp(1j * weight.phase) == pytest.approx(expected, rel=1e-12)
    assert force.magnitude * np.exp(1j * force.phase) == pytest.approx(5.0 * np.exp(0.7j), rel=1e-12)
