"""The fit by the output error: clean and noisy data, few sensors, bad points, structures, and noise estimated."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from conftest import Machine, MachineFactory, bearings_of
from small_rotor import DIRECT, small_machine
from training import assert_close

from pipeline.config.compose import compose_config
from pipeline.data.dataset import Excitation, VibrationDataset, subtract_baseline
from pipeline.data.sensors import NoiseModel, Sensors, list_directions, measure, project
from pipeline.data.simulate import simulate
from pipeline.errors import IdentifiabilityError
from pipeline.identification.answer import conclude
from pipeline.identification.fit import default_setup, fit, loss_of
from pipeline.identification.identified import answer_of
from pipeline.identification.output_error_fit import OutputErrorFit, fit_output_error
from pipeline.identification.training import setup_of
from pipeline.problem.determination import relative_deviation


def noisy(machine: Machine, noise: float, seed: int, *more: Excitation) -> VibrationDataset:
    """Probes at the bearings with multiplicative noise."""
    clean = simulate(machine.rotor, machine.bearings, (*machine.excitations, *more))
    sensors = Sensors(list_directions(machine.rotor.bearing_nodes), NoiseModel(0.0, noise))
    return measure(clean, sensors, np.random.default_rng(seed))


def fit_of(machine: Machine, dataset: VibrationDataset, noise: float, *overrides: str) -> OutputErrorFit:
    """The fit that the experiment's configuration makes."""
    config = compose_config(["experiment=noisy_stiffness", *overrides])
    measurement = replace(machine.measured(dataset, config), noise=NoiseModel(0.0, noise))
    return fit_output_error(measurement, setup_of(config))


def unstated(machine: Machine, node: int, size: float, angle: float, *more: str) -> tuple[Excitation, ...]:
    """A residual unbalance in every run with weights, and in ``more`` runs."""
    runs = dict.fromkeys([*(e.run for e in machine.excitations), *more])
    return tuple(Excitation(run, "unbalance", node, size, angle) for run in runs)


def mean_square(fit: OutputErrorFit) -> float:
    """Of the deviations over their noise: 1 where nothing but noise is left."""
    return float(fit.problem.loss(fit.weights)) ** 2


def worst(machine: Machine, fit: OutputErrorFit, *names: str) -> float:
    """Of the median errors over speed, of these coefficients (kxx and kyy) at every bearing."""
    found, true = fit.identified.table(machine.bearings), machine.bearings
    off = [np.abs(found.coefficient(name) / true.coefficient(name) - 1) for name in names or ("kxx", "kyy")]
    return float(np.median(off, axis=-1).max())


def test_clean_data_give_the_modelled_coefficients(rotor_of: Machine) -> None:
    """Where there is no noise, nothing but what the network can't follow is left."""
    assert worst(rotor_of, fit_of(rotor_of, noisy(rotor_of, 0.0, 0), 1e-6)) < 7e-6


@pytest.mark.slow
def test_a_residual_unbalance_is_found_with_the_coefficients(rotor_of: Machine) -> None:
    """Of a third of the trial weights, at a disc; without the plane the coefficients are spoilt."""
    acting = (*rotor_of.excitations, *unstated(rotor_of, 4, 3e-5, 1.0))
    complete = simulate(rotor_of.rotor, rotor_of.bearings, acting)
    sensors = Sensors(list_directions(rotor_of.rotor.bearing_nodes), NoiseModel(0.0, 1e-3))
    dataset = measure(replace(complete, excitations=rotor_of.excitations), sensors, np.random.default_rng(0))
    with_plane = fit_of(rotor_of, dataset, 1e-3, "identify.unbalance_planes=[4]")
    assert abs(conclude(with_plane).uncertainty.residual_unbalance[0] - 3e-5 * np.exp(1j)) < 1e-3 * 3e-5
    assert worst(rotor_of, with_plane) < 0.0025
    assert worst(rotor_of, fit_of(rotor_of, dataset, 1e-3)) > 0.4


