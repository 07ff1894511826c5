"""Modes, critical speeds and stability: against other solutions, closed forms and API 617."""

from __future__ import annotations

import math

import numpy as np
import pytest
import scipy.linalg
from conftest import Machine, MachineFactory, bearings_of
from hypothesis import given
from hypothesis import strategies as st
from small_rotor import STEEL

from benchmarks.ross_oracle import ross_rotor
from pipeline.config.rotor import RotorConfig
from pipeline.rotor.bearing_table import BearingTable
from pipeline.rotor.model import RotorModel, bearing_dof
from pipeline.rotor.ross_adapter import assemble
from pipeline.twin.modes import (
    WhirlModes,
    amplify,
    find_critical_speeds,
    find_modes,
    follow_modes,
    measure_stability,
    require_separation,
)
from pipeline.units import RAD_S_PER_RPM


def system(rotor: RotorModel, bearings: BearingTable, s: int) -> tuple[np.ndarray, np.ndarray]:
    """K and C + W G with the bearings at speed s."""
    stiffness = rotor.stiffness.copy()
    damping = rotor.damping + bearings.speeds[s] * rotor.gyroscopic
    for b, pair in enumerate(bearing_dof(rotor)):
        stiffness[np.ix_(pair, pair)] += bearings.values[b, s, :4].reshape(2, 2)
        damping[np.ix_(pair, pair)] += bearings.values[b, s, 4:].reshape(2, 2)
    return stiffness, damping


@pytest.mark.parametrize("name", ["hydrostatic", "ball"])
def test_modes_equal_those_of_the_dense_pencil(name: str, request: pytest.FixtureRequest) -> None:
    """Oracle: scipy's generalised eigenvalues of the pencil (A, B), no mass inverted, at three speeds."""
    machine = request.getfixturevalue(name)
    picked = machine.bearings.at(np.array([0, 7, 24]))
    modes = find_modes(machine.rotor, picked, count=6)
    n, mass = machine.rotor.n_dof, machine.rotor.mass
    for s in range(3):
        stiffness, damping = system(machine.rotor, picked, s)
        left = np.block([[np.zeros((n, n)), np.eye(n)], [-stiffness, -damping]])
        values = scipy.linalg.eigvals(left, np.block([[np.eye(n), np.zeros((n, n))], [np.zeros((n, n)), mass]]))
        upper = values[values.imag > 1.0]
        upper = upper[np.argsort(upper.imag)][:6]
        np.testing.assert_allclose(modes.frequency[s], upper.imag, rtol=1e-7)
        decrement = -2 * math.pi * upper.real / upper.imag
        np.testing.assert_allclose(modes.logarithmic_decrement[s], decrement, rtol=1e-5, atol=1e-8)
        # The largest growth may be that of a mode high up, known to rounding of its own frequency.
        assert modes.growth[s] == pytest.approx(values.real.max(), rel=1e-5, abs=1e-12 * np.abs(values).max())


@pytest.mark.slow
@pytest.mark.parametrize("name", ["hydrostatic", "ball"])
def test_modes_equal_those_of_ross(name: str, request: pytest.FixtureRequest) -> None:
    """Oracle: ROSS ``run_modal`` (wd, logarithmic decrements), which has axial and torsional modes as well.

    The 6 lowest of ours.
    """
    machine, s = request.getfixturevalue(name), 12
    modes = find_modes(machine.rotor, machine.bearings.at(np.array([s])), count=6)
    rotor = ross_rotor(machine.config.machine.rotor, machine.config.machine.bearings, machine.speeds)
    answer = rotor.run_modal(speed=float(machine.speeds[s]), sparse=False)
    every = answer.evalues[answer.evalues.imag > 1.0]
    for frequency, decrement in zip(modes.frequency[0], modes.logarithmic_decrement[0], strict=True):
        ours = complex(-decrement * frequency / (2 * math.pi), frequency)
        assert np.abs(every - ours).min() < 1e-6 * abs(ours)
    damped = answer.wd[answer.wd > 1.0]
    for k, frequency in enumerate(damped[:4]):
        nearest = np.nanargmin(np.abs(modes.frequency[0] - frequency))
        assert modes.frequency[0, nearest] == pytest.approx(frequency, rel=1e-6)
        wanted = answer.log_dec[answer.wd > 1.0][k]
        assert modes.logarithmic_decrement[0, nearest] == pytest.approx(wanted, rel=1e-4, abs=1e-8)


