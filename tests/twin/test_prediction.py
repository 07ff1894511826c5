"""Predictions: responses and time curves; sums of runs, splines over the speed; and when they have no answer."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from conftest import Machine, MachineFactory
from hypothesis import given
from hypothesis import strategies as st

from pipeline.config.compose import compose_config
from pipeline.data.dataset import Excitation, VibrationDataset, subtract_baseline
from pipeline.data.simulate import simulate
from pipeline.errors import ConfigError
from pipeline.identification.fit import fit
from pipeline.identification.training import setup_of
from pipeline.twin.prediction import compare_held_out, error_percent, find_shares, predict, sample_motion

FIRST = Excitation("first", "unbalance", 2, 1e-4, 0.0)
SECOND = Excitation("second", "unbalance", 4, 2e-4, 1.0)
BOTH = (Excitation("both", "unbalance", 2, 6e-5, 0.5), Excitation("both", "unbalance", 4, 1.5e-4, 3.5))


@pytest.fixture(scope="module")
def rotor_of(machine: MachineFactory) -> Machine:
    """The rotor with two discs at 29 speeds."""
    return machine("experiment=noisy_stiffness", "machine.speeds.start_rpm=400", "machine.speeds.step_rpm=200")


def runs_of(machine: Machine, *acting: Excitation, hidden: float = 0.0) -> VibrationDataset:
    """Readings without noise; ``hidden`` kg m is an unbalance in every run that nobody states."""
    runs = tuple(dict.fromkeys(one.run for one in acting))
    more = tuple(Excitation(run, "unbalance", 3, hidden, 2.0) for run in runs) if hidden else ()
    return replace(simulate(machine.rotor, machine.bearings, (*acting, *more)), excitations=acting)


def test_a_sum_of_runs_is_predicted_to_rounding(rotor_of: Machine) -> None:
    data = runs_of(rotor_of, FIRST, SECOND, *BOTH)
    summed = data.displacement @ find_shares(data, [0, 1], BOTH, data.speeds, False)
    assert error_percent(summed, data.displacement[..., 2]) < 1e-9


def test_a_residual_unbalance_needs_a_run_more(rotor_of: Machine) -> None:
    """Two runs and what they hide are three unknowns; a run as found gives the third, or is subtracted."""
    data = runs_of(rotor_of, FIRST, SECOND, *BOTH, Excitation("as_found", "unbalance", 2, 0.0, 0.0), hidden=5e-5)
    assert find_shares(data, [0, 1], BOTH, data.speeds, True) is None
    summed = data.displacement @ find_shares(data, [0, 1, 3], BOTH, data.speeds, True)
    assert error_percent(summed, data.displacement[..., 2]) < 1e-9
    less = subtract_baseline(data, "as_found")
    again = less.displacement @ find_shares(less, [0, 1], BOTH, less.speeds, False)
    assert error_percent(again, less.displacement[..., 2]) < 1e-9


@pytest.mark.parametrize(
    "wanted",
    [
        Excitation("x", "unbalance", 3, 1e-4, 0.0),
        Excitation("x", "force", 2, 10.0, 0.0),
        Excitation("x", "force", 2, 10.0, 0.0, "backward"),
    ],
)
def test_another_plane_kind_or_whirl_has_no_answer(rotor_of: Machine, wanted: Excitation) -> None:
    data = runs_of(rotor_of, FIRST, SECOND)
    assert find_shares(data, [0, 1], (wanted,), data.speeds, False) is None
    assert find_shares(data, [0, 1], (FIRST,), 0.5 * data.speeds, False) is None  # another frequency


def test_the_model_and_its_rivals_beside_each_other(rotor_of: Machine) -> None:
    """On clean data: a plane and speeds that the fit never saw; a range at the end has no interpolation."""
    held = [
        "training.holdout_runs=[second,both]",
        "training.holdout_range=[3000 rpm,4000 rpm]",
        "training.holdout_every=7",
    ]
    said = {}
    for name, override in (("inside", held), ("at the end", [held[0], "training.holdout_range=[5500 rpm,6000 rpm]"])):
        config = compose_config(["experiment=noisy_stiffness", *override])
        measurement = rotor_of.measured(runs_of(rotor_of, FIRST, SECOND, *BOTH), config)
        found = fit(measurement, setup_of(config))
        judged = compare_held_out(measurement, found.table(measurement.known), None, config.training)
        said[name] = {what: entry["rival_error_percent"] for what, entry in judged.items()}
        assert all(entry["model_error_percent"] < 0.1 for entry in judged.values())
    assert (said["inside"]["run second"], said["inside"]["run both"]) == (None, None)
    assert 0 < said["inside"]["range of speeds, 3000 to 4000 rpm"] < 100
    assert said["at the end"] == dict.fromkeys(("run second", "run both", "range of speeds, 5600 to 6000 rpm"))


@pytest.mark.parametrize(
    ("experiment", "given", "words"),
    [
        ("noisy_stiffness", "[100 rpm,200 rpm]", "must hold some of the speeds and leave some"),
        ("noisy_stiffness", "[1 rpm,9999 rpm]", "must hold some of the speeds and leave some"),
        ("hydrostatic_stiffness", "[2000 rpm,3000 rpm]", "holdout_range must go with loss=response"),
    ],
)
def test_mistakes_of_a_range_are_named(rotor_of: Machine, experiment: str, given: str, words: str) -> None:
    config = compose_config([f"experiment={experiment}", f"training.holdout_range={given}"])
    measurement = rotor_of.measured(runs_of(rotor_of, FIRST, SECOND), config)
    with pytest.raises(ConfigError, match=words):
        fit(measurement, setup_of(config))


def test_a_range_ascends() -> None:
    with pytest.raises(ConfigError, match="from <= to"):
        compose_config(["training.holdout_range=[3000 rpm,2000 rpm]"])


@given(
    amplitudes=st.lists(st.floats(1e-9, 1e-3), min_size=2, max_size=2),
    phases=st.lists(st.floats(-math.pi, math.pi), min_size=2, max_size=2),
    speed=st.floats(1.0, 1000.0),
)
def test_time_curve(amplitudes: list[float], phases: list[float], speed: float) -> None:
    """method.md, section 1: q(t) = Re(Q e^{jwt}) = |Q| cos(w t + phase), zero-to-peak, over two turns."""
    time, curve = sample_motion(np.array(amplitudes) * np.exp(1j * np.array(phases)), speed)
    assert (time[0], time[-1]) == (0, pytest.approx(2 * 2 * math.pi / speed))
    wanted = np.array(amplitudes) * np.cos(speed * time[:, None] + np.array(phases))
    np.testing.assert_allclose(curve, wanted, atol=1e-12)
    np.testing.assert_allclose(curve[-1], curve[0], atol=1e-12)
    assert np.abs(curve).max(axis=0) == pytest.approx(amplitudes, rel=1e-3)


def test_prediction_is_the_response_of_that_node(hydrostatic: Machine) -> None:
    """Paper, section 4.2.1: x and y of a node for one unbalance run, here one whose response is known."""
    own = tuple(e for e in hydrostatic.excitations if e.run == "couple")
    found = predict(hydrostatic.rotor, hydrostatic.bearings, own, 4)
    np.testing.assert_allclose(found.displacement, hydrostatic.response[:, 16:18, 2], rtol=1e-12)
    np.testing.assert_array_equal(found.speeds, hydrostatic.speeds)
    twin = replace(found, displacement=found.displacement * (1 + 0.01j))
    np.testing.assert_allclose(twin.error_percent(found), 1.0, rtol=1e-10)


def test_prediction_changes_with_the_coefficients(hydrostatic: Machine) -> None:
    """Sensitivity: 1e-6 more stiffness changes the vibration in proportion; the error is of first order."""
    own = tuple(e for e in hydrostatic.excitations if e.run == "couple")
    true = predict(hydrostatic.rotor, hydrostatic.bearings, own, 4)
    errors = []
    for size in (1e-6, 2e-6):
        values = hydrostatic.bearings.values.copy()
        values[..., :4] *= 1 + size
        changed = predict(hydrostatic.rotor, replace(hydrostatic.bearings, values=values), own, 4)
        errors.append(changed.error_percent(true))
    np.testing.assert_allclose(errors[1], 2 * errors[0], rtol=1e-3)
