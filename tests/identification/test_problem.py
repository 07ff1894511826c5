"""Rows of the output error, their derivatives and normal equations; noise in levels, and a prior of sizes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from conftest import Machine
from problem.test_reference_response import BACKWARD, PROBES
from running import composed
from small_rig import SIZE, small_rig, with_noise
from small_rotor import FITTED
from training import assert_columns, assert_normal

from identification.test_output_error_fit import fit_of
from pipeline.data.sensors import NoiseModel, Sensors, measure
from pipeline.data.simulate import simulate
from pipeline.identification.linear_start import start_at
from pipeline.identification.output_error_fit import OutputErrorFit, fit_output_error
from pipeline.identification.output_error_start import drawn_basis
from pipeline.identification.problem import OutputError, output_error
from pipeline.identification.training import setup_of
from pipeline.problem.condition_noise import NO_LEVELS
from pipeline.problem.measurement import Guess, Measurement

UNCERTAIN = {"weight_angle": 0.2, "weight_law": 100.0, "bow": 2e-6}


def problem_of(measurement: Measurement) -> tuple[OutputError, torch.Tensor]:
    """The problem and weights that are not its minimum."""
    setup, speeds = setup_of(composed(*FITTED)), measurement.dataset.speeds
    sizes = measurement.guess.sizes(measurement.unknowns)
    basis = drawn_basis(setup, measurement, measurement.dataset.points)
    basis = replace(basis, model=replace(basis.model, scale=tuple(map(tuple, sizes.tolist()))))
    problem = output_error(measurement, basis, 1e-4)
    weights = start_at(problem, np.repeat(sizes[:, None], len(speeds), axis=1))
    moved = torch.linspace(-0.3, 0.4, weights.shape[-1], dtype=torch.float64).expand(weights.shape)
    return problem, weights + moved


@pytest.fixture(scope="module")
def within() -> tuple[OutputError, torch.Tensor]:
    """Noise in levels, sizes with a prior, all sorts of weights."""
    measurement = with_noise(small_rig(np.random.default_rng(1), 6, deviations=UNCERTAIN))
    return problem_of(replace(measurement, guess=Guess(1e6, 1e3, 30.0)))


@pytest.mark.slow
def test_derivatives_and_normal_equations_are_those_of_the_rows(within: tuple[OutputError, torch.Tensor]) -> None:
    assert_columns(*within, at_once=False)
    assert_normal(*within)


@pytest.mark.slow
def test_without_levels_the_sizes_are_in_both_ways_to_the_normal_equations() -> None:
    """Summed speed by speed, and by the Jacobian."""
    measurement = with_noise(small_rig(np.random.default_rng(2), 4))
    problem, weights = problem_of(replace(measurement, drift=NO_LEVELS, guess=Guess(1e6, 1e3, 30.0)))
    assert_normal(problem, weights)
    assert problem.rows(weights).shape[-1] - problem.places.size - problem.readings.size == len(problem.active)


@pytest.mark.slow
def test_the_rows_are_squares_under_the_covariance_of_the_levels() -> None:
    """Oracle: 2 e^H C^-1 e of each condition, with the covariance itself inverted."""
    rig = small_rig(np.random.default_rng(3), 5)
    problem, weights = problem_of(with_noise(rig))
    (predicted,), (measured,) = problem.predicted(weights), problem.readings.measured
    off = (predicted - measured)[0].flatten(0, 1).numpy()
    expected = 2 * np.einsum("dr,de,er->", off.conj(), np.linalg.inv(rig.root @ rig.root.conj().T), off).real
    assert float(problem.rows(weights)[0, 0][: 2 * SIZE * 5].square().sum()) == pytest.approx(expected, rel=1e-9)


@pytest.mark.slow
def test_the_prior_of_sizes_holds_what_the_data_leave_open_and_nothing_else() -> None:
    """Damping so small that no reading tells it follows its guess, by the share that the linear theory says; stiffness
    stays where the data have it."""
    rig = small_rig(np.random.default_rng(4), eight=(2e6, 0.0, 0.0, 1.2e6, 5.0, 0.0, 0.0, 5.0))
    prior, values, covariances = np.log(3.0), [], []
    for damping in (5.0, 7.0):
        fit = fit_output_error(replace(with_noise(rig), guess=Guess(1e6, damping, 3.0)), setup_of(composed(*FITTED)))
        values.append(np.log(fit.problem.unknowns(fit.weights)[0][0, 0].numpy()))
        function = float(fit.problem.features[0, 0, 0])  # a constant's, by which its weight is its logarithm
        count = len(fit.problem.active)
        covariances.append(function**2 * fit.problem.covariance(fit.weights)[0][:count, :count])
    moved, covariance = values[1] - values[0], np.mean(covariances, axis=0)
    deviation = np.sqrt(np.diag(covariance))
    stiff, damp = [0, 1, 4, 5], [2, 3, 6, 7]
    assert np.abs(moved[stiff] / deviation[stiff]).max() < 0.5
    assert np.abs(values[0][stiff] - np.log([2e6, 1.2e6] * 2)).max() < 4 * deviation[stiff].max()
    # Normal priors pass a step of all guesses of damping on by the covariance over their own variance, to first order.
    expected = covariance[np.ix_(damp, damp)].sum(axis=1) / prior**2 * np.log(7.0 / 5.0)
    assert moved[damp] == pytest.approx(expected, rel=0.5)
    assert (deviation[damp] > 0.5 * prior).all()


@pytest.fixture(scope="module")
def full_problem(rotor_of: Machine) -> OutputErrorFit:
    """A problem with cross-coupled coefficients, a shaker's own frequency and a balance plane."""
    own = np.stack([*[rotor_of.speeds] * 3, np.full(len(rotor_of.speeds), 200.0)], axis=1)
    clean = simulate(rotor_of.rotor, rotor_of.bearings, (*rotor_of.excitations, BACKWARD), own)
    dataset = measure(clean, Sensors(PROBES, NoiseModel(0.0, 0.01)), np.random.default_rng(1))
    return fit_of(
        rotor_of, dataset, 0.01, "identify.unknowns=[kxx,kxy,kyx,kyy]", "identify.unbalance_planes=[2]", "model.width=5"
    )


@pytest.mark.slow
def test_the_jacobian_is_that_of_automatic_differentiation(full_problem: OutputErrorFit) -> None:
    """Closed-form derivatives against torch's."""
    moved = torch.randn(full_problem.weights.shape, generator=torch.Generator().manual_seed(0))
    assert_columns(full_problem.problem, full_problem.weights + 0.01 * moved)


def test_the_normal_equations_are_those_of_the_dense_jacobian(full_problem: OutputErrorFit) -> None:
    assert_normal(full_problem.problem, full_problem.weights)