def rigid_rotor() -> RotorModel:
    """A thick short shaft with a disc in the middle: on soft bearings it moves as a rigid body."""
    config = {
        "shaft": [{"length": 0.4, "outer_diameter": 0.1, "elements": 2}],
        "material": STEEL,
        "discs": [{"node": 1, "mass": 50.0, "diametral_inertia": 0.05, "polar_inertia": 0.06}],
        "bearing_nodes": [0, 2],
    }
    return assemble(RotorConfig.model_validate(config))


def test_rigid_rotor_on_soft_bearings() -> None:
    """Closed form of one degree of freedom: 2 k and 2 c under the mass m, w_d = w_n sqrt(1 - z^2),
    decrement 2 pi z / sqrt(1 - z^2), to 1e-3: the shaft is 1e4 times as stiff as the bearings."""
    rotor, k, c = rigid_rotor(), 1e5, 200.0
    modes = find_modes(rotor, bearings_of((0, 2), np.array([1e-3]), kxx=k, kyy=k, cxx=c, cyy=c), count=2)
    natural = math.sqrt(2 * k / rotor.total_mass)
    ratio = 2 * c / (2 * rotor.total_mass * natural)
    np.testing.assert_allclose(modes.frequency[0], natural * math.sqrt(1 - ratio**2), rtol=1e-3)
    wanted = 2 * math.pi * ratio / math.sqrt(1 - ratio**2)
    np.testing.assert_allclose(modes.logarithmic_decrement[0], wanted, rtol=1e-3)


def test_overdamped_modes_are_left_out() -> None:
    """With z > 1 a mode does not oscillate: NaN stands where modes are missing; growth stays below zero."""
    rotor, k = rigid_rotor(), 1e5
    critical = math.sqrt(2 * k * rotor.total_mass)
    table = bearings_of((0, 2), np.array([1e-3]), kxx=k, kyy=k, cxx=3 * critical, cyy=3 * critical)
    everything = find_modes(rotor, table, count=rotor.n_dof)
    assert np.isnan(everything.frequency).any()
    assert (everything.frequency[~np.isnan(everything.frequency)] > 1e3).all()  # what is left bends the shaft
    assert everything.growth[0] < 0


def test_gyroscopic_splitting(hydrostatic: Machine) -> None:
    """Axisymmetric, undamped: W and -W give the same frequencies, and spin parts those of a pair."""
    rotor = hydrostatic.rotor
    table = bearings_of(rotor.bearing_nodes, np.array([0.0, 300.0, -300.0]), kxx=1e8, kyy=1e8)
    still, forward, backward = find_modes(rotor, table, count=6).frequency
    np.testing.assert_allclose(forward, backward, rtol=1e-8)
    np.testing.assert_allclose(still[::2], still[1::2], rtol=1e-6)
    assert (forward[0::2] < still[0::2] * (1 + 1e-9)).all()
    assert (forward[1::2] > still[1::2] * (1 - 1e-9)).all()
    assert (forward[1::2] / forward[0::2] - 1 > 1e-3).any()


def test_critical_speeds_of_the_ball_bearing_rotor(machine: MachineFactory) -> None:
    """Direct method: without damping D(w) = K - w^2 (M - j G), so that the critical speeds are eigenvalues of
    K q = w^2 (M - j G) q; two lie near 3800 rpm.

    Damping changes them by the square of its ratio (1e-6); the speeds are 20 rpm apart.
    """
    made = machine("experiment=ball_bearing", "machine.speeds.step_rpm=20")
    stiffness, _ = system(made.rotor, made.bearings, 0)
    # Of the two only K is positive definite: a thin disc has no forward critical speed of its tilting.
    inverses = scipy.linalg.eigh(made.rotor.mass - 1j * made.rotor.gyroscopic, stiffness, eigvals_only=True)
    direct = 1 / np.sqrt(inverses[inverses > 0])
    expected = np.sort(direct[direct < made.speeds[-1]])
    found = find_critical_speeds(find_modes(made.rotor, made.bearings))
    assert len(found) == len(expected) == 2
    np.testing.assert_allclose([critical.speed for critical in found], expected, rtol=1e-5)
    assert all(3700 < critical.speed / RAD_S_PER_RPM < 3900 for critical in found)
    # There the response peaks: the largest of each direction stands within a step of a critical speed.
    for direction in (0, 1):
        amplitude = np.abs(made.response[:, 4 + direction, 0])
        assert np.abs(made.speeds[amplitude.argmax()] - expected).min() <= 20 * RAD_S_PER_RPM


