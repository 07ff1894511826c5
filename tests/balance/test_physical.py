"""The physical model as a predictor: against the direct problem, at other speeds, restored, and its two peers."""

from __future__ import annotations

from dataclasses import replace
from unittest.mock import Mock

import numpy as np
import physical_peers as module
import pytest
from conftest import examples
from hypothesis import given
from hypothesis import strategies as st
from physical_peers import carry, fit_physical, physical_of, physical_peers
from small_rig import AS_FOUND, CHANNELS, HEAVIEST, PLANES, SIZE, SmallRig, small_rig
from training import dense_jacobian

from pipeline.balance.physical import Physical, restore_physical
from pipeline.errors import DataError, IdentifiabilityError
from pipeline.identification.output_error_fit import OutputErrorFit, fit_output_error
from pipeline.identification.quality import output_error_quality
from pipeline.identification.training import FitSetup
from pipeline.identification.uncertainty import measure_uncertainty
from pipeline.problem.condition_noise import NO_LEVELS, condition_noise, spread_conditions, to_dataset
from pipeline.rotor.bearing_table import BearingTable

pytestmark = pytest.mark.slow  # one fit of a second or two for all

UNCERTAIN = {"weight_angle": 0.2, "weight_law": 100.0, "bow": 2e-6, "probe_gain": 0.05}
OFF = np.array([0.8, -0.6, 0.7, -0.5, 0.4, 0.5, -0.3, 0.6, -0.4])


@pytest.fixture(scope="module")
def rig() -> SmallRig:
    """A machine that is off in all that is uncertain."""
    return small_rig(np.random.default_rng(11), 30, deviations=UNCERTAIN, truth=OFF)


@pytest.fixture(scope="module")
def fit(rig: SmallRig, setup: FitSetup) -> OutputErrorFit:
    measurement = replace(rig.template, dataset=to_dataset(rig.conditions), drift=condition_noise(rig.conditions))
    return fit_output_error(measurement, setup)


@pytest.fixture(scope="module")
def model(rig: SmallRig, fit: OutputErrorFit) -> Physical:
    return physical_of(fit, rig.conditions)


def loads(count: int = 5) -> np.ndarray:
    rng = np.random.default_rng(12)
    return HEAVIEST * rng.random((count, 2)) * np.exp(2j * np.pi * rng.random((count, 2)))


def test_vibration_and_covariance_equal_those_of_the_direct_problem(model: Physical) -> None:
    """Oracle: the fitted problem solved for these weights, and its Jacobian, without the split into parts."""
    weights = loads()
    mean, covariance = model.predict(weights)
    problem = model._problem(weights)
    (direct,) = problem.predicted(model.weights)
    np.testing.assert_allclose(mean, direct[0].numpy().reshape(SIZE, -1).T, rtol=1e-9, atol=1e-15)
    slope = dense_jacobian(problem, model.weights)[: 2 * direct.numel()].numpy().reshape(SIZE, len(weights), 2, -1)
    along = (slope[:, :, 0] + 1j * slope[:, :, 1]).swapaxes(0, 1)
    expected = along @ model.covariance @ along.conj().swapaxes(1, 2)
    np.testing.assert_allclose(covariance, expected, atol=1e-8 * abs(expected).max())


def test_the_machine_is_predicted_to_the_stated_deviations(rig: SmallRig, model: Physical) -> None:
    """Oracle: the response of the machine as it is, at weights that no condition had."""
    weights = loads()
    mean, covariance = model.predict(weights)
    true = _respond(rig, weights, rig.bearings)
    deviation = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2).real)
    assert np.sqrt((abs((mean - true) / deviation) ** 2).mean()) < 2
    assert (deviation < 0.05 * abs(true).max()).all()


def _respond(rig: SmallRig, weights: np.ndarray, bearings: BearingTable) -> np.ndarray:
    """(C, D) m of the machine as it is, at the speeds of the bearings."""
    dataset = to_dataset(spread_conditions(weights, PLANES, bearings.speeds, CHANNELS))
    there = replace(rig.template, dataset=dataset, known=bearings).update(OFF)
    return there.response.predict(bearings, AS_FOUND).reshape(-1, len(weights)).T


