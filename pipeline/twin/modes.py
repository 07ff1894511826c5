"""Whirl modes of rotor and bearings: damped critical speeds, logarithmic decrement, stability; modes that responses to
a force show without a model.

Legend: S speeds, n DOF, K modes, L lines (frequencies of a force), P channels of all its places.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from pipeline.data.dataset import Excitation, VibrationDataset
from pipeline.rotor.bearing_table import BearingTable
from pipeline.rotor.dynamic_stiffness import assemble_systems
from pipeline.rotor.model import RotorModel
from pipeline.sweep.fit import RunUp, fit_near


@dataclass(frozen=True, eq=False)
class WhirlModes:
    """The oscillating modes of lowest frequency at each speed, by ascending frequency."""

    speeds: np.ndarray  # (S,) rad/s
    frequency: np.ndarray  # (S, K) damped natural frequency, rad/s; NaN where there are fewer modes
    logarithmic_decrement: np.ndarray  # (S, K)
    growth: np.ndarray  # (S,) largest real part among all eigenvalues, 1/s; positive is unstable, rounding is zero
    growing: np.ndarray  # (S,) imaginary part of that eigenvalue, rad/s; zero where it does not oscillate
    highest: float = 0.0  # rad/s, of what excited the machine; unbalance reaches modes up to twice the top speed

    @property
    def eigenvalues(self) -> np.ndarray:
        """(S, K) complex, 1/s."""
        return self.frequency * (1j - self.logarithmic_decrement / (2.0 * math.pi))


def find_modes(rotor: RotorModel, bearings: BearingTable, count: int = 8, highest: float = 0.0) -> WhirlModes:
    """Eigenvalues of ``M q'' + (C + W G + C_b) q' + (K + K_b) q = 0`` at the speeds of ``bearings``; ``highest`` is the
    frequency (rad/s) of what excited the machine."""
    n = rotor.n_dof
    mass, damping, stiffness = assemble_systems(rotor, bearings)
    inverse = np.linalg.inv(mass)  # one serves all speeds where no seal has mass
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
    rightmost = np.take_along_axis(eigenvalues, eigenvalues.real.argmax(axis=1)[:, None], axis=1)[:, 0]
    growth = rightmost.real
    # The sign of an undamped mode's real part is a matter of rounding.
    rounding = np.finfo(float).eps * 2 * n * np.abs(eigenvalues).max(axis=1)
    growth = np.where(np.abs(growth) < rounding, 0.0, growth)
    return WhirlModes(bearings.speeds, frequency, decrement, growth, np.abs(rightmost.imag), highest)


def follow_modes(modes: WhirlModes) -> np.ndarray:
    """(S, K) which mode of each speed continues the modes of the speed before: the nearest eigenvalues, all at once.

    By their order in frequency, modes of different damping change places where their frequencies meet.
    """
    from scipy.optimize import linear_sum_assignment

    values = modes.eigenvalues
    missing = 10.0 * np.nanmax(np.abs(values), initial=1.0)
    order = np.tile(np.arange(values.shape[1]), (len(values), 1))
    for s in range(1, len(values)):
        distance = np.abs(values[s - 1, order[s - 1], None] - values[s])
        order[s] = linear_sum_assignment(np.where(np.isnan(distance), missing, distance))[1]
    return order


def read_modes(
    dataset: VibrationDataset, deviation: np.ndarray, modes: WhirlModes, fewest_lines: int = 16
) -> np.ndarray:
    """(K, 4) damped natural frequencies in rad/s with their deviations, and logarithmic decrements with theirs, that
    the responses to forces show near each of the ``modes`` at the only speed there is; NaN where they show none.

    ``deviation`` (1, P, R) is the noise of the readings in m. Rotor and bearings are not asked, beside where to look.
    """
    read, places = np.full((modes.frequency.shape[1], 4), np.nan), dict[tuple[Excitation, ...], list[int]]()
    for r in np.argsort(dataset.frequencies[0]) if len(dataset.speeds) == 1 else ():
        places.setdefault(dataset.excitation_of(r), []).append(r)
    lines = [dataset.frequencies[0, runs] for runs in places.values()]
    if any(not np.array_equal(w, lines[0]) for w in lines) or len(np.unique(lines)) < fewest_lines:
        return read
    columns = [dataset.displacement[0, :, runs] / np.median(deviation[0, :, runs], axis=0) for runs in places.values()]
    w, accelerations = lines[0], lines[0][:, None] ** 2 * np.concatenate(columns, axis=1)  # (L,), (L, P)
    damped = modes.eigenvalues[0][modes.eigenvalues[0].real < 0]
    for k, mode in enumerate(modes.eigenvalues[0]):
        if mode in damped and w[0] - mode.real < mode.imag < w[-1] + mode.real:
            read[k] = _read_mode(w, accelerations, mode, damped)
    return read


def _read_mode(
    w: np.ndarray,
    accelerations: np.ndarray,
    mode: complex,
    every: np.ndarray,
    reach: float = 5.0,
    least: int = 32,
    alike: float = 0.1,
    told: float = 0.5,
    least_damping: float = 1.1e-3,
) -> np.ndarray:
    """(4,) as :func:`read_modes`, of the lines within ``reach`` half-power widths, or of the ``least`` nearest ones.

    Modes among these lines are fitted at once, those ``alike`` to a share of that width as a single one. A decrement is
    shown where its deviation is below the share ``told``, and the damping ratio above the least that the fit takes.
    """
    apart = np.abs(w - mode.imag)
    taken = apart <= max(-reach * mode.real, np.sort(apart)[:least][-1])
    poles = [mode, *every[(every.imag >= w[taken][0]) & (every.imag <= w[taken][-1])]]
    near = [p for i, p in enumerate(poles) if all(abs(p - other) > -alike * mode.real for other in poles[:i])]
    fitted = fit_near(RunUp(w[taken], accelerations[taken], 0.0), [(abs(p), -p.real / abs(p)) for p in near])
    roots = np.sqrt(1 - fitted.dampings**2)
    decrements = 2 * math.pi * fitted.dampings / roots
    spread = fitted.deviations * np.stack([roots, 2 * math.pi / roots**3], axis=1)
    i = np.abs(fitted.frequencies * roots - mode.imag).argmin()
    if spread[i, 1] > told * decrements[i] or fitted.dampings[i] < least_damping:
        return np.full(4, np.nan)
    return np.array([fitted.frequencies[i] * roots[i], spread[i, 0], decrements[i], spread[i, 1]])


@dataclass(frozen=True)
class CriticalSpeed:
    """A speed at which a damped natural frequency equals the rotor speed."""

    speed: float  # rad/s
    logarithmic_decrement: float
    place: tuple[int, int]  # (speed before it, mode)


def amplify(decrement: float, deviation: float = 0.0) -> tuple[float, float] | None:
    """The amplification factor ``1 / (2 zeta)`` of a logarithmic decrement ``d = 2 pi zeta / sqrt(1 - zeta^2)``.

    It is what API RP 684 reads from the half-power points of the response of one lightly damped mode,
    ``N_c / (N_2 - N_1)``, with no probe, weight or neighbouring mode in it; its short form is ``pi / d``. The second
    number is its standard deviation, from that of the decrement. None for a mode that is not damped.
    """
    if decrement <= 0:
        return None
    root = math.sqrt(4.0 * math.pi**2 + decrement**2)
    return root / (2.0 * decrement), 2.0 * math.pi**2 / (decrement**2 * root) * deviation


def require_separation(amplification: float | None, above: bool) -> float:
    """The separation margin in percent that API 617 asks of a critical speed ``above`` the running speed, or below it.

    ``17 (1 - 1 / (AF - 1.5))`` and at most 16 below; 10 more and at most 26 above. None, zero, is asked where AF < 2.5.
    """
    if amplification is not None and amplification < 2.5:
        return 0.0
    asked = 17.0 if amplification is None else 17.0 * (1.0 - 1.0 / (amplification - 1.5))
    return min(10.0 + asked, 26.0) if above else min(asked, 16.0)


def find_critical_speeds(modes: WhirlModes) -> list[CriticalSpeed]:
    """Crossings of the mode frequencies with the rotor speed, by linear interpolation between speeds.

    Modes are followed by their order in frequency. A line that jumps because a mode became overdamped makes
    a crossing only where it passes the synchronous line between two neighbouring speeds on a continuous branch.
    """
    speeds: list[CriticalSpeed] = []
    if len(modes.speeds) < 2:
        return speeds
    gap = modes.frequency - modes.speeds[:, None]  # (S, K)
    crosses = (gap[:-1] * gap[1:] < 0) | (gap[:-1] == 0)
    crosses[-1] |= gap[-1] == 0
    for k, s in np.argwhere((crosses & (gap[:-1] != gap[1:])).T).tolist():
        jump = abs(modes.frequency[s + 1, k] - modes.frequency[s, k])
        if jump > 0.25 * modes.frequency[s, k]:
            continue
        t = gap[s, k] / (gap[s, k] - gap[s + 1, k])
        speed = modes.speeds[s] + t * (modes.speeds[s + 1] - modes.speeds[s])
        values = modes.logarithmic_decrement[s : s + 2, k]
        decrement = values[0] + t * (values[1] - values[0])
        speeds.append(CriticalSpeed(float(speed), float(decrement), (s, k)))
    return sorted(speeds, key=lambda critical: critical.speed)


@dataclass(frozen=True)
class StabilityMargin:
    """How far a system stays from instability over its speed range."""

    largest_growth: float  # 1/s, over all modes and speeds; at most zero is stable
    smallest_logarithmic_decrement: float | None  # over the modes within twice the top speed; None without any
    at_speed: float | None  # rad/s, where that is
    place: tuple[int, int] | None  # (speed, mode) of it

    @property
    def stable(self) -> bool:
        """Whether nothing grows."""
        return self.largest_growth <= 0


class Stability(StrEnum):
    """Whether a growth is told from none."""

    STABLE = "stable"
    NOT_TOLD = "not told"
    UNSTABLE = "unstable"


def judge_growth(growth: float, deviation: float, deviations: float = 2.0) -> Stability:
    """What a largest real part and its deviation say, both in 1/s: unstable only beyond two ``deviations`` (95 %)."""
    if growth <= 0:
        return Stability.STABLE
    return Stability.UNSTABLE if growth > deviations * deviation else Stability.NOT_TOLD


def find_reached(modes: WhirlModes) -> np.ndarray:
    """(S, K) mask of the modes up to twice the top speed, or to the highest frequency that excited the machine: those
    above are reached by no unbalance."""
    return modes.frequency <= max(2.0 * modes.speeds.max(), modes.highest)  # false for NaN


def measure_stability(modes: WhirlModes) -> StabilityMargin:
    """The margin over all speeds.

    The decrement looks at modes up to twice the top speed: those far above have a decrement near zero in any
    finite element model without material damping, and no unbalance reaches them.
    """
    within = np.where(find_reached(modes), modes.logarithmic_decrement, np.inf)
    s, k = np.unravel_index(within.argmin(), within.shape)
    exists = np.isfinite(within[s, k])
    return StabilityMargin(
        float(modes.growth.max()),
        float(within[s, k]) if exists else None,
        float(modes.speeds[s]) if exists else None,
        (int(s), int(k)) if exists else None,
    )
