"""The response at sensors by way of reference bearings: that of the whole system, with runs of several frequencies."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from conftest import Machine
from identification.test_output_error_fit import unstated

from pipeline.data.dataset import Excitation
from pipeline.data.sensors import project
from pipeline.data.simulate import simulate
from pipeline.problem.reference_response import SolvedRotor

STIFFNESS = 2e7
PROBES = ((0, 45.0), (1, 45.0), (1, 135.0), (3, 0.0), (5, 30.0), (5, 120.0))
BACKWARD = Excitation("shaker", "force", 2, 10.0, 0.3, "backward")


@pytest.mark.parametrize("stiffness", [1e5, 2e7, 1e9])
def test_the_response_is_that_of_the_whole_system(rotor_of: Machine, stiffness: float) -> None:
    """Any reference bearing gives the displacements that the full equation of motion has, at probes of any angle."""
    dataset = project(rotor_of.dataset, PROBES)
    predicted = SolvedRotor(rotor_of.rotor, dataset, stiffness).response.predict(rotor_of.bearings)
    np.testing.assert_allclose(predicted, dataset.displacement, rtol=1e-8, atol=1e-10 * np.abs(predicted).max())


def test_asynchronous_runs_and_a_residual_unbalance(rotor_of: Machine) -> None:
    """Runs of several frequencies; the residual unbalance acts in those that turn with the rotor alone."""
    speeds, given = rotor_of.speeds, (*rotor_of.excitations, BACKWARD)
    hidden = unstated(rotor_of, 3, 3e-5, 0.7)
    own = np.stack([*[speeds] * len(hidden), np.full(len(speeds), 200.0)], axis=1)
    complete = simulate(rotor_of.rotor, rotor_of.bearings, (*given, *hidden), own)
    equations = SolvedRotor(rotor_of.rotor, replace(complete, excitations=given), STIFFNESS, (3,)).response
    assert len(equations.blocks) == 2
    predicted = equations.predict(rotor_of.bearings, np.array([3e-5 * np.exp(0.7j)]))
    np.testing.assert_allclose(predicted, complete.displacement, rtol=1e-7, atol=1e-10 * np.abs(predicted).max())
