"""1X vectors of time signals, against vectors known in closed form, and what can not be tracked."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
from conftest import refused
from measured_files import tacho_of

from pipeline.config.measured import OrderTrackingConfig as Settings
from pipeline.ingest.order_tracking import Signals, find_range, fit_steady, fit_sweep
from pipeline.ingest.tacho import ShaftAngle, find_pulses, fit_angle

RPM = np.pi / 30
CRITICAL = 2000.0  # rpm


@dataclass(frozen=True)
class Shaft:
    """A shaft whose speed goes from ``first`` to ``last`` rpm in ``seconds``, seen by four probes and a tacho."""

    rate: float  # Hz, samples
    first: float
    last: float
    seconds: float
    damping: float = 0.05  # ratio of the resonance that the first probe sees

    @property
    def time(self) -> np.ndarray:
        """(n,) s."""
        return np.arange(int(self.rate * self.seconds)) / self.rate

    def angle(self, t: np.ndarray) -> np.ndarray:
        """(n,) rad at (n,) s, from a pulse at a time that is no sample."""
        return 2 * np.pi * (self.first * t + (self.last - self.first) * t**2 / (2 * self.seconds)) / 60 + 0.1234

    def rpm(self, t: np.ndarray) -> np.ndarray:
        """(n,) at (n,) s."""
        return self.first + (self.last - self.first) * t / self.seconds

    def vectors(self, rpm: np.ndarray) -> np.ndarray:
        """(len(rpm), 4) complex, m: unbalance responses of four resonances."""
        p = np.arange(4)
        ratio, damping = rpm[:, None] / (CRITICAL * (1 + 0.05 * p)), self.damping * (1 + 0.2 * p)
        return 20e-6 * np.exp(1j * (0.3 + p)) * ratio**2 / (1 - ratio**2 + 2j * damping * ratio)

    def signals(self, noise: float, rng: np.random.Generator) -> np.ndarray:
        """(n, 4) m: 1X, a fifth of it at 2X, a gap that drifts, and noise (share of the 1X amplitude)."""
        rpm, phi = self.rpm(self.time), self.angle(self.time)[:, None]
        vectors = self.vectors(rpm)
        size = np.abs(vectors)
        return (
            np.real(vectors * np.exp(1j * phi))
            + 0.2 * size * np.cos(2 * phi + 1.0)
            + (500e-6 + 100e-6 * rpm[:, None] / 6000)
            + noise * size * rng.standard_normal(size.shape)
        )

    def tacho(self, rng: np.random.Generator, edge: float = 8.0, teeth: int = 1) -> np.ndarray:
        """(n,) V: a notch in the shaft, its edges ``edge`` degrees wide (0: sharper than the sampling)."""
        notch = tacho_of(teeth * self.angle(self.time), max(edge, 1e-9))  # the mark is at zero
        return -10.0 + 1.6 * notch + 0.02 * rng.standard_normal(len(notch))

    def recorded(self, noise: float, rng: np.random.Generator, edge: float = 8.0) -> Signals:
        """The signals, and the angle that their tacho gives."""
        pulses = find_pulses(self.time, self.tacho(rng, edge), "rising", None, None, "the record")
        return Signals(self.time, self.signals(noise, rng), fit_angle(pulses[0], 1, "the record"), "the record")


def errors(
    found: np.ndarray, true: np.ndarray, percent: float = np.inf, degrees: float = np.inf
) -> tuple[np.ndarray, np.ndarray]:
    """Of amplitude in percent, of phase in degrees: all of them below these."""
    ratio = found / true
    amplitude, phase = 100 * np.abs(np.abs(ratio) - 1), np.abs(np.degrees(np.angle(ratio)))
    print(f"amplitude {amplitude.max():.3f} %, rms {np.sqrt((amplitude**2).mean()):.3f} %, phase {phase.max():.3f} deg")
    assert amplitude.max() < percent
    assert phase.max() < degrees
    return amplitude, phase


def tracked(shaft: Shaft, signals: Signals, rpm: np.ndarray, settings: Settings | None = None) -> np.ndarray:
    """1X vectors at ``rpm``."""
    return fit_sweep(signals, rpm * RPM, settings or Settings())[0]


@pytest.mark.parametrize("rpm", [437.0, 1503.0, 1997.0, 5981.0])
@pytest.mark.parametrize("rate", [5000.0, 10000.0])
def test_constant_speed_at_one_percent_noise(rate: float, rpm: float, rng: np.random.Generator) -> None:
    """Within 0.05 % and degrees, also on the resonance, with a drifting gap and 2X content."""
    shaft = Shaft(rate, rpm, rpm, 4.0)
    speed, found = fit_steady(shaft.recorded(0.01, rng), Settings())
    errors(found, shaft.vectors(np.array([rpm]))[0], percent=0.05, degrees=0.05)
    assert speed / RPM == pytest.approx(rpm, rel=1e-5)


GRID = np.unique(np.concatenate([np.arange(700.0, 5900.0, 170.0), np.arange(1800.0, 2300.0, 25.0)]))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("rate", "first", "last", "damping"),
    [
        (10000.0, 600.0, 6000.0, 0.05),
        pytest.param(5000.0, 600.0, 6000.0, 0.1, marks=pytest.mark.nightly),
        pytest.param(5000.0, 100.0, 6000.0, 0.1, marks=pytest.mark.nightly),
        (5000.0, 6000.0, 600.0, 0.1),
    ],
)
def test_run_up_at_one_percent_noise(
    rate: float, first: float, last: float, damping: float, rng: np.random.Generator
) -> None:
    """60 s through a resonance, up or down: within 0.1 % and 0.1 degree at every speed and probe, 0.03 rms."""
    shaft = Shaft(rate, first, last, 60.0, damping)
    found = tracked(shaft, shaft.recorded(0.01, rng), GRID)
    off = errors(found, shaft.vectors(GRID), percent=0.1, degrees=0.1)
    assert np.sqrt(np.mean(np.square(off), axis=(1, 2))).max() < 0.03


@pytest.mark.slow
@pytest.mark.parametrize(("rate", "edge", "percent"), [(5000.0, 8.0, 0.12), (10000.0, 0.0, 0.1)])
def test_run_up_at_half_the_rate_or_with_a_sharp_tacho(
    rate: float, edge: float, percent: float, rng: np.random.Generator
) -> None:
    """At 5 kHz through a resonance of 5 %, noise alone leaves one answer in a hundred outside 0.1 %.

    Each pulse of sharp edges is known to half a sample only, 1.8 degrees at 6000 rpm: all of them together give 0.1.
    """
    shaft = Shaft(rate, 600.0, 6000.0, 60.0)
    found = tracked(shaft, shaft.recorded(0.01, rng, edge), GRID)
    amplitude, _ = errors(found, shaft.vectors(GRID), percent=percent, degrees=0.1)
    assert np.quantile(amplitude, 0.99) < 0.1


def test_without_noise_the_answer_is_exact(rng: np.random.Generator) -> None:
    shaft = Shaft(5000.0, 600.0, 6000.0, 30.0)
    turns = [lambda t: shaft.angle(t) / (2 * np.pi), lambda t: shaft.rpm(t) / 60]
    angle = ShaftAngle(lambda t, order=0: turns[order](t), 0.0, shaft.seconds - 1 / shaft.rate)
    exact = Signals(shaft.time, shaft.signals(0.0, rng), angle, "x")
    errors(tracked(shaft, exact, GRID[::5]), shaft.vectors(GRID[::5]), percent=2e-3, degrees=7e-4)


@pytest.mark.parametrize(
    ("damping", "noise", "step", "right", "percent", "wrong", "least"),
    [
        pytest.param(0.02, 0.01, 10.0, {}, 0.25, {"revolutions": 150.0}, 10.0, marks=pytest.mark.slow),
        (0.05, 0.0, 20.0, {"degree": 2, "revolutions": 20.0}, 0.1, {"degree": 0, "revolutions": 20.0}, 1.0),
    ],
    ids=["short windows at a sharp resonance", "an amplitude that changes in the window"],
)
def test_a_window_follows_the_resonance(
    damping: float,
    noise: float,
    step: float,
    right: dict[str, Any],
    percent: float,
    wrong: dict[str, Any],
    least: float,
    rng: np.random.Generator,
) -> None:
    """Two percent damping at 5 kHz: a long fixed window is wrong by tens of percent, the rule by tenths. A constant
    amplitude (degree 0) is biased in a run-up through the resonance; a polynomial is not."""
    shaft = Shaft(5000.0, 600.0, 6000.0, 60.0, damping)
    signals, near = shaft.recorded(noise, rng), np.arange(1900.0, 2100.0, step)
    errors(tracked(shaft, signals, near, Settings(**right)), shaft.vectors(near), percent=percent)
    assert errors(tracked(shaft, signals, near, Settings(**wrong)), shaft.vectors(near))[0].max() > least


def test_two_x_does_not_leak_where_it_is_fitted(rng: np.random.Generator) -> None:
    """With orders 1 only, 2X content disturbs a short window; with 2 it does not."""
    shaft = Shaft(5000.0, 1500.0, 1500.0, 0.25)
    true = shaft.vectors(np.array([1500.0]))[0]
    signals = shaft.recorded(0.0, rng)
    alone, _ = errors(fit_steady(signals, Settings(orders=1))[1], true)
    assert alone.max() > 0.1
    errors(fit_steady(signals, Settings(orders=2))[1], true, percent=alone.max() / 100)


def test_a_held_speed_in_a_run_up(rng: np.random.Generator) -> None:
    rate, t = 5000.0, np.arange(5000 * 30) / 5000.0
    phi = np.cumsum(np.interp(t, [0, 10, 20, 30], [900.0, 1500.0, 1500.0, 2100.0])) * RPM / rate
    true = 10e-6 * np.exp(-0.7j)
    values = np.real(true * np.exp(1j * phi))[:, None] + 1e-7 * rng.standard_normal((len(t), 1))
    angle = fit_angle(find_pulses(t, tacho_of(phi, 3.6), "rising", None, None, "x")[0], 1, "x")
    wanted = np.array([1000.0, 1499.0, 1501.0, 1900.0]) * RPM
    found = fit_sweep(Signals(t, values, angle, "x"), wanted, Settings())[0][:, 0]
    errors(found, np.full(4, true), percent=0.15, degrees=0.05)


@pytest.mark.parametrize("teeth", [2, 8])
def test_several_pulses_a_revolution_and_a_mark(teeth: int, rng: np.random.Generator) -> None:
    """The mark's channel says which pulse is zero; the vector is that of one pulse a revolution."""
    shaft = Shaft(10000.0, 1490.0, 1490.0, 3.0)
    many = find_pulses(shaft.time, shaft.tacho(rng, 8.0, teeth), "rising", None, None, "x")[0][1:]
    mark = find_pulses(shaft.time, shaft.tacho(rng), "rising", None, None, "x")[0]
    signals = Signals(shaft.time, shaft.signals(0.0, rng), fit_angle(many, teeth, "x", mark), "x")
    errors(fit_steady(signals, Settings())[1], shaft.vectors(np.array([1490.0]))[0], percent=1e-4, degrees=0.018)


