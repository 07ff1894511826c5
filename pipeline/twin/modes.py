"""Whirl modes of rotor and bearings: damped critical speeds, logarithmic decrement, stability.

Legend: S speeds, n DOF, K modes.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from pipeline.rotor.bearing_table import BearingTable
from pipeline.rotor.model import RotorModel, bearing_dof


@dataclass(frozen=True, eq=False)
class WhirlModes:
    """The oscillating modes of lowest frequency at each speed, by ascending frequency."""

    speeds: np.ndarray  # (S,) rad/s
    frequency: np.ndarray  # (S, K) damped natural frequency, rad/s; NaN where there are fewer modes
    logarithmic_decrement: np.ndarray  # (S, K)
    growth: np.ndarray  # (S,) largest real part among all eigenvalues, 1/s; positive is unstable, rounding is zero


def find_modes(rotor: RotorModel, bearings: BearingTable, count: int = 8) -> WhirlModes:
    """Eigenvalues of ``M q'' + (C + W G + C_b) q' + (K + K_b) q = 0`` at the speeds of ``bearings``."""
    n, places = rotor.n_dof, bearing_dof(rotor)
    # One factorisation of the mass serves all speeds; only bearings and gyroscopic terms change.
    inverse = np.linalg.inv(rotor.mass)
    stiffness = np.broadcast_to(rotor.stiffness, (len(bearings.speeds), n, n)).copy()
    damping = rotor.damping + bearings.speeds[:, None, None] * rotor.gyroscopic
    blocks = bearings.values.reshape(*bearings.values.shape[:2], 2, 2, 2)
    for b, pair in enumerate(places):
        where = (slice(None), *np.ix_(pair, pair))
        stiffness[where] += blocks[b, :, 0]
        damping[where] += blocks[b, :, 1]
    state = np.zeros((len(bearings.speeds), 2 * n, 2 * n))
    state[:, :n, n:] = np.eye(n)
    state[:, n:, :n] = -inverse @ stiffness
    state[:, n:, n:] = -inverse @ damping
    eigenvalues = np.linalg.eigvals(state)
    frequency = np.full((len(state), count), np.nan)
    decrement = np.full((len(state), count), np.nan)
    for s, values in enumerate(eigenvalues):
        # Overdamped modes are real; rounding leaves them a trace of an imaginary part.
        whirling = values[values.imag > 1e-6 * np.abs(values)]
        whirling = whirling[np.argsort(whirling.imag)][:count]
        frequency[s, : len(whirling)] = whirling.imag
        decrement[s, : len(whirling)] = -2.0 * math.pi * whirling.real / whirling.imag
    growth = eigenvalues.real.max(axis=1)
    # The sign of an undamped mode's real part is a matter of rounding.
    rounding = np.finfo(float).eps * 2 * n * np.abs(eigenvalues).max(axis=1)
    return WhirlModes(bearings.speeds, frequency, decrement, np.where(np.abs(growth) < rounding, 0.0, growth))


@dataclass(frozen=True)
class CriticalSpeed:
    """A speed at which a damped natural frequency equals the rotor speed."""

    speed: float  # rad/s
    logarithmic_decrement: float


def find_critical_speeds(modes: WhirlModes) -> list[CriticalSpeed]:
    """Crossings of the mode frequencies with the rotor speed, by linear interpolation between speeds.

    Modes are followed by their order in frequency. A line that jumps because a mode became overdamped makes
    a crossing only where it passes the synchronous line between two neighbouring speeds on a continuous branch.
    """
    found: list[CriticalSpeed] = []
    if len(modes.speeds) < 2:
        return found
    gap = modes.frequency - modes.speeds[:, None]  # (S, K)
    for k in range(gap.shape[1]):
        crosses = (gap[:-1, k] * gap[1:, k] < 0) | (gap[:-1, k] == 0)
        crosses[-1] |= gap[-1, k] == 0
        for s in np.flatnonzero(crosses & (gap[:-1, k] != gap[1:, k])):
            jump = abs(modes.frequency[s + 1, k] - modes.frequency[s, k])
            if jump > 0.25 * modes.frequency[s, k]:
                continue
            t = gap[s, k] / (gap[s, k] - gap[s + 1, k])
            speed = modes.speeds[s] + t * (modes.speeds[s + 1] - modes.speeds[s])
            values = modes.logarithmic_decrement[s : s + 2, k]
            found.append(CriticalSpeed(float(speed), float(values[0] + t * (values[1] - values[0]))))
    return sorted(found, key=lambda critical: critical.speed)


@dataclass(frozen=True)
class StabilityMargin:
    """How far a system stays from instability over its speed range."""

    stable: bool
    largest_growth: float  # 1/s, over all modes and speeds; at most zero is stable
    smallest_logarithmic_decrement: float | None  # over the modes within twice the top speed; None without any
    at_speed: float | None  # rad/s, where that is


def measure_stability(modes: WhirlModes) -> StabilityMargin:
    """The margin over all speeds.

    The decrement looks at modes up to twice the top speed: those far above have a decrement near zero in any
    finite element model without material damping, and no unbalance reaches them.
    """
    within = np.where(modes.frequency <= 2.0 * modes.speeds.max(), modes.logarithmic_decrement, np.inf)
    s, k = np.unravel_index(np.nanargmin(np.where(np.isnan(within), np.inf, within)), within.shape)
    found = np.isfinite(within[s, k])
    return StabilityMargin(
        bool((modes.growth <= 0).all()),
        float(modes.growth.max()),
        float(within[s, k]) if found else None,
        float(modes.speeds[s]) if found else None,
    )