def made_modes(speeds: np.ndarray, *lines: np.ndarray) -> WhirlModes:
    """Modes along given lines; the decrement of each is a thousandth of the speed."""
    frequency = np.stack(lines, axis=1)
    decrement = np.repeat(1e-3 * speeds[:, None], len(lines), axis=1)
    return WhirlModes(speeds, frequency, decrement, np.full(len(speeds), -1.0), np.zeros(len(speeds)))


@given(
    constant=st.floats(12, 88),
    slope=st.floats(-0.4, 0.4),
    count=st.integers(60, 120),
)
def test_crossings_of_straight_lines_are_exact(constant: float, slope: float, count: int) -> None:
    """A frequency a + b W meets W at a / (1 - b); linear interpolation is exact on a line."""
    speeds = np.linspace(0.5, 300.0, count) + 1e-4 * math.pi
    found = find_critical_speeds(made_modes(speeds, constant + slope * speeds))
    assert [critical.speed for critical in found] == [pytest.approx(constant / (1 - slope), rel=1e-9)]
    assert found[0].logarithmic_decrement == pytest.approx(1e-3 * found[0].speed)


@pytest.mark.parametrize(
    "lines",
    [
        [np.full(10, 5.0), np.where(np.arange(10) < 5, 50.0 + 10 * np.arange(10), 20.0), np.full(10, 200.0)],
        [np.full(10, np.nan)],
        [np.array([60.0])],
    ],
)
def test_lines_that_jump_or_miss_make_no_critical_speed(lines: list[np.ndarray]) -> None:
    """A mode that becomes overdamped makes those above change places: a jump is no crossing, nor NaN, nor a point."""
    assert find_critical_speeds(made_modes(np.linspace(10, 100, 10)[: len(lines[0])], *lines)) == []


@pytest.mark.parametrize("critical", [10.0, 50.0, 90.0])
def test_speed_exactly_on_the_line(critical: float) -> None:
    """A speed of the table that is itself critical counts once, also the first and the last."""
    found = find_critical_speeds(made_modes(np.arange(10.0, 100.0, 10.0), np.full(9, critical)))
    assert [(one.speed, one.logarithmic_decrement) for one in found] == [pytest.approx((critical, 1e-3 * critical))]


@pytest.mark.parametrize(("share", "stable"), [(0.0, True), (0.95, True), (1.05, False), (-1.05, False)])
def test_stability_threshold_of_cross_coupling(share: float, stable: bool) -> None:
    """Closed form: with kxy = -kyx = s the mode of 2 k, 2 c, m grows if |s| > c w_n, in either direction.

    The rotor hardly turns, so that its tilting mode, of higher frequency, has no gyroscopic help or harm.
    """
    rotor, k, c = rigid_rotor(), 1e5, 200.0
    s = share * c * math.sqrt(2 * k / rotor.total_mass)
    table = bearings_of((0, 2), np.array([40.0, 100.0, 250.0]), kxx=k, kyy=k, kxy=s, kyx=-s, cxx=c, cyy=c)
    margin = measure_stability(find_modes(rotor, table))
    shrinks, damped = margin.largest_growth < 0, margin.smallest_logarithmic_decrement > 0
    assert (margin.stable, shrinks, damped) == (stable, stable, stable)


@pytest.mark.parametrize("experiment", ["hydrostatic_stiffness", "hydrostatic_damping", "ball_bearing"])
def test_modelled_machines_are_stable(experiment: str, machine: MachineFactory) -> None:
    """method.md, section 4: what is unstable can't be measured, so every experiment is stable."""
    made = machine(f"experiment={experiment}", "machine.speeds.step_rpm=100")
    margin = measure_stability(find_modes(made.rotor, made.bearings))
    assert margin.stable
    assert margin.smallest_logarithmic_decrement > 0


