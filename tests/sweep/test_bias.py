"""The response to a sweep: against a time integration, the steady response, its own laws, the printed rates."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.sweep.bias import (
    find_mode,
    find_slow_rate,
    measure_bias,
    read_peak,
    read_ramp,
    respond_steadily,
    respond_to_ramp,
)

RPM = np.pi / 30
FREQUENCY = 165.0


def integrated(damping: float, rate: float, first: float, last: float) -> tuple[np.ndarray, np.ndarray]:
    """Speeds (200,) and Q (200,) of q'' + 2 z w q' + w^2 q = (Omega^2 - j alpha) e^{j theta}, from the steady state."""
    from scipy.integrate import solve_ivp

    def turn(t: np.ndarray | float) -> np.ndarray | float:
        return first * t + rate * t**2 / 2

    def derive(t: float, state: np.ndarray) -> list[complex]:
        force = ((first + rate * t) ** 2 - 1j * rate) * np.exp(1j * turn(t))
        return [state[1], force - 2 * damping * FREQUENCY * state[1] - FREQUENCY**2 * state[0]]

    times = np.linspace(0, (last - first) / rate, 200)
    start = respond_steadily(FREQUENCY, damping, np.array([first]))[0]
    span = (0.0, float(times[-1]))
    solved = solve_ivp(derive, span, [start, 1j * first * start], "DOP853", times, rtol=1e-9, atol=1e-10)
    return first + rate * times, solved.y[0] * np.exp(-1j * np.asarray(turn(times)))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("damping", "rate", "first", "last"), [(0.02, 24.0, 20, 400), (0.05, -24.0, 400, 20), (0.3, 200.0, 10, 600)]
)
def test_the_closed_form_is_a_time_integration(damping: float, rate: float, first: float, last: float) -> None:
    """To 1e-7 of the largest, once the start has died away."""
    speeds, found = integrated(damping, rate, first, last)
    assert np.abs(respond_to_ramp(FREQUENCY, damping, speeds, rate) - found)[60:].max() < 1e-7 * np.abs(found).max()


@given(damping=st.floats(0.005, 0.3), sign=st.sampled_from([-1.0, 1.0]))
def test_a_slow_sweep_is_steady(damping: float, sign: float) -> None:
    """The error falls with the rate: a tenth of it leaves a tenth."""
    speeds = np.linspace(40, 400, 60)
    steady = respond_steadily(FREQUENCY, damping, speeds)
    gaps = [np.abs(respond_to_ramp(FREQUENCY, damping, speeds, sign * a) - steady).max() for a in (1e-3, 1e-4)]
    assert gaps[0] < 2e-6 / damping**3 * np.abs(steady).max()
    assert gaps[1] == pytest.approx(0.1 * gaps[0], rel=0.05)
    assert respond_to_ramp(FREQUENCY, damping, speeds, 0.0) == pytest.approx(steady, rel=1e-9)


@given(damping=st.floats(0.005, 0.2), factor=st.floats(0.3, 3.0), rate=st.floats(-50, 50).filter(lambda a: abs(a) > 1))
def test_time_has_no_unit(damping: float, factor: float, rate: float) -> None:
    """All speeds times a factor and the rate times its square: the same response."""
    speeds = np.linspace(40, 400, 30)
    one = respond_to_ramp(FREQUENCY, damping, speeds, rate)
    other = respond_to_ramp(factor * FREQUENCY, damping, factor * speeds, factor**2 * rate)
    assert np.abs(one - other).max() < 1e-8 * np.abs(one).max()


def test_a_reading_of_a_steady_peak_is_the_mode() -> None:
    found = read_ramp(FREQUENCY, 0.01, 0.0)
    assert (found.frequency, found.damping, found.amplification, found.amplitude) == (
        pytest.approx(FREQUENCY, rel=2e-4),
        pytest.approx(0.01, rel=2e-3),
        pytest.approx(50, rel=2e-3),
        pytest.approx(50, rel=2e-3),
    )


@pytest.mark.parametrize(("frequency", "damping", "step"), [(400.0, 0.02, 1), (400.0, 0.02, -1), (200.0, 0.5, 1)])
def test_a_peak_without_two_sides_is_not_read(frequency: float, damping: float, step: int) -> None:
    """Rising, falling, flat."""
    speeds = np.linspace(100, 300, 100)
    assert read_peak(speeds, np.abs(respond_steadily(frequency, damping, speeds))[::step]) is None


@pytest.mark.parametrize("rate", [-229.0, 40.0, 229.0])
def test_the_mode_is_found_back_from_its_swept_reading(rate: float) -> None:
    frequency, damping = find_mode(read_ramp(1590 * RPM, 0.02, rate * RPM), rate * RPM)
    assert (frequency / RPM, damping) == (pytest.approx(1590, rel=1e-4), pytest.approx(0.02, rel=5e-3))


def test_at_the_slow_rate_the_peak_lags_by_the_share() -> None:
    """And the lag, which a run-down has too, grows with the rate."""
    slow = find_slow_rate(FREQUENCY, 0.02, 0.01)
    bias = measure_bias(FREQUENCY, 0.02, slow, 0.01)
    assert bias.peak_shift == pytest.approx(0.01, rel=1e-3)
    assert bias.damping_factor > 1.03
    assert bias.amplitude_factor < 0.99
    assert measure_bias(FREQUENCY, 0.02, 4 * slow, 0.01).peak_shift > 1.5 * bias.peak_shift
    assert measure_bias(FREQUENCY, 0.02, -slow, 0.01).peak_shift == pytest.approx(-0.01, rel=0.1)


PAGE = Path(__file__).resolve().parents[2] / "docs" / "run_up.md"


@pytest.mark.parametrize("damping", ["0.005", "0.01", "0.02", "0.05", "0.1"])
def test_the_printed_rates(damping: str) -> None:
    line = next(row for row in PAGE.read_text(encoding="utf-8").splitlines() if row.startswith(f"| {damping} |"))
    found = [find_slow_rate(rpm * RPM, float(damping), 0.01) / RPM for rpm in (600, 1600, 6000)]
    assert found == pytest.approx([float(cell) for cell in line.split("|")[2:5]], rel=0.01)
