"""Modes of a run-up are found back, with deviations that hold, and their number and the sense of phase by evidence."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from conftest import refused

from pipeline.sweep.bias import respond_steadily, respond_to_ramp
from pipeline.sweep.fit import (
    RunUp,
    choose_sense,
    fit_decay,
    fit_modes,
    fit_near,
    fit_single_and_pair,
    measure_rate,
    read_smoothed_peak,
    respond_as_steady,
)

RPM = np.pi / 30
RATE = 229 * RPM
ONE = ((1580.0, 0.02, 5e-6 * np.exp(0.7j)),)
TWO = ((1570.0, 0.012, 3e-6 * np.exp(0.7j)), (1660.0, 0.025, 3e-6 * np.exp(-2j)))
RUNOUT = 4e-6 * np.exp(2j)


def revolutions(rate: float = RATE) -> np.ndarray:
    """(211,) rad/s, one a revolution from 1037 rpm (or down to it)."""
    speeds = np.sqrt((1037 * RPM) ** 2 + 4 * np.pi * abs(rate) * np.arange(211))
    return speeds if rate > 0 else speeds[::-1]


def made(modes: tuple[tuple[float, float, complex], ...], rate: float = RATE, noise: np.ndarray | float = 0.0) -> RunUp:
    """A run-up of these modes (rpm, ratio, amplitude) with runout."""
    speeds = np.sort(revolutions(rate))
    vectors = sum(size * respond_to_ramp(rpm * RPM, damping, speeds, rate) for rpm, damping, size in modes)
    return RunUp(speeds, vectors + RUNOUT + noise, rate)


def correlated(rng: np.random.Generator, size: float, memory: float = 0.6) -> np.ndarray:
    """(211,) complex noise whose neighbours are alike."""
    white = size * (rng.standard_normal(250) + 1j * rng.standard_normal(250)) * np.sqrt((1 - memory**2) / 2)
    found = [white[0]]
    for one in white[1:]:
        found.append(memory * found[-1] + one)
    return np.array(found[-211:])


@pytest.mark.slow
@pytest.mark.parametrize("rate", [RATE, -RATE])
def test_two_modes_are_found_exactly(rate: float) -> None:
    """And the steady response is that of the modes, without the sweep."""
    run_up = made(TWO, rate)
    found = fit_modes(run_up, 2)
    assert (found.frequencies / RPM, found.dampings, found.amplitudes, found.background) == (
        pytest.approx([1570, 1660], rel=1e-6),
        pytest.approx([0.012, 0.025], rel=1e-4),
        pytest.approx([size for *_, size in TWO], rel=1e-4),
        pytest.approx([RUNOUT, 0, 0], abs=1e-10),
    )
    steady = sum(size * respond_steadily(rpm * RPM, z, run_up.speeds) for rpm, z, size in TWO) + RUNOUT
    assert respond_as_steady(run_up, found) == pytest.approx(steady, abs=1e-9)


def test_channels_share_the_modes_of_responses_to_a_force() -> None:
    """Acceleration over force at a standing rotor, -w^2 times the receptance of two modes, at three channels."""
    w, f, z = np.linspace(40, 70, 61)[:, None], np.array([51.4, 56.0]), np.array([0.025, 0.055])
    sizes = np.array([[1.0, -0.3, 2.0], [0.2, 1.0, 1j]])
    vectors = -(w**2) / (f**2 - w**2 + 2j * z * f * w) @ sizes + np.array([1.0, 0.5j, 0.0])
    fit = fit_near(RunUp(w[:, 0], vectors, 0.0), [(51.0, 0.02), (57.0, 0.04)])
    assert (fit.frequencies, fit.dampings, fit.amplitudes) == (
        pytest.approx(f, rel=1e-7),
        pytest.approx(z, rel=1e-6),
        pytest.approx(-sizes, abs=1e-6),
    )


@pytest.mark.slow
def test_a_factor_changes_no_mode() -> None:
    run_up = made(ONE)
    one, other = (fit_modes(replace(run_up, vectors=factor * run_up.vectors), 1) for factor in (1.0, 1e4j))
    assert (other.frequencies, other.dampings) == (
        pytest.approx(one.frequencies, rel=1e-9),
        pytest.approx(one.dampings, rel=1e-6),
    )


@pytest.mark.slow
def test_the_deviations_hold_where_neighbours_err_together() -> None:
    """Errors over deviations of forty run-ups, neighbouring rows 0.6 correlated: about one, and few beyond 95 %."""
    rng = np.random.default_rng(18)
    scores = []
    for _ in range(40):
        found = fit_modes(made(ONE, noise=correlated(rng, 2e-6)), 1)
        errors = np.array([found.frequencies[0] / RPM - 1580, found.dampings[0] - 0.02])
        scores.append(errors / found.deviations[0] / [1 / RPM, 1])
    size = np.sqrt((np.array(scores) ** 2).mean(axis=0))
    assert ((size > 0.6) & (size < 1.35)).all(), size
    assert (np.abs(scores) < 1.96).mean() > 0.85


@pytest.mark.slow
def test_the_data_choose_the_number_of_modes() -> None:
    rng = np.random.default_rng(5)
    for modes, wanted in ((ONE, 1), (TWO, 2)):
        one, two = fit_single_and_pair(made(modes, noise=correlated(rng, 2e-6)))
        assert (2 if two.criterion < one.criterion else 1) == wanted
        assert two.misfit < one.misfit


@pytest.mark.slow
def test_the_data_choose_the_sense_of_the_phase() -> None:
    run_up = made(ONE, noise=correlated(np.random.default_rng(5), 2e-6))
    found, sense, gain = choose_sense(replace(run_up, vectors=run_up.vectors.conj()))
    assert gain > 3
    assert found.vectors == pytest.approx(run_up.vectors)
    assert (sense, choose_sense(run_up)[1]) == ("lag", "lead")


@pytest.mark.slow
@pytest.mark.parametrize("rate", [RATE, -RATE])
def test_the_decay_behind_the_peak_is_the_mode(rate: float) -> None:
    """Up and down; the forced part is left to the background."""
    rpm = 1580.0 if rate > 0 else 2100.0
    found = fit_decay(made(((rpm, 0.008, 5e-6 + 0j),), rate), rpm * RPM)
    assert (found.frequencies[0] / RPM, found.dampings[0]) == (
        pytest.approx(rpm, rel=2e-3),
        pytest.approx(0.008, rel=0.15),
    )


@pytest.mark.slow
def test_no_decay_is_seen_where_damping_is_large() -> None:
    run_up = made(((1580.0, 0.2, 5e-6 + 0j),), noise=correlated(np.random.default_rng(5), 2e-7))
    assert fit_decay(run_up, 1580 * RPM) is None


def test_the_rate_is_measured_from_the_revolutions() -> None:
    noise = 0.5 * RPM * np.random.default_rng(5).standard_normal(211)
    for rate in (RATE, -RATE):
        measured, deviation, departure = measure_rate(revolutions(rate) + noise, "x")
        assert measured == pytest.approx(rate, abs=4 * deviation)
        assert deviation < 1e-3 * RATE
        assert departure < 3 * RPM
    with refused("'x' must have at least 40 rows (revolutions) on its ramp, but it has 10"):
        measure_rate(revolutions()[:10], "'x'")


def test_a_run_up_without_a_peak_is_refused() -> None:
    run_up = made(ONE)
    below = run_up.speeds < 1500 * RPM
    with refused("must have a peak with half its power on both sides", "1037 to 1493 rpm"):
        fit_modes(RunUp(run_up.speeds[below], run_up.vectors[below], RATE), 1)


def test_a_mean_over_rows_reads_a_lower_and_wider_peak() -> None:
    sharp, smooth = (read_smoothed_peak(made(ONE), rows) for rows in (1, 15))
    assert smooth.amplitude < sharp.amplitude
    assert smooth.damping > sharp.damping