def test_margin_says_where(hydrostatic: Machine) -> None:
    """The smallest decrement stands at its own speed, among the modes up to twice the top speed."""
    modes = find_modes(hydrostatic.rotor, hydrostatic.bearings)
    margin = measure_stability(modes)
    s = int(np.flatnonzero(modes.speeds == margin.at_speed)[0])
    assert margin.smallest_logarithmic_decrement in modes.logarithmic_decrement[s]
    below = modes.frequency <= 2 * modes.speeds.max()
    assert margin.smallest_logarithmic_decrement == modes.logarithmic_decrement[below].min()
    assert margin.largest_growth == modes.growth.max()


def test_amplification_factor_is_that_of_the_half_power_points() -> None:
    """Oracle: the width of the resonance of one degree of freedom at 1/sqrt(2) of its peak, for zeta = 0.02."""
    zeta = 0.02
    ratio = np.linspace(0.9, 1.1, 200001)
    size = ratio**2 / np.hypot(1 - ratio**2, 2 * zeta * ratio)  # of an unbalance
    above = ratio[size >= size.max() / math.sqrt(2)]
    half_power = ratio[size.argmax()] / (above[-1] - above[0])
    decrement = 2 * math.pi * zeta / math.sqrt(1 - zeta**2)
    found = amplify(decrement, 1e-3)
    assert found[0] == pytest.approx(1 / (2 * zeta), rel=1e-12)
    assert found[0] == pytest.approx(half_power, rel=5e-3)
    ends = [amplify(decrement + d) for d in (1e-6, -1e-6)]
    assert found[1] == pytest.approx(abs(ends[0][0] - ends[1][0]) / 2e-6 * 1e-3, rel=1e-6)
    assert amplify(-0.1) is None


@pytest.mark.parametrize(
    ("factor", "above", "asked"),
    [(2.4, True, 0.0), (3.5, False, 8.5), (3.5, True, 18.5), (40.0, False, 16.0), (40.0, True, 26.0)],
)
def test_separation_margins_of_api_617(factor: float, above: bool, asked: float) -> None:
    assert require_separation(factor, above) == pytest.approx(asked)


def test_modes_are_followed_where_their_frequencies_meet() -> None:
    """Two lines that cross, of different damping: each keeps its own, though the order in frequency changes."""
    speeds = np.linspace(10.0, 100.0, 19) + 0.25
    lines = np.stack([np.full(19, 50.0), speeds], axis=1)
    decrements = np.stack([np.full(19, 0.1), np.full(19, 3.0)], axis=1)
    order = lines.argsort(axis=1)
    mixed = WhirlModes(
        speeds,
        np.take_along_axis(lines, order, axis=1),
        np.take_along_axis(decrements, order, axis=1),
        np.full(19, -1.0),
        np.zeros(19),
    )
    followed = np.take_along_axis(mixed.logarithmic_decrement, follow_modes(mixed), axis=1)
    assert (np.ptp(followed, axis=0) == 0).all()
    assert np.ptp(mixed.logarithmic_decrement, axis=0).all()


JEFFCOTT = {"length": 1.0, "diameter": 0.02, "mass": 10.0}


SHAFT_STIFFNESS = 48 * STEEL["youngs_modulus"] * (math.pi * 0.02**4 / 64) / 1.0**3  # 48 E I / L^3, N/m


def jeffcott(density: float) -> RotorModel:
    """A disc (a point mass but for 1e-9 kg m^2) in the middle of a shaft of hardly any mass; no shear."""
    return assemble(
        RotorConfig.model_validate(
            {
                "shaft": [{"length": 1.0, "outer_diameter": 0.02, "elements": 4}],
                "material": STEEL | {"density": density},
                "discs": [{"node": 2, "mass": JEFFCOTT["mass"], "diametral_inertia": 1e-9, "polar_inertia": 1e-9}],
                "bearing_nodes": [0, 4],
                "shear_effects": False,
            }
        )
    )


def test_jeffcott_critical_speed() -> None:
    """Jeffcott (1919): the critical speed is sqrt(k / m). The shaft's mass (0.003 %) may lower it by 1e-5."""
    expected = math.sqrt(SHAFT_STIFFNESS / JEFFCOTT["mass"])
    speeds = expected * np.linspace(0.8, 1.2, 8)
    found = find_critical_speeds(find_modes(jeffcott(1.0), bearings_of((0, 4), speeds, kxx=1e10, kyy=1e10)))
    # Forward and backward, the same without gyroscopic effect.
    assert [critical.speed for critical in found] == pytest.approx([expected, expected], rel=2e-5)