def test_a_baseline_cancels_the_residual_unbalance(rotor_of: Machine) -> None:
    acting = (*rotor_of.excitations, *unstated(rotor_of, 2, 8e-5, 2.0, "as_found"))
    complete = simulate(rotor_of.rotor, rotor_of.bearings, acting)
    seen = project(replace(complete, excitations=rotor_of.excitations), list_directions((1, 5)))
    less = subtract_baseline(seen, "as_found")
    wanted = project(rotor_of.dataset, list_directions((1, 5)))
    assert less.runs == rotor_of.dataset.runs
    size = np.abs(seen.displacement).max()
    np.testing.assert_allclose(less.displacement, wanted.displacement, rtol=0, atol=1e-9 * size)
    assert worst(rotor_of, fit_of(rotor_of, less, 1e-6)) < 7e-6


@pytest.mark.slow
@pytest.mark.parametrize("guess", ["1e6 N/m", pytest.param("2e8 N/m", marks=pytest.mark.nightly)])
def test_sensors_too_few_for_the_forces_find_the_same_answer_from_any_guess(
    machine: MachineFactory, guess: str
) -> None:
    """Three probes, four bearing forces: there is no linear start. At all 591 speeds: 0.5 % (docs/noise.md)."""
    whole = machine("experiment=noisy_stiffness")
    sensors = Sensors(((1, 45.0), (1, 135.0), (5, 10.0)), NoiseModel(0.0, 0.01))
    dataset = measure(whole.dataset, sensors, np.random.default_rng(0))
    fit = fit_of(whole, dataset, 0.01, f"model.initial_stiffness={guess}")
    assert fit.start.from_guess
    assert abs(mean_square(fit) - 1) < 4 / np.sqrt(dataset.displacement.size)
    assert worst(whole, fit) < 0.01


@pytest.mark.slow
def test_one_probe_cannot_tell_all_coefficients(rotor_of: Machine) -> None:
    dataset = measure(rotor_of.dataset, Sensors(((2, 0.0),), NoiseModel(0.0, 0.01)), np.random.default_rng(0))
    config = compose_config(["experiment=noisy_stiffness", "identify.unknowns=[kxx,kxy,kyx,kyy,cxx,cxy,cyx,cyy]"])
    with pytest.raises(IdentifiabilityError, match="more than 4 of 16 unknowns at a speed"):
        fit(rotor_of.measured(dataset, config), setup_of(config))


@pytest.mark.slow
def test_bad_points_are_found_and_do_little(rotor_of: Machine) -> None:
    dataset = noisy(rotor_of, 0.01, 3)
    spoilt = np.random.default_rng(5).random(dataset.displacement.shape) < 0.02
    shifted = np.where(spoilt, 1.1 * dataset.displacement, dataset.displacement)
    fit = fit_of(rotor_of, replace(dataset, displacement=shifted), 0.01)
    clean = fit_of(rotor_of, dataset, 0.01)
    listed = np.concatenate([w.ravel() for w in fit.problem.readings.shares]) < 0.5
    assert listed.sum() >= 0.9 * spoilt.sum()
    change = np.abs(fit.identified.table(rotor_of.bearings).values - clean.identified.table(rotor_of.bearings).values)
    assert np.median(change[..., [0, 3]] / rotor_of.bearings.values[..., [0, 3]]) < 0.004


def test_the_noise_is_estimated_channel_by_channel(rotor_of: Machine) -> None:
    """Stated at 1 %, it is 3 % in one channel and 0.5 % in the others."""
    seen = project(rotor_of.dataset, list_directions((1, 5)))
    generator = np.random.default_rng(0)
    size = np.array([0.03, 0.005, 0.005, 0.005])[:, None] * np.abs(seen.displacement)
    parts = generator.standard_normal((2, *seen.displacement.shape)) / np.sqrt(2)
    dataset = replace(seen, displacement=seen.displacement + size * (parts[0] + 1j * parts[1]))
    fit = fit_of(rotor_of, dataset, 0.01, "loss.noise=estimated")
    np.testing.assert_allclose(fit.factor, [3.0, 0.5, 0.5, 0.5], rtol=0.1)