def test_other_speeds_are_those_of_the_response_solved_there(rig: SmallRig, model: Physical) -> None:
    """Oracle: the whole response at the fitted coefficients and parameters, at speeds that no condition had."""
    speeds = np.array([90.0, 125.0, 150.0])
    moved, weights = carry(model, speeds), loads()
    eight = np.zeros((2, len(speeds), 8))
    eight[..., [0, 3, 4, 7]] = model.problem.unknowns(model.weights)[0][0, 0].numpy().reshape(2, 1, 4)
    bearings = BearingTable((0, 5), speeds, eight)
    dataset = to_dataset(spread_conditions(weights, PLANES, speeds, CHANNELS))
    there = replace(model.measurement, dataset=dataset, known=bearings, drift=NO_LEVELS)
    unbalance = model.problem.unbalance(model.weights)[0].numpy()
    expected = there.response.predict(bearings, unbalance).reshape(-1, len(weights)).T
    np.testing.assert_allclose(moved.predict(weights)[0], expected, rtol=1e-6, atol=1e-12)
    assert moved.noise.condition.shape == (3 * len(CHANNELS),) * 2
    true = _respond(rig, weights, replace(bearings, values=np.repeat(rig.bearings.values[:, :1], 3, axis=1)))
    assert np.linalg.norm(expected - true) < 0.02 * np.linalg.norm(true)


def test_no_other_speeds_with_known_coefficients_that_depend_on_it(model: Physical) -> None:
    known = model.measurement.known
    tilted = replace(known, values=known.values * np.array([1.0, 1.1])[None, :, None])
    with pytest.raises(DataError, match="give them as values"):
        carry(replace(model, measurement=replace(model.measurement, known=tilted)), np.array([90.0]))


def test_what_was_stored_predicts_the_same(
    rig: SmallRig, fit: OutputErrorFit, model: Physical, setup: FitSetup
) -> None:
    measurement = replace(rig.template, dataset=to_dataset(rig.conditions), drift=condition_noise(rig.conditions))
    back = restore_physical(measurement, measure_uncertainty(fit, output_error_quality(fit)), rig.conditions)
    for one, other in zip(model.predict(loads()), back.predict(loads()), strict=True):
        np.testing.assert_allclose(other, one, atol=1e-6 * abs(one).max())
    np.testing.assert_allclose(
        back.noise.condition, model.noise.condition, atol=0.02 * abs(model.noise.condition).max()
    )


@given(st.floats(0.0, 2 * np.pi))
@examples(15)
def test_weights_that_turn_turn_the_response(model: Physical, angle: float) -> None:
    """With any law of their size: what they add to the baseline turns as they do, and its derivative stays."""
    turn, weights = np.exp(1j * angle), loads()
    _, baseline = model.influence_at(weights[0])
    here, there = (model.predict(w)[0] - baseline for w in (weights, weights * turn))
    np.testing.assert_allclose(there, here * turn, atol=1e-10 * abs(here).max())
    slopes = [model.influence_at(w)[0] for w in (weights[0], weights[0] * turn)]
    np.testing.assert_allclose(slopes[1], slopes[0], rtol=1e-10)


def test_without_a_law_the_response_is_linear(rig: SmallRig, setup: FitSetup) -> None:
    """The part of each plane adds up, and the derivative is the difference."""
    model, weights = fit_physical(replace(rig.template, parameters=()), setup, rig.conditions), loads(2)
    both, one, other, none = model.predict(np.array([weights[0] + weights[1], *weights, [0, 0]]))[0]
    np.testing.assert_allclose(both, one + other - none, atol=1e-10 * abs(both).max())
    slope, baseline = model.influence_at(weights[0])
    np.testing.assert_allclose(baseline + slope @ weights[0], one, atol=1e-10 * abs(both).max())


def test_one_fit_serves_both_peers(rig: SmallRig, setup: FitSetup, monkeypatch: pytest.MonkeyPatch) -> None:
    """A split is fitted once; other conditions again. The blend has no other speeds, the physical model has."""
    counted = Mock(wraps=fit_physical)
    monkeypatch.setattr(module, "fit_physical", counted)
    plain = replace(rig.template, parameters=())
    peers, train, elsewhere = physical_peers(plain, setup, 0.01), rig.conditions, np.array([125.0])
    assert peers["blend"](train, train.speeds).physical is peers["physical"](train, train.speeds)
    assert peers["physical"](train, elsewhere).predict(loads())[0].shape == (5, len(CHANNELS))
    assert counted.call_count == 1
    with pytest.raises(IdentifiabilityError, match="the physical model alone"):
        peers["blend"](train, elsewhere)
    peers["physical"](train.at([0]), train.speeds[:1])
    assert counted.call_count == 2
