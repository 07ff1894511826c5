"""The response of a mode to a sweep of the speed, and what the steady reading of its peak is off.

The shaft turns by theta(t), Omega = d theta / dt, alpha = d Omega / dt. A mode of natural frequency w and damping ratio
z, with the unbalance u (mass times eccentricity over the modal mass), follows

    q'' + 2 z w q' + w^2 q = u (Omega^2 - j alpha) e^{j theta} = -u d^2/dt^2 e^{j theta}

An order tracker gives Q = q e^{-j theta}, the vector on the turning shaft. With the pole s = -z w + j w sqrt(1 - z^2)
and its conjugate, and h(t) = (e^{st} - e^{s* t}) / (s - s*),

    Q = -u [ (s^2 J(s) - s*^2 J(s*)) / (s - s*) + 1 ],   J(s) = integral_0^inf e^{(s - j Omega) v + j alpha v^2 / 2} dv

for a sweep that began long before. J is a complex error function, J = sqrt(pi) / (2 r) w(j (j Omega - s) / (2 r)) with
r = sqrt(-j alpha / 2) and Faddeeva's w: F. M. Lewis, "Vibration during acceleration through a critical speed", Trans.
ASME 54 (1932) 253-261, in the form of I. Fernlund, Trans. Chalmers Univ. 273 (1963). Without a sweep J = 1 / (j Omega -
s), and Q is the steady response u Omega^2 / (w^2 - Omega^2 + 2 j z w Omega).

A sweep passes the peak before it has built up, later and lower, and leaves a wider one: the steady rules, natural
frequency from the peak and damping ratio from the width where the power is half, then give a natural frequency that is
too high in a run-up (too low in a run-down) and too much damping.

Legend: S speeds. SI, rad/s.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.units import RAD_S_PER_RPM
from pipeline.write_numbers import write_number, write_rough


def respond_to_ramp(frequency: float, damping: float, speeds: np.ndarray, rate: float) -> np.ndarray:
    """Q (S,) complex of the unit unbalance u = 1 at ``speeds`` (S,) rad/s of a sweep at ``rate`` rad/s^2.

    ``frequency`` w is in rad/s, ``damping`` z between 0 and 1. A negative ``rate`` is a run-down.
    """
    pole = frequency * complex(-damping, np.sqrt(1 - damping**2))
    other = pole.conjugate()
    parts = pole**2 * _integrate(pole, speeds, rate) - other**2 * _integrate(other, speeds, rate)
    return np.asarray(-parts / (pole - other) - 1)


def respond_steadily(frequency: float, damping: float, speeds: np.ndarray) -> np.ndarray:
    """Q (S,) complex of the same at constant speeds."""
    return np.asarray(speeds**2 / (frequency**2 - speeds**2 + 2j * damping * frequency * speeds))


def decay_freely(frequency: float, damping: float, speeds: np.ndarray, rate: float) -> np.ndarray:
    """e^{s t - j theta} (S,) complex: a mode that dies away as a tracker sees it, 1 at the first of ``speeds`` (S,).

    Speeds are in rad/s; ``rate`` is in rad/s^2, and not zero.
    """
    pole = frequency * complex(-damping, np.sqrt(1 - damping**2))
    time = (speeds - speeds[0]) / rate
    angle = (speeds**2 - speeds[0] ** 2) / (2 * rate)
    return np.asarray(np.exp(pole * time - 1j * angle))


def _integrate(pole: complex, speeds: np.ndarray, rate: float) -> np.ndarray:
    """J (S,) of the ``pole``."""
    from scipy.special import wofz

    apart = 1j * speeds - pole
    if rate == 0:
        return np.asarray(1 / apart)
    # The principal root has a positive real part for both signs of the rate: the integral converges.
    root = np.sqrt(-0.5j * rate)
    return np.asarray(np.sqrt(np.pi) / (2 * root) * wofz(1j * apart / (2 * root)))


@dataclass(frozen=True)
class SteadyReading:
    """A peak as the steady rules read it."""

    frequency: float  # rad/s, of the largest amplitude
    damping: float  # (Omega_2 - Omega_1) / (2 Omega_peak) where the amplitude is 1/sqrt(2) of the largest
    amplitude: float  # the largest, in the unit of what was read

    @property
    def amplification(self) -> float:
        """Q = 1 / (2 damping)."""
        return 1 / (2 * self.damping)


@dataclass(frozen=True)
class SweepBias:
    """What a sweep adds to the steady reading of a mode."""

    frequency: float  # natural frequency of the mode, rad/s
    damping: float  # its damping ratio
    rate: float  # rad/s^2
    peak_shift: float  # share of the steady peak's speed
    damping_factor: float  # the reading of the damping over that of the steady response
    amplitude_factor: float  # the same of the largest amplitude
    limit: float  # rad/s^2, at which |peak_shift| is ``most``
    most: float  # share


def read_peak(speeds: np.ndarray, amplitudes: np.ndarray) -> SteadyReading | None:
    """Read the largest peak of ``amplitudes`` (S,) over ascending ``speeds`` (S,) rad/s.

    None where the largest is at an end, or the amplitude does not fall to half its power on both sides.
    """
    from scipy.signal import peak_widths

    top, last = int(np.argmax(amplitudes)), len(amplitudes) - 1
    largest, half = float(amplitudes[top]), 1 / np.sqrt(2)
    if top in (0, last) or max(amplitudes[:top].min(), amplitudes[top:].min()) > half * largest:
        return None
    # Its height is counted from zero, not from the valleys beside it.
    whole = (np.array([largest]), np.array([0]), np.array([last]))
    _, _, *ends = peak_widths(amplitudes, [top], 1 - half, prominence_data=whole)
    below, above = np.interp(np.ravel(ends), np.arange(last + 1), speeds)
    return SteadyReading(float(speeds[top]), float(above - below) / (2 * float(speeds[top])), largest)


def read_ramp(frequency: float, damping: float, rate: float, points: int = 4001, most: float = 0.5) -> SteadyReading:
    """The steady reading of a mode (rad/s, ratio) that is swept at ``rate`` rad/s^2 with the unit unbalance.

    A damping that leaves no peak is read as ``most``.
    """
    # The width of the peak and its lag grow with the damping and with the root of the rate.
    reach = min(12 * (damping * frequency + np.sqrt(abs(rate))), 0.9 * frequency)
    before, after = (reach, 4 * reach) if rate >= 0 else (4 * reach, reach)
    speeds = np.linspace(max(frequency - before, 0.05 * frequency), frequency + after, points)
    amplitudes = np.abs(respond_to_ramp(frequency, damping, speeds, rate))
    reading = read_peak(speeds, amplitudes)
    if reading is None:  # so much damping that nothing falls to half the power
        return SteadyReading(frequency, most, 1.0)
    # A lag of 1 % is seen on this grid to a twentieth only: a parabola through three points has the rest.
    top = int(np.argmax(amplitudes))
    before, at, after = amplitudes[top - 1 : top + 2]
    peak = reading.frequency + 0.5 * (before - after) / (before - 2 * at + after) * (speeds[1] - speeds[0])
    return SteadyReading(float(peak), reading.damping * reading.frequency / peak, reading.amplitude)


def measure_bias(frequency: float, damping: float, rate: float, most: float) -> SweepBias:
    """The bias of the steady reading of a mode (rad/s, ratio) at ``rate`` rad/s^2, and the rate with the lag ``most``.

    The steady response of the same mode is what it is compared with: the two rules are not exact themselves.
    """
    steady, swept = read_ramp(frequency, damping, 0.0), read_ramp(frequency, damping, rate)
    return SweepBias(
        frequency,
        damping,
        rate,
        swept.frequency / steady.frequency - 1,
        swept.damping / steady.damping,
        swept.amplitude / steady.amplitude,
        find_slow_rate(frequency, damping, most),
        most,
    )


def find_slow_rate(frequency: float, damping: float, most: float, slowest: float = 1e-9, fastest: float = 1.0) -> float:
    """The rate in rad/s^2 above which the peak of a mode lags by more than the share ``most`` of its speed.

    It is looked for from ``slowest`` to ``fastest``, over the natural frequency squared.
    """
    from scipy.optimize import brentq

    steady = read_ramp(frequency, damping, 0.0).frequency

    def excess(log_rate: float) -> float:
        return read_ramp(frequency, damping, np.exp(log_rate) * frequency**2).frequency / steady - 1 - most

    if excess(np.log(fastest)) < 0:
        return fastest * frequency**2
    return float(np.exp(brentq(excess, np.log(slowest), np.log(fastest), xtol=1e-4)) * frequency**2)


def find_mode(
    reading: SteadyReading, rate: float, least_damping: float = 1e-4, most_damping: float = 0.5
) -> tuple[float, float]:
    """Natural frequency (rad/s) and damping ratio of the one mode that gives the ``reading`` at ``rate`` rad/s^2.

    Where the sweep alone makes a peak as wide, the damping ratio is the least that is tried.
    """
    from scipy.optimize import least_squares

    def differ(logs: np.ndarray) -> np.ndarray:
        ramp = read_ramp(float(np.exp(logs[0])), float(np.exp(logs[1])), rate)
        return np.array([np.log(ramp.frequency / reading.frequency), np.log(ramp.damping / reading.damping)])

    least = np.log([0.5 * reading.frequency, least_damping])
    most = np.log([1.5 * reading.frequency, most_damping])
    start = np.log([reading.frequency, min(max(0.5 * reading.damping, 2 * least_damping), 0.4)])
    fitted = least_squares(differ, start, bounds=(least, most), diff_step=1e-3, x_scale=[0.01, 0.3])
    return float(np.exp(fitted.x[0])), float(np.exp(fitted.x[1]))


def summarize_bias(bias: SweepBias) -> dict[str, float]:
    """The bias for JSON."""
    return {
        "peak_shift_percent": 100 * bias.peak_shift,
        "damping_factor": bias.damping_factor,
        "amplitude_factor": bias.amplitude_factor,
        "rate_limit_rpm_per_s": bias.limit / RAD_S_PER_RPM,
    }


def describe_bias(bias: SweepBias) -> str:
    """Write the bias as a sentence."""
    rpm = 1 / RAD_S_PER_RPM
    shift = f"{write_rough(100 * abs(bias.peak_shift))} % too {'high' if bias.peak_shift > 0 else 'low'}"
    return (
        f"a sweep of {write_number(abs(bias.rate) * rpm, digits=3)} rpm/s reads the natural frequency of "
        f"{write_number(bias.frequency * rpm)} rpm {shift}, and its damping ratio of {write_rough(bias.damping)} as "
        f"{write_rough(bias.damping_factor * bias.damping)}: below "
        f"{write_rough(bias.limit * rpm)} rpm/s the peak lags by less than {write_number(100 * bias.most, digits=3)} %"
    )
