"""1X vectors of time signals: least squares of the shaft's orders in a window of revolutions around each wanted speed.

In a window around the time t_c at which the shaft has the wanted speed, a signal is fitted by

    v(t) = sum_i d_i x^i + sum_k sum_i (a_ki cos k phi(t) + b_ki sin k phi(t)) x^i,     x = (t - t_c) / half length

with the orders k = 1 ... K. Since each amplitude is a polynomial in time, a gap voltage that drifts, a second
harmonic, and a 1X amplitude and phase that change in the window do not bias the answer, V = a_10 - j b_10: the 1X
vector at the centre.

How long a window? With n samples of noise s (root mean square) and a polynomial of degree 6, each part of V has the
standard deviation s sqrt(2 g / n), g = 4.8: long windows have little of it. But a resonance of damping ratio z at the
speed n_r leaves the polynomial an error that grows with (half the speed span / z n_r)^8: short windows have little of
that. Nobody knows z beforehand, so the window is chosen at each speed (the rule of Goldenshluger and Lepski): from 8
revolutions (or 0.5 % of the speed, if that is more) it grows by a third at a time up to 30000 samples, and the one is
taken whose variance, plus the square of what its answer differs from shorter windows' by beyond noise, is least. All
windows of a centre share their sums, so they cost what the longest does.

Legend: n samples, P signals, K orders, S speeds. SI.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import pairwise

import numpy as np

from pipeline.config.measured import OrderTrackingConfig
from pipeline.errors import DataError
from pipeline.ingest.tacho import ShaftAngle
from pipeline.ingest.tracks import format_rpm

_TURN = 2 * np.pi


@dataclass(frozen=True, eq=False)
class Signals:
    """What was recorded together; ``where`` names it in messages."""

    time: np.ndarray  # (n,) s, ascending
    values: np.ndarray  # (n, P), as they are stored
    angle: ShaftAngle
    where: str
    late: float = 0.0  # s, by which all pulses of the tacho may be off together
    notes: tuple[str, ...] = ()  # sentences that need attention
    sizes: np.ndarray = field(default_factory=lambda: np.ones(1))  # (P,) m of a unit that is stored

    def between_pulses(self) -> Signals:
        """The samples from the first tacho pulse to the last: only there is the angle known."""
        keep = slice(*np.searchsorted(self.time, [self.angle.start, self.angle.end]))
        return replace(self, time=self.time[keep], values=self.values[keep])

    def displacement(self, samples: slice) -> np.ndarray:
        """(.., P) m of some ``samples``."""
        return np.asarray(self.values[samples] * self.sizes)

    def turning(self, samples: slice) -> np.ndarray:
        """(..,) e^{j phi} of some ``samples``."""
        return np.asarray(np.exp(1j * self.angle.angle(self.time[samples])))


def _make_columns(degrees: Sequence[int], x: np.ndarray, turning: np.ndarray) -> np.ndarray:
    """(columns, n) of the fit: polynomials of these ``degrees`` for DC, 1X, 2X .., ``turning`` (n,) = e^{j phi}."""
    powers = np.ones((1 + max(degrees), len(x)))
    for before, power in pairwise(powers):
        np.multiply(before, x, out=power)
    parts, harmonic = [powers[: degrees[0] + 1]], np.ones_like(turning)
    for degree in degrees[1:]:
        harmonic = harmonic * turning
        parts += [component * powers[: degree + 1] for component in (harmonic.real.copy(), harmonic.imag.copy())]
    return np.concatenate(parts)


def fit_steady(signals: Signals, settings: OrderTrackingConfig) -> tuple[float, np.ndarray]:
    """Mean speed in rad/s and 1X vectors (P,) of a record at constant speed, fitted to all of it.

    Raises DataError where the speed is not constant to 1 %, or the record is too short or too coarse.
    """
    signals = signals.between_pulses()
    speed = signals.angle.speed(signals.time)
    mean = float(speed.mean())
    drift = max(speed.max() / mean - 1, 1 - speed.min() / mean)
    if drift > 0.01:
        raise DataError(
            f"{signals.where} must have a constant speed (to 1 %), but it goes from {format_rpm(speed.min())} to "
            f"{format_rpm(speed.max())} rpm: cut the record, or give machine.recordings.records=run_up and "
            "machine.recordings.speeds"
        )
    _check_sampling(signals, mean, settings)
    centre = 0.5 * (signals.angle.start + signals.angle.end)
    half = 0.5 * (signals.angle.end - signals.angle.start)
    degrees = (1, settings.degree or 0, *[0] * (settings.orders - 1))
    ((vectors, _),) = _fit_each(signals, signals.turning, centre, [half], degrees)
    return mean, vectors


def fit_sweep(
    signals: Signals, speeds: np.ndarray, settings: OrderTrackingConfig, other_degree: int = 2
) -> tuple[np.ndarray, np.ndarray]:
    """1X vectors (S, P) of a run-up or run-down at ``speeds`` (S,) rad/s, each where it is passed first; and when,
    (S,) s.

    ``other_degree`` is that of the polynomials beside 1X at most.

    Raises DataError where a window around a speed is not inside the record: nothing is extrapolated.
    """
    signals = signals.between_pulses()
    centres = find_passages(signals, speeds, settings)
    _check_sampling(signals, float(speeds.max()), settings)
    windows = [
        _list_windows(signals, float(centre), float(speed), settings)
        for centre, speed in zip(centres, speeds, strict=True)
    ]
    turning: Callable[[slice], np.ndarray] = signals.turning
    if sum(2 * halves[-1] for halves in windows) > signals.time[-1] - signals.time[0]:
        turning = partial(np.ndarray.__getitem__, signals.turning(slice(None)))  # they overlap: once for all
    degree = 6 if settings.degree is None else settings.degree
    degrees = (other_degree, degree, *[min(other_degree, degree)] * (settings.orders - 1))
    fits = [
        _choose(_fit_each(signals, turning, float(centre), halves, degrees))
        for centre, halves in zip(centres, windows, strict=True)
    ]
    return np.array(fits), centres


def find_range(signals: Signals, settings: OrderTrackingConfig) -> tuple[float, float]:
    """The lowest and the highest speed (rad/s) around which a window fits into the record."""
    _, speed = _fit_windows(signals, settings, 4001)
    turned = np.diff(signals.angle.angle(np.array([signals.angle.start, signals.angle.end])))
    if not len(speed) or turned <= _TURN * (settings.shortest()):
        return np.inf, -np.inf
    return float(speed.min()), float(speed.max())


def _fit_windows(signals: Signals, settings: OrderTrackingConfig, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Those of ``count`` times (s) around which a window fits into the record, and the speeds (rad/s) there."""
    inner = _TURN * (settings.shortest()) / 2
    time = np.linspace(signals.angle.start, signals.angle.end, count)
    speed = signals.angle.speed(time)
    # A window is even in time: the faster half has more of its revolutions.
    fits = (time - inner / speed >= time[0]) & (time + inner / speed <= time[-1])
    return time[fits], speed[fits]