@pytest.mark.slow
def test_the_noise_is_estimated_from_repeated_runs_whatever_the_model(rotor_of: Machine) -> None:
    """Stated at 1 %, it is 2 %; a residual unbalance that the model lacks is no noise, and shows as chi-square."""
    again = tuple(replace(e, run=f"{e.run}_again") for e in rotor_of.excitations)
    every = (*rotor_of.excitations, *again)
    hidden = unstated(rotor_of, 2, 3e-5, 2.0, *(e.run for e in again))
    clean = replace(simulate(rotor_of.rotor, rotor_of.bearings, (*every, *hidden)), excitations=every)
    sensors = Sensors(list_directions((1, 5)), NoiseModel(0.0, 0.02))
    fit = fit_of(rotor_of, measure(clean, sensors, np.random.default_rng(0)), 0.01, "loss.noise=estimated")
    np.testing.assert_allclose(fit.factor, 2.0, rtol=0.15)
    assert mean_square(fit) > 8


@pytest.mark.slow
@pytest.mark.parametrize(
    ("structure", "names", "ties"),
    [
        ("isotropic", "[kxx,kxy,kyx,kyy]", [("kxx", "kyy", 1), ("kxy", "kyx", -1)]),
        ("symmetric_damping", "[cxx,cxy,cyx,cyy]", [("cxy", "cyx", 1)]),
    ],
)
def test_a_structure_is_respected_exactly(
    rotor_of: Machine, structure: str, names: str, ties: list[tuple[str, str, int]]
) -> None:
    table = bearings_of(
        (1, 5), rotor_of.speeds, kxx=2e7, kyy=2e7, kxy=5e6, kyx=-5e6, cxx=4e4, cyy=4e4, cxy=0.0, cyx=0.0
    )
    machine = replace(rotor_of, bearings=table)
    asked = (f"identify.unknowns={names}", f"identify.structure={structure}")
    found = fit_of(machine, noisy(machine, 0.01, 0), 0.01, *asked).identified.table(table)
    for one, other, sign in ties:
        assert np.array_equal(found.coefficient(one), sign * found.coefficient(other))


def test_bearings_alike_share_their_coefficients(rotor_of: Machine) -> None:
    fit = fit_of(rotor_of, noisy(rotor_of, 0.01, 0), 0.01, "identify.shared=true")
    table = fit.identified.table(rotor_of.bearings)
    assert np.array_equal(table.values[0, :, 0], table.values[1, :, 0])
    assert len(fit.problem.active) == 2


def test_constant_coefficients(rotor_of: Machine) -> None:
    table = bearings_of((1, 5), rotor_of.speeds, kxx=2e7, kyy=3e7, cxx=4e4, cyy=4e4)
    made = replace(rotor_of, bearings=table)
    found = fit_of(made, noisy(made, 0.01, 0), 0.01, "model=constant").identified.table(table)
    np.testing.assert_allclose(found.coefficient("kxx"), 2e7, rtol=2e-3)
    np.testing.assert_allclose(found.coefficient("kyy"), 3e7, rtol=3e-3)


@pytest.mark.parametrize("planes", ["[]", "[4]"])
def test_an_odd_number_of_outputs_before_the_planes(rotor_of: Machine, planes: str) -> None:
    """One unknown alike at both bearings: the planes' pairs of numbers begin anywhere."""
    dataset = noisy(rotor_of, 0.01, 0)
    only = ("identify.shared=true", "identify.unknowns=[kxx]", f"identify.unbalance_planes={planes}")
    fit = fit_of(rotor_of, dataset, 0.01, *only, "model.width=4")
    assert fit.problem.places.size % 2 == 1
    assert np.isfinite(conclude(fit).uncertainty.residual_unbalance).all()
    assert worst(rotor_of, fit, "kxx") < 0.009


