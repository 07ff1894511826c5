"""The answer of a fit: what was fitted with the coefficients of a machine not built as modelled, and what is said."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from conftest import Artifacts
from running import composed
from small_rotor import DIRECT, FITTED, NOISE, small_machine, with_weights
from training import assert_columns, assert_normal

from pipeline.config.compose import compose_config
from pipeline.data.sensors import measure
from pipeline.data.simulate import add_noise
from pipeline.identification.answer import conclude
from pipeline.identification.output_error_fit import OutputErrorFit, fit_output_error
from pipeline.identification.output_error_start import prepare_output_error
from pipeline.identification.problem import OutputError
from pipeline.identification.quality import output_error_quality
from pipeline.identification.training import setup_of
from pipeline.parameters.as_built import AsBuiltConfig, build_rotor, simulate_as_built
from pipeline.parameters.model import ModelParameter, model_parameters
from pipeline.problem.configured import build_measurement, configure_excitations, configure_sensors
from pipeline.problem.measurement import Measurement
from pipeline.rotor.bearing_table import BearingTable
from pipeline.rotor.stored import load_modelled_bearings, load_rotor
from pipeline.units import RAD_S_PER_RPM

CONFIG = compose_config(
    [
        "stage=train",
        "experiment=realistic",
        "machine.speeds={start_rpm: 600, stop_rpm: 5400, step_rpm: 240}",
        "identify.unknowns=[kxx,kyy]",
        "model.width=6",
    ]
)
SETUP = setup_of(CONFIG)
EXACT = AsBuiltConfig()


def measured(built: AsBuiltConfig, seed: int = 0, runout: bool = False) -> tuple[Measurement, BearingTable]:
    """Readings of the machine as it was built, with the sensors' noise, and the truth."""
    machine = CONFIG.machine
    speeds = np.array(machine.speeds.rpm()) * RAD_S_PER_RPM
    rotor = load_rotor(machine.rotor)
    bearings, acting = load_modelled_bearings(machine.rotor, machine.bearings, speeds), configure_excitations(CONFIG)
    generator = np.random.default_rng(seed)
    complete = simulate_as_built(build_rotor(machine.rotor, built), built, bearings, acting, None, generator)
    sensors = configure_sensors(CONFIG, rotor)
    if not runout:
        sensors = replace(sensors, runout=0.0, slow_roll_readings=0)
    data = measure(replace(complete, excitations=acting), sensors, generator)
    return build_measurement(CONFIG, rotor, data, bearings), bearings


def only(measurement: Measurement, *kinds: str) -> Measurement:
    """The same with the parameters of these kinds alone."""
    return replace(measurement, parameters=tuple(p for p in measurement.parameters if p.kind in kinds))


def worst_error(fit: OutputErrorFit, truth: BearingTable) -> float:
    """Percent."""
    found = fit.identified.table(fit.problem.measurement.updated_known).values
    return 100 * float(np.abs(found / truth.values - 1)[..., [0, 3]].mean(axis=1).max())


@pytest.fixture(scope="module")
def problem() -> tuple[OutputError, torch.Tensor]:
    """All kinds that the experiment has, at weights that are none of a minimum."""

    start = prepare_output_error(measured(EXACT)[0], SETUP)
    weights = start.weights.clone()
    places = start.problem.places
    weights[..., places.n_coefficients :] = torch.linspace(-0.5, 0.5, places.n_rest, dtype=torch.float64)
    return start.problem.update(0.9 * weights), weights


@pytest.mark.slow
def test_the_derivative_is_that_of_autograd(problem: tuple[OutputError, torch.Tensor]) -> None:
    """By model parameters, too; the normal equations are those of the full derivative."""
    assert_columns(*problem)
    assert_normal(*problem)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "built"),
    [
        ("youngs_modulus", {"youngs_modulus": 0.02}),
        ("disc_mass", {"disc_mass": 0.01}),
        ("coupling_stiffness", {"coupling_stiffness": 3e5}),
    ],
)
def test_what_the_model_is_wrong_in_is_found(kind: str, built: dict[str, float]) -> None:
    """By one prior deviation; without it the coefficients are wrong, and the mismatch test says so."""
    data, truth = measured(EXACT.model_copy(update=built))
    wrong, right = (fit_output_error(only(data, *kinds), SETUP) for kinds in ((), (kind,)))
    for one in conclude(right).parameters:
        assert abs(one.value - 1.0) <= 4 * one.left, one.name
        assert one.left < 0.15
    assert worst_error(right, truth) < worst_error(wrong, truth)
    probability = [output_error_quality(fit).summary["fit"]["mismatch"]["probability"] for fit in (wrong, right)]
    assert probability[0] < 1e-3 < probability[1]