def find_passages(signals: Signals, speeds: np.ndarray, settings: OrderTrackingConfig) -> np.ndarray:
    """(S,) s, when each of ``speeds`` (S,) rad/s is passed first, at least half a window from both ends of the record.

    Raises DataError where a window around a speed is not inside the record.
    """
    low, high = find_range(signals, settings)
    if low > high or speeds.min() < low * (1 - 1e-6) or speeds.max() > high * (1 + 1e-6):
        revolutions = settings.shortest()
        range_ = f"{format_rpm(low)} to {format_rpm(high)} rpm" if low <= high else "nothing"
        raise DataError(
            f"{signals.where} must cover machine.recordings.speeds ({format_rpm(speeds.min())} to "
            f"{format_rpm(speeds.max())} rpm) with windows of {revolutions:g} revolutions, but it covers {range_}: "
            "nothing is extrapolated, choose machine.recordings.speeds within it"
        )
    time, speed = _fit_windows(signals, settings, max(4001, 4 * len(speeds)))
    centres = np.empty(len(speeds))
    for i, wanted in enumerate(speeds):
        wanted = np.clip(wanted, speed.min(), speed.max())
        apart = speed - wanted
        passed = np.flatnonzero(apart[:-1] * apart[1:] <= 0)[0]
        step = apart[passed] - apart[passed + 1]
        share = apart[passed] / step if step else 0.0
        centres[i] = time[passed] + share * (time[passed + 1] - time[passed])
    return centres


def _list_windows(
    signals: Signals,
    centre: float,
    speed: float,
    settings: OrderTrackingConfig,
    most_samples: int = 30000,
    growth: float = 4 / 3,
    least_span: float = 0.005,
    widest_first: int = 8,
) -> list[float]:
    """Half lengths of the windows to try, ascending, s: each ``growth`` times the one before, up to ``most_samples``.

    ``least_span`` is half the speed span of the shortest, over the speed: no resonance of a shaft in bearings is
    sharper. Where the speed is held, the first need not be the whole hold: ``widest_first`` times the fewest
    revolutions.
    """
    if settings.revolutions:
        return [0.5 * settings.revolutions * _TURN / speed]
    room = min(centre - signals.angle.start, signals.angle.end - centre)
    step = (signals.time[-1] - signals.time[0]) / (len(signals.time) - 1)
    most = min(room, 0.5 * most_samples * step)
    around = signals.angle.speed(np.array([centre - 0.1 * room, centre + 0.1 * room]))
    rate = abs(float(around[1] - around[0])) / (0.2 * room)
    half = 0.5 * settings.shortest() * _TURN / speed
    wide = min(least_span * speed / rate if rate > 0 else most, widest_first * half)
    halves = [min(max(half, wide), max(half, most))]
    while halves[-1] * growth <= most:
        halves.append(halves[-1] * growth)
    return halves


