"""The output error with noise in levels and a prior of sizes: rows, their derivatives, and what the prior pulls."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch
from conftest import examples
from hypothesis import given
from hypothesis import strategies as st
from running import composed
from small_rig import SIZE, SmallRig, small_rig, with_noise
from small_rotor import FITTED
from training import assert_columns, assert_normal

from pipeline.identification.answer import conclude
from pipeline.identification.linear_start import start_at
from pipeline.identification.output_error_fit import OutputErrorFit, fit_output_error
from pipeline.identification.output_error_start import align_weights, drawn_basis
from pipeline.identification.problem import OutputError, output_error
from pipeline.identification.training import setup_of
from pipeline.problem.condition_noise import NO_LEVELS
from pipeline.problem.measurement import Guess, Measurement

pytestmark = pytest.mark.slow
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


def test_derivatives_and_normal_equations_are_those_of_the_rows(within: tuple[OutputError, torch.Tensor]) -> None:
    assert_columns(*within, at_once=False)
    assert_normal(*within)


def test_without_levels_the_sizes_are_in_both_ways_to_the_normal_equations() -> None:
    """Summed speed by speed, and by the Jacobian."""
    measurement = with_noise(small_rig(np.random.default_rng(2), 4))
    problem, weights = problem_of(replace(measurement, drift=NO_LEVELS, guess=Guess(1e6, 1e3, 30.0)))
    assert_normal(problem, weights)
    assert problem.rows(weights).shape[-1] - problem.places.size - problem.readings.size == len(problem.active)


def test_the_rows_are_squares_under_the_covariance_of_the_levels() -> None:
    """Oracle: 2 e^H C^-1 e of each condition, with the covariance itself inverted."""
    rig = small_rig(np.random.default_rng(3), 5)
    problem, weights = problem_of(with_noise(rig))
    (predicted,), (measured,) = problem.predicted(weights), problem.readings.measured
    off = (predicted - measured)[0].flatten(0, 1).numpy()
    expected = 2 * np.einsum("dr,de,er->", off.conj(), np.linalg.inv(rig.root @ rig.root.conj().T), off).real
    assert float(problem.rows(weights)[0, 0][: 2 * SIZE * 5].square().sum()) == pytest.approx(expected, rel=1e-9)


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


@given(st.floats(0.0, 2 * np.pi))
@examples(10)
def test_weights_turn_back_by_any_angle(angle: float) -> None:
    """Law: turned readings turn the start by as much, and leave it as far from the answer as it was."""
    rig = turned_rig()
    starts = [align_weights(turn(with_noise(rig), a)).parameter_values[0] * WIDE for a in (0.0, angle)]
    assert abs(np.angle(np.exp(1j * (starts[1] - starts[0] - angle)))) < 1e-9
    assert abs(starts[0]) < 1.0


@pytest.mark.parametrize("degrees", [75, 180, 290])
def test_weights_turned_by_any_angle_end_at_the_same_answer(degrees: int) -> None:
    """Nobody wrote down where the tacho stands: bearings and loss are the same, whatever the angle."""
    rig, setup = turned_rig(), setup_of(composed(*FITTED))
    fits = [fit_output_error(turn(with_noise(rig), np.radians(d)), setup) for d in (0, degrees)]
    (here,), (there,) = (conclude(fit).parameters for fit in fits)
    apart = WIDE * (there.value - here.value) - np.radians(degrees)
    assert abs(np.angle(np.exp(1j * apart))) < 0.2 * WIDE * here.left
    values = [fit.problem.unknowns(fit.weights)[0][0, 0].numpy() for fit in fits]
    assert np.abs((values[1] - values[0]) / spread(fits[0])).max() < 0.1  # the angle's own prior pulls a little


def spread(fit: OutputErrorFit) -> np.ndarray:
    """(A,) deviations of the coefficients, which do not depend on the speed."""
    return np.asarray(fit.problem.unknown_deviation(fit.weights)[0, 0])


WIDE = 1.4
"""rad: prior deviation of the common angle."""


@cache
def turned_rig() -> SmallRig:
    """Eight conditions whose weights' angle is uncertain."""
    return small_rig(np.random.default_rng(5), 8, drift=5e-8, deviations={"weight_angle": WIDE})


def turn(measurement: Measurement, angle: float) -> Measurement:
    """All readings turned, as another place of the tacho would."""
    data = measurement.dataset
    turned = replace(data, displacement=data.displacement * np.exp(1j * angle))
    return replace(measurement, dataset=turned, solved=measurement.response)