def test_what_slow_roll_leaves_of_the_runout_is_found() -> None:
    """As vectors of the size of its noise; where they are not fitted, the mismatch test says so."""
    data, _ = measured(EXACT, runout=True)
    without = measured(EXACT)[0].dataset.displacement
    wrong, right = (fit_output_error(only(data, *kinds), SETUP) for kinds in ((), ("runout",)))
    left = (data.dataset.displacement - without)[..., :3].mean(axis=(0, 2))  # (P,) the noise is that of both
    for one in conclude(right).parameters:
        part = getattr(left[one.place], {"real": "real", "imaginary": "imag"}[one.detail])
        assert abs(one.shift - part) < 3e-8, one.name
        assert one.left < 0.3
    probability = [output_error_quality(fit).summary["fit"]["mismatch"]["probability"] for fit in (wrong, right)]
    assert probability[0] < 1e-3 < probability[1]


def test_what_the_data_do_not_tell_stays_at_its_prior() -> None:
    """A prior far narrower than what the data could tell leaves value and deviation as they were."""
    data, _ = measured(EXACT)
    narrow = ModelParameter("density", 1e-9, "")
    (one,) = conclude(fit_output_error(replace(data, parameters=(narrow,)), SETUP)).parameters
    assert one.left == pytest.approx(1.0, abs=1e-6)
    assert abs(one.value) < 1e-5


def test_an_uncertain_model_widens_the_deviations() -> None:
    """The information of the weights falls by what the parameters take of it, and by no more."""
    data, _ = measured(EXACT)
    alone, joint = (fit_output_error(one, SETUP) for one in (only(data), data))
    count = min(one.problem.places.n_coefficients for one in (alone, joint))
    kept = (alone.problem.fitted()[:count] & joint.problem.fitted()[:count]).numpy()
    first, second = (np.diag(fit.covariance())[:count][kept] for fit in (alone, joint))
    assert (second > 0.9 * first).all()
    assert (second > 1.2 * first).any()


@pytest.mark.slow
def test_the_experiment_finds_how_the_machine_was_built(artifacts: Artifacts) -> None:
    """What the graph made of all sixteen coefficients: every parameter of the rotor within four deviations."""
    folder = artifacts("realistic", "training.json", "metrics.json")
    found = json.loads((folder / "training.json").read_text())["model_parameters"]
    built = CONFIG.machine.as_built
    for name, one in found.items():
        kind = name.partition(" ")[0]
        if not kind.startswith(("unbalance", "runout")):  # those of weights and probes were drawn
            assert abs(one["value"] - (getattr(built, kind) or 0.0)) <= 4 * one["deviation"], name
    assert found["youngs_modulus"]["deviation"] < 0.2 * found["youngs_modulus"]["prior_deviation"]
    within = json.loads((folder / "metrics.json").read_text())["within_95_percent_interval"]
    assert np.mean([share for of in within.values() for share in of.values()]) > 80


@pytest.mark.slow
def test_a_fit_finds_what_all_weights_have_in_common_and_the_bow() -> None:
    """Weights of three sizes at two angles; the machine is off by a prior deviation and a half in each number."""
    measurement, bearings = small_machine(DIRECT)
    data = with_weights(measurement.dataset, ("a", 2e-4, 0.3), ("b", 5e-4, 2.0), ("c", 8e-4, 0.3), ("d", 3e-4, -2.0))
    deviations = {"weight_angle": 0.05, "weight_law": 100.0, "bow": 2e-6}
    parameters = (
        *model_parameters(deviations, measurement.rotor, data, bearings, measurement.unknowns),
        ModelParameter("bearing_position", 0.01, "node 0", 0),
    )
    stated = replace(measurement, dataset=data, parameters=parameters)
    truth = 1.5 * (-1.0) ** (np.arange(len(parameters)) + 1)
    exact = replace(data, displacement=stated.update(truth).response.predict(bearings))
    read = add_noise(exact, np.full(data.displacement.shape, NOISE), np.random.default_rng(3))
    found = fit_output_error(replace(stated, dataset=read), setup_of(composed(*FITTED)))
    for one, value in zip(conclude(found).parameters, truth, strict=True):
        assert abs(one.value - value) < 4 * one.left, one.name
        if one.kind != "bearing_position":
            assert one.left < 0.3, one.name
    table = found.identified.table(bearings).values[..., [0, 3]]
    assert table == pytest.approx(bearings.values[..., [0, 3]], rel=0.05)