@pytest.mark.slow
@pytest.mark.parametrize("guess", ["1e6 N/m", pytest.param("1e7 N/m", marks=pytest.mark.nightly)])
def test_one_location_starts_from_a_filter(rotor_of: Machine, guess: str) -> None:
    """No linear start, and still no search: the filter's answer of each speed leads to the minimum.

    x and y between the discs alone are two readings a run for four bearing forces.
    """
    between = Sensors(list_directions((3,)), NoiseModel(0.0, 1e-3))
    dataset = measure(rotor_of.dataset, between, np.random.default_rng(1))
    fit = fit_of(rotor_of, dataset, 1e-3, f"model.initial_stiffness={guess}")
    assert fit.start.from_guess
    assert fit.start.filtered is not None
    assert abs(mean_square(fit) - 1) < 4 / np.sqrt(dataset.displacement.size)
    assert worst(rotor_of, fit) < 0.006


def test_more_noise_never_lowers_what_is_expected(rotor_of: Machine) -> None:
    """The same draw of the noise, twice as large each time: the deviations before the fit grow with it."""
    config = compose_config(["experiment=noisy_stiffness"])
    setup, loss, before = setup_of(config), loss_of(config.loss), np.zeros((2, 2))
    for noise in (0.005, 0.01, 0.02, 0.04):
        measurement = replace(rotor_of.measured(noisy(rotor_of, noise, 0), config), noise=NoiseModel(0.0, noise))
        expected = loss.expect(measurement, setup, loss.diagnose(measurement, setup))
        now = np.median(relative_deviation(expected)[..., [0, 3]], axis=1)  # kxx and kyy of both bearings
        assert (now > before).all()
        before = now


def test_fewer_features_are_the_same_with_zeros(rotor_of: Machine) -> None:
    """A short free vector predicts what the long one does whose other outputs are zero."""

    problem = fit_of(rotor_of, noisy(rotor_of, 0.01, 0), 0.01).problem
    short = problem.truncated(4)
    free = 0.1 * torch.randn(1, 1, short.places.size, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    long = short.with_features(free, problem.features.shape[-1])
    for one, other in zip(short.predicted(free), problem.predicted(long), strict=True):
        assert_close(one, other)
    assert_close(problem.with_features(long, 4), free)


def test_records_at_speeds_of_their_own_give_bearings_and_residual_unbalance_back() -> None:
    """Each run at every third speed: no two have a speed in common."""
    made, bearings = small_machine(DIRECT, speeds=np.linspace(60.0, 260.0, 24), noise=0.0)
    acting = (("a", 5e-4, 0.3), ("b", 5e-4, 2.0), ("c", 0.0, 0.0))
    weights = [Excitation(run, "unbalance", 2, size, angle) for run, size, angle in acting]
    residual = tuple(Excitation(weight.run, "unbalance", 2, 2e-4, -1.0) for weight in weights)
    present = np.arange(24)[:, None] % 3 == np.arange(3)
    data = replace(made.dataset, runs=("a", "b", "c"), excitations=(*weights, *residual), present=present)
    read = project(simulate(made.rotor, bearings, data.excitations), data.channels).displacement * present[:, None]
    data = replace(data, displacement=read, excitations=tuple(weights))
    less = replace(made, dataset=data, unknowns=replace(made.unknowns, planes=(2,)), noise=NoiseModel(1e-13, 1e-8))
    answer = fit(less, default_setup(less.guess, constant=True))
    np.testing.assert_allclose(
        answer.table(bearings).values[..., [0, 3, 4, 7]], bearings.values[..., [0, 3, 4, 7]], rtol=1e-7
    )
    assert answer_of(less, answer.model, answer.uncertainty).unbalance == pytest.approx([2e-4 * np.exp(-1j)], rel=1e-7)