def _fit_each(
    signals: Signals,
    turning: Callable[[slice], np.ndarray],
    centre: float,
    halves: list[float],
    degrees: Sequence[int],
    most: int = 1 << 16,
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Vectors (P,) and their variance (P,) of the fit in each of the nested windows, ascending.

    The sums of one are kept for the next; they are made of so many samples at ``most`` together.
    """
    time = signals.time
    begin = end = int(np.searchsorted(time, centre))
    gram: np.ndarray | float = 0.0
    right: np.ndarray | float = 0.0
    squares: np.ndarray | float = 0.0
    a = degrees[0] + 1  # columns of a_10 and b_10
    b = a + degrees[1] + 1
    for half in halves:
        # A hair wider: a sample on the edge belongs to the window.
        wide = half * (1 + 1e-9)
        first, last = np.searchsorted(time, [centre - wide, centre + wide])
        for side in (*_cut(first, begin, most), *_cut(end, last, most)):
            values = signals.displacement(side)
            columns = _make_columns(degrees, (time[side] - centre) / halves[-1], turning(side))
            gram = gram + columns @ columns.T
            right = right + columns @ values
            squares = squares + (values * values).sum(axis=0)
        begin, end = int(first), int(last)
        inverse = _invert(np.asarray(gram), signals.where)
        solution = inverse @ right
        freedom = max(end - begin - len(solution), 1)
        noise = np.maximum(squares - (solution * right).sum(axis=0), 0.0) / freedom
        yield solution[a] - 1j * solution[b], noise * (inverse[a, a] + inverse[b, b])


def _cut(first: int, last: int, most: int) -> Iterator[slice]:
    """What lies from ``first`` to ``last``, in pieces of so many at ``most``; at least one, which may be empty."""
    return (slice(start, min(start + most, last)) for start in range(first, max(last, first + 1), most))


def _invert(gram: np.ndarray, where: str, worst_condition: float = 1e6) -> np.ndarray:
    """Inverse of the sums, scaled: powers of x in a short window are small.

    Raises DataError where orders are not apart: beyond the ``worst_condition`` number.
    """
    scale = 1 / np.sqrt(np.maximum(np.diag(gram), np.finfo(float).tiny))
    scaled = gram * scale * scale[:, None]
    try:
        inverse: np.ndarray = np.linalg.inv(scaled)
    except np.linalg.LinAlgError:
        inverse = np.full_like(scaled, np.inf)
    if np.abs(inverse).sum(axis=0).max() * np.abs(scaled).sum(axis=0).max() > worst_condition:
        raise DataError(
            f"{where} must have enough revolutions in a window to tell the orders apart, but it has not: give fewer "
            "machine.recordings.tracking.orders, a smaller machine.recordings.tracking.degree, or more "
            "machine.recordings.tracking.revolutions"
        )
    return inverse * scale * scale[:, None]


def _choose(
    answers: Iterator[tuple[np.ndarray, np.ndarray]],
    noise_limit: float = 9.0,
    hopeless: float = 100.0,
    nothing: float = 1e-30,
) -> np.ndarray:
    """(P,) of the window with the least error, as far as the shorter windows can tell.

    Noise explains ``noise_limit`` of a squared difference, over its variance (chi-square of two: it is passed once in
    90). Longer windows are not tried where one is worse than the best by the factor ``hopeless``. No variance is below
    ``nothing`` (m^2).
    """
    seen: list[tuple[np.ndarray, np.ndarray]] = []
    best, least = np.zeros(0, dtype=complex), np.inf
    for vectors, variance in answers:
        excess = np.zeros_like(variance)
        for shorter, varied in seen:
            # The long window has the short one's samples: their difference varies by what the short one has more.
            spread = np.maximum(varied - variance, 0.01 * varied)
            excess = np.maximum(excess, np.abs(vectors - shorter) ** 2 - noise_limit * spread)
        seen.append((vectors, variance))
        error = float(((excess + variance) / np.maximum(seen[0][1], nothing)).max())
        if error < least or not len(best):
            best, least = vectors, error
        elif error > hopeless * least:
            break
    return best


def _check_sampling(signals: Signals, fastest: float, settings: OrderTrackingConfig) -> None:
    rate = (len(signals.time) - 1) / (signals.time[-1] - signals.time[0]) if len(signals.time) > 1 else 0.0
    samples = rate * _TURN / fastest
    least = 2.5 * settings.orders + 2
    if samples < least:
        raise DataError(
            f"{signals.where} must have at least {least:g} samples a revolution for {settings.orders} orders, but at "
            f"{format_rpm(fastest)} rpm it has {samples:.3g}: give fewer machine.recordings.tracking.orders, or sample "
            "faster"
        )
