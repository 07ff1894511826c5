"""Deviations of modes and critical speeds, also beyond the data: derivatives, intervals against draws."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any, cast

import numpy as np
import pytest
from conftest import Machine
from running import composed
from small_rig import small_rig
from small_rotor import FITTED

from pipeline.data.dataset import Excitation, VibrationDataset
from pipeline.errors import ConfigError
from pipeline.identification.output_error_fit import fit_output_error
from pipeline.identification.quality import output_error_quality
from pipeline.identification.training import setup_of
from pipeline.identification.uncertainty import measure_uncertainty
from pipeline.parameters.model import ModelParameter, rotor_change, update_rotor
from pipeline.problem.condition_noise import condition_noise, to_dataset
from pipeline.problem.slopes import deviate
from pipeline.reporting.summary import describe_stability
from pipeline.reporting.twin import describe_measured, summarize_modes
from pipeline.rotor.bearing_table import BearingTable
from pipeline.rotor.dynamic_stiffness import assemble_systems
from pipeline.rotor.interpolation import bearing_places, move_bearing
from pipeline.rotor.model import RotorModel
from pipeline.rotor.ross_adapter import ross
from pipeline.twin.mode_deviations import Behaviour, ModeDeviations, derive_eigenvalues, derive_place, expect_criticals
from pipeline.twin.modes import (
    WhirlModes,
    find_critical_speeds,
    find_modes,
    measure_stability,
    read_modes,
)

RS = ross()


def derive(rotor: RotorModel, bearings: BearingTable, s: int, changes: list[RotorModel | None]) -> tuple:
    """Eigenvalues of the speed s and their derivatives."""
    _, damping, stiffness = assemble_systems(rotor, bearings)
    values = find_modes(rotor, bearings).eigenvalues[s]
    values = values[~np.isnan(values)]
    system = (rotor.mass, stiffness[s], damping[s], bearings.speeds[s], bearing_places(rotor))
    return values, *derive_eigenvalues(values, *system, changes)


def eigenvalues(rotor: RotorModel, bearings: BearingTable, s: int) -> np.ndarray:
    found = find_modes(rotor, bearings.at(np.array([s]))).eigenvalues[0]
    return found[~np.isnan(found)]


def test_derivatives_by_coefficients_equal_differences(hydrostatic: Machine) -> None:
    """Oracle: central differences of the eigenvalues themselves, each of the sixteen coefficients."""
    rotor, bearings, s = hydrostatic.rotor, hydrostatic.bearings, 12
    values, by_coefficient, _ = derive(rotor, bearings, s, [])
    for b, c in np.ndindex(2, 8):
        step = 1e-4 * np.abs(bearings.values[b, s, :4] if c < 4 else bearings.values[b, s, 4:]).max()
        move = np.zeros_like(bearings.values)
        move[b, s, c] = step
        ends = [eigenvalues(rotor, replace(bearings, values=bearings.values + each), s) for each in (move, -move)]
        differences = (ends[0] - ends[1]) / (2 * step)
        np.testing.assert_allclose(by_coefficient[:, b, c], differences, atol=1e-4 * np.abs(differences).max())
    assert by_coefficient.shape == (len(values), 2, 8)


@pytest.mark.parametrize(
    ("kind", "size", "place"),
    [
        ("youngs_modulus", 0.02, 2),
        ("density", 0.02, 2),
        ("disc_mass", 0.02, 2),
        ("disc_inertia", 0.02, 2),
        ("coupling_stiffness", 1e5, 2),
        ("bearing_position", 0.005, 1),
    ],
)
def test_derivatives_by_model_parameters_equal_differences(
    kind: str, size: float, place: int, hydrostatic: Machine
) -> None:
    """Also by the place of a bearing inside an element, 20 mm beyond the node."""
    rotor, bearings, s = move_bearing(hydrostatic.rotor, 1, 0.02), hydrostatic.bearings, 12
    parameter = ModelParameter(kind, size, "", place)
    moved = derive_place(rotor, parameter, bearings.values[:, s]) if kind == "bearing_position" else None
    by_rotor = derive(rotor, bearings, s, [moved or rotor_change(parameter, rotor), None])[2]
    step = 1e-3
    ends = [eigenvalues(update_rotor(rotor, [replace(parameter, value=v)]), bearings, s) for v in (step, -step)]
    differences = (ends[0] - ends[1]) / (2 * step)
    np.testing.assert_allclose(by_rotor[:, 0], differences, atol=1e-4 * np.abs(differences).max())
    assert not by_rotor[:, 1].any()


def toy(machine: Machine) -> tuple[WhirlModes, ModeDeviations, np.ndarray]:
    """Two numbers that move all direct stiffnesses and all direct dampings by shares of themselves: a linear-Gaussian
    toy whose covariance is known. Also the (S, B, 8, 2) derivatives of the coefficients."""
    rotor, bearings = machine.rotor, machine.bearings
    by_number = np.zeros((len(bearings.speeds), 2, 8, 2))
    for c, number in ((0, 0), (3, 0), (4, 1), (7, 1)):
        by_number[..., c, number] = bearings.values[..., c].T
    modes = find_modes(rotor, bearings)
    covariance = np.array([[1.0, 0.5], [0.5, 1.0]]) * 0.01**2
    moved = np.full((*modes.frequency.shape, 2), np.nan, dtype=complex)
    for s in range(len(bearings.speeds)):
        by_coefficient = derive(rotor, bearings, s, [])[1]
        moved[s, : len(by_coefficient)] = np.einsum("kbc,bcz->kz", by_coefficient, by_number[s])
    turned = (-2 * math.pi * moved.real - modes.logarithmic_decrement[..., None] * moved.imag) / modes.frequency[
        ..., None
    ]
    widths = deviate(moved.imag, covariance), deviate(turned, covariance)
    return modes, ModeDeviations(modes, *widths, moved, np.zeros((len(moved), 2)), covariance), by_number


@pytest.fixture(scope="module")
def rolling() -> Machine:
    """The ball bearing rotor with damping, whose critical speeds lie near 3800 rpm."""
    from benchmarks.machines import machine

    made = machine("experiment=ball_bearing", "machine.speeds.start_rpm=3000", "machine.speeds.step_rpm=200")
    values = made.bearings.values.copy()
    values[..., [4, 7]] = 2e4
    return replace(made, bearings=replace(made.bearings, values=values))


@pytest.mark.slow
def test_intervals_of_critical_speeds_hold(rolling: Machine) -> None:
    """A linear-Gaussian toy: of 400 seeded draws of the numbers, the share within 1.96 deviations is 95 %.

    The binomial deviation of that share is 1.1 %; the bar is three of them. The modes of every draw are found anew.
    """
    modes, deviations, by_number = toy(rolling)
    critical = find_critical_speeds(modes)
    assert len(critical) == 2
    generator, inside = np.random.default_rng(0), []
    known_to = [deviations.of_critical(one) for one in critical]
    for draw in generator.multivariate_normal(np.zeros(2), deviations.covariance, size=400):
        values = rolling.bearings.values + (by_number @ draw).swapaxes(0, 1)
        drawn = find_critical_speeds(find_modes(rolling.rotor, replace(rolling.bearings, values=values)))
        for one, there, (speed, decrement) in zip(critical, drawn, known_to, strict=True):
            inside.append(
                [
                    abs(there.speed - one.speed) < 1.96 * speed,
                    abs(there.logarithmic_decrement - one.logarithmic_decrement) < 1.96 * decrement,
                ]
            )
    np.testing.assert_allclose(np.mean(inside, axis=0), 0.95, atol=0.033)


def test_a_critical_speed_follows_its_stiffness(rolling: Machine) -> None:
    """Closed form: of a system without gyroscopic terms whose stiffness is the bearings' alone, the critical speed goes
    with the root of it. Here the shaft bends as well: the share of the bearings lies between none and all."""
    modes, deviations, _ = toy(rolling)
    exact = replace(deviations, covariance=np.diag([0.01**2, 0.0]))
    for one in find_critical_speeds(modes):
        speed, _ = exact.of_critical(one)
        assert 0 < speed / one.speed < 0.5 * 0.01


def test_a_fit_without_deviations_states_none(hydrostatic: Machine) -> None:
    found = Behaviour(find_modes(hydrostatic.rotor, hydrostatic.bearings))
    assert found.deviations is None
    assert found.margin.stable


@pytest.mark.slow
def test_the_modes_of_realistic_lie_within_their_deviations(artifacts) -> None:
    """What `make reproduce` made: the truth, a machine that was not built as modelled, within three deviations."""
    found = artifacts.read("realistic", "prediction")
    truth, answer = found["modelled"]["critical_speeds"], found["identified"]["critical_speeds"]
    assert (truth.keys(), len(truth)) == (answer.keys(), 2)
    for number, one in answer.items():
        for key in ("rpm", "logarithmic_decrement", "amplification_factor", "separation_margin_percent"):
            assert abs(one[key] - truth[number][key]) < 3 * one[f"{key}_std"], (number, key)
    assert 0 < (answer["1"]["rpm_std"] / answer["1"]["rpm"]) < 1e-3
    stability = found["identified"]["stability"]
    away = (
        stability["smallest_logarithmic_decrement"] - found["modelled"]["stability"]["smallest_logarithmic_decrement"]
    )
    assert abs(away) < 3 * stability["smallest_logarithmic_decrement_std"]


def test_the_smallest_decrement_counts_the_modes_that_may_take_its_place() -> None:
    """Two modes, 0.10 known to 0.001 and 0.11 known to 0.05: the root mean square of min(X, Y) - 0.10 by quadrature.

    Its own mode alone would say 0.001. The bar is three deviations of a root mean square over 400 draws.
    """
    decrement, known_to, frequency = np.array([[0.10, 0.11]]), np.array([0.001, 0.05]), np.array([[100.0, 120.0]])
    modes = WhirlModes(np.array([100.0]), frequency, decrement, np.array([-1.0]), np.array([100.0]))
    by_number = -frequency[..., None] / (2 * math.pi) * np.eye(2)[None] + 0j
    deviations = ModeDeviations(modes, frequency, decrement, by_number, np.zeros((1, 2)), np.diag(known_to**2))
    margin = measure_stability(modes)
    assert margin.smallest_logarithmic_decrement == pytest.approx(0.10)
    _, found = deviations.of_margin(margin)
    x = np.linspace(-6, 6, 1201)
    weight = np.exp(-(x**2) / 2)
    both = np.minimum(0.10 + known_to[0] * x[:, None], 0.11 + known_to[1] * x[None]) - 0.10
    wanted = math.sqrt((both**2 * np.outer(weight, weight)).sum() / weight.sum() ** 2)
    assert found == pytest.approx(wanted, rel=0.15)
    assert found > 10 * known_to[0]


def test_a_mode_near_critical_damping_widens_no_margin() -> None:
    """A well damped mode known to 10 % beside one near critical damping, whose linearised decrement runs through zero.

    There an eigenvalue goes with the root of what it depends on: its derivative is no measure of anything.
    """
    decrement, frequency = np.array([[0.06, 300.0]]), np.array([[100.0, 2.0]])
    modes = WhirlModes(np.array([100.0]), frequency, decrement, np.array([-0.9]), np.array([100.0]))
    by_number = np.array([[[-100.0 / (2 * math.pi), 0.0], [0.0, 1e3 + 1e3j]]])
    deviations = ModeDeviations(modes, frequency, decrement, by_number, np.zeros((1, 2)), np.diag([0.006**2, 1.0]))
    behaviour = Behaviour(modes, deviations)
    growth, found = behaviour.margin_deviations
    assert found == pytest.approx(0.006, rel=0.15)
    assert growth < 1.0
    assert "0.0600 +- 0.0060 at" in describe_stability(summarize_modes(behaviour, 1000.0)["stability"])


@pytest.mark.parametrize(
    ("growth", "deviation", "verdict"),
    [(-0.1, 1.0, "stable"), (0.35, 1.7, "not told"), (0.35, 0.1, "unstable"), (5255.0, 4000.0, "not told")],
)
def test_a_growth_is_judged_with_its_deviation(growth: float, deviation: float, verdict: str) -> None:
    """Unstable only beyond two deviations."""
    modes = WhirlModes(np.ones(1), np.full((1, 1), 1.0), np.full((1, 1), 0.1), np.array([growth]), np.array([1.0]))
    empty = np.zeros((1, 1))
    deviations = ModeDeviations(modes, empty, empty, np.zeros((1, 1, 1)), np.ones((1, 1)), np.diag([deviation**2]))
    behaviour = Behaviour(modes, deviations)
    assert behaviour.stability == verdict
    assert ("UNSTABLE" in describe_stability(summarize_modes(behaviour, 1000.0)["stability"])) is (
        verdict == "unstable"
    )


@pytest.mark.slow
@pytest.mark.parametrize("rpm", [0, 3000])
def test_responses_alone_show_the_decrements_of_ross(rpm: int) -> None:
    """Pushed at a disc, by ROSS's matrices with 1 % of noise, against its modes; those of the model are off by half."""
    steel, speed = RS.Material("steel", rho=7810, E=211e9, G_s=81.2e9), rpm * np.pi / 30
    generator = np.random.default_rng(2)
    standing = [RS.BearingElement(n, kxx=2e7, kyy=3e7, cxx=3e4, cyy=4e4) for n in (1, 4)]
    shaft = [RS.ShaftElement(0.3, 0.0, 0.05, material=steel) for _ in range(4)]
    rotor = RS.Rotor(shaft, [RS.DiskElement.from_geometry(2, steel, 0.05, 0.05, 0.26)], standing)
    modal = rotor.run_modal(speed, num_modes=24)
    order = np.argsort(modal.wd)[:2]
    wd, real = modal.wd[order], modal.log_dec[order]
    w, force = np.linspace(0.8 * wd[0], 1.2 * wd[1], 240), np.zeros(rotor.ndof)
    force[[12, 13]] = 1.0
    dynamic = [rotor.K(speed) + 1j * f * (rotor.C(speed) + speed * rotor.G()) - f**2 * rotor.M(speed) for f in w]
    exact = np.array([np.linalg.solve(d, force)[[6, 7, 24, 25]] for d in dynamic]).T  # (P, L)
    deviation = np.full((1, *exact.shape), 0.01 * np.median(np.abs(exact)))
    noise = deviation[0] * (generator.standard_normal((2, *exact.shape)) * [[[1]], [[1j]]]).sum(axis=0) / np.sqrt(2)
    runs, channels = tuple(map(str, range(len(w)))), ((1, 0.0), (1, 90.0), (4, 0.0), (4, 90.0))
    push = tuple(Excitation(run, "force", 2, 1.0, 0.0, "forward") for run in runs)
    data = VibrationDataset(np.array([speed]), runs, channels, (exact + noise)[None], push, w[None])
    modes = WhirlModes(data.speeds, 1.002 * wd[None], 1.5 * real[None], np.zeros(1), np.zeros(1), w[-1])
    shown = read_modes(data, deviation, modes)
    assert (np.abs(shown[:, 0] - wd) < 3 * shown[:, 1]).all()
    assert (np.abs(shown[:, 2] - real) < 3 * shown[:, 3]).all()
    assert (shown[:, 3] < 0.05 * real).all()
    for factor, said in ((1.5, "which DIFFERS"), (1.0, "which agrees")):
        known = Behaviour(replace(modes, logarithmic_decrement=factor * shown[None, :, 2]), None, shown)
        told = cast("dict[str, dict[str, Any]]", summarize_modes(known, 1000.0)["modes"]).values()
        assert all(said in describe_measured(mode) for mode in told)
    assert np.isnan(read_modes(replace(data, own_frequencies=None), deviation, modes)).all()