Bad = Callable[[np.random.Generator], object]
SHAFT = Shaft(5000.0, 900.0, 900.0, 4.0)


def _pulses(signal: np.ndarray, threshold: float | None = None, hysteresis: float | None = None) -> np.ndarray:
    return find_pulses(SHAFT.time[: len(signal)], signal, "rising", threshold, hysteresis, "'run.h5'")[0]


BAD: dict[str, tuple[Bad, str]] = {
    "flat": (lambda rng: _pulses(np.full(1000, -9.5)), "must have tacho pulses, but the signal stays between -9.5"),
    "threshold beyond": (lambda rng: _pulses(SHAFT.tacho(rng), 3.0), "and the threshold is 3"),
    "hysteresis too wide": (lambda rng: _pulses(SHAFT.tacho(rng), -6.0, 30.0), "half the hysteresis of 30"),
    "only noise": (
        lambda rng: fit_angle(_pulses(rng.standard_normal(20000)), 1, "'run.h5'"),
        "must have evenly spaced tacho pulses",
    ),
    "one missing": (
        lambda rng: fit_angle(np.delete(_pulses(SHAFT.tacho(rng)), 20), 1, "'run.h5'"),
        "missing or doubled",
    ),
    "one twice": (
        lambda rng: fit_angle(np.sort(np.append(_pulses(SHAFT.tacho(rng)), 2.02)), 1, "'run.h5'"),
        "missing or doubled",
    ),
    "too few": (lambda rng: fit_angle(np.arange(4.0), 1, "'run.h5'"), "at least 6 tacho pulses"),
    "no mark": (
        lambda rng: fit_angle(np.arange(40.0), 2, "'run.h5'", np.array([100.0])),
        "must have a pulse in tacho.mark_channel within the record",
    ),
    "marks all over": (
        lambda rng: fit_angle(np.arange(60.0), 2, "'run.h5'", np.arange(0, 60, 0.7)),
        "check tacho.pulses_per_revolution",
    ),
    "speed that drifts": (
        lambda rng: fit_steady(Shaft(5000.0, 900.0, 990.0, 10.0).recorded(0.0, rng), Settings()),
        "must have a constant speed (to 1 %), but it goes from 9",
    ),
    "too coarse": (
        lambda rng: fit_steady(Shaft(300.0, 2000.0, 2000.0, 10.0).recorded(0.0, rng, 60.0), Settings()),
        "samples a revolution for 3 orders, but at 2000 rpm it has 9",
    ),
    "too few revolutions": (
        lambda rng: tracked(
            SHAFT, Shaft(5000.0, 600.0, 3000.0, 20.0).recorded(0.0, rng), np.array([900.0]), Settings(revolutions=3.0)
        ),
        "must have enough revolutions in a window to tell the orders apart",
    ),
    "beyond the run-up": (
        lambda rng: tracked(SHAFT, Shaft(5000.0, 600.0, 3000.0, 20.0).recorded(0.0, rng), np.array([700.0, 3001.0])),
        "nothing is extrapolated",
    ),
}


@pytest.mark.parametrize("case", BAD)
def test_what_can_not_be_tracked_is_refused(case: str, rng: np.random.Generator) -> None:
    act, words = BAD[case]
    with refused(words) as caught:
        act(rng)
    assert "the record" in str(caught.value) or "run.h5" in str(caught.value)


def test_the_speeds_that_a_record_covers(rng: np.random.Generator) -> None:
    """A window of eight revolutions must fit: its end speeds follow from constant acceleration."""
    low, high = find_range(Shaft(5000.0, 600.0, 6000.0, 60.0).recorded(0.0, rng), Settings())
    assert low / RPM == pytest.approx((600**2 + 2 * 90 * 60 * 4) ** 0.5, rel=0.02)
    assert high / RPM == pytest.approx(6000 - 90 * 60 * 4 / 6000, rel=1e-3)