ABOVE = np.linspace(150.0, 420.0, 91)


@pytest.mark.slow
def test_critical_speeds_above_the_data_lie_within_their_deviations() -> None:
    """Data at 110 and 135 rad/s; oracle: the modes of the true rotor on its true bearings, on the same grid."""
    deviations, off = {"disc_mass": 0.02, "youngs_modulus": 0.02}, np.array([0.7, -0.8])
    rig = small_rig(np.random.default_rng(21), 30, deviations=deviations, truth=off)
    measurement = replace(rig.template, dataset=to_dataset(rig.conditions), drift=condition_noise(rig.conditions))
    fit = fit_output_error(measurement, setup_of(composed(*FITTED)))
    uncertainty = measure_uncertainty(fit, output_error_quality(fit))
    at_fit = measurement.update(uncertainty.parameters)
    found = expect_criticals(at_fit, uncertainty, ABOVE)
    bearings = BearingTable((0, 5), ABOVE, np.repeat(rig.bearings.values[:, :1], len(ABOVE), axis=1))
    true = find_critical_speeds(find_modes(measurement.update(off).updated_rotor, bearings))
    assert len(found) == len(true) > 0
    for (one, (deviation, decrement_deviation)), other in zip(found, true, strict=True):
        assert abs(one.speed - other.speed) < 4 * deviation
        assert abs(one.logarithmic_decrement - other.logarithmic_decrement) < 4 * decrement_deviation
        assert 0 < deviation < 0.02 * one.speed
    stated = find_critical_speeds(find_modes(measurement.rotor, bearings))
    assert abs(stated[0].speed - true[0].speed) > 2 * found[0][1][0]  # what was stated would have been refused
    tilted = replace(at_fit.known, values=at_fit.known.values + np.array([0.0, 1e4])[None, :, None])
    with pytest.raises(ConfigError, match="do not depend on the speed"):
        expect_criticals(replace(at_fit, known=tilted), uncertainty, ABOVE)
    network = replace(fit.identified, model=replace(fit.identified.model, hidden=(4,)))
    with pytest.raises(ConfigError, match="model=constant"):
        expect_criticals(at_fit, replace(uncertainty, identified=network), ABOVE)
