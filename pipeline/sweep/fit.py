"""Natural frequencies and damping ratios from amplitude and phase over the speed of one run-up.

The vectors are modelled as a sum of modes that respond to the ramp, and a slow background,

    V(Omega) = sum_k A_k Q(w_k, z_k; Omega, alpha) + sum_i B_i (Omega / Omega_m)^i

with Q of :mod:`pipeline.sweep.bias`. B_0 is the runout, which turns with the shaft; the other powers stand for what
further modes do below or above their own resonance. A_k and B_i (complex) are linear: they are solved for at each step
of the search for w_k and z_k (variable projection, Golub and Pereyra 1973).

The deviations are those of a delete-a-block jackknife (Kuensch 1989): the rows are cut into blocks, each is left out
once, and the scatter of the answers is theirs. Neighbouring rows may therefore go wrong together, as they do where the
model lacks something: the scatter then holds that, too.

The number of modes is chosen by Schwarz's criterion, with the number of independent numbers n / tau in place of n; tau
is the correlation time of the residual in rows.

Several channels share natural frequencies and damping ratios; A_k and B_i are each channel's own. Where nothing is
swept (rate 0), Q is also the acceleration over a force or a current at a standing rotor: then "speeds" are frequencies
of the excitation, and A_k holds the mode's participation over its modal mass.

Legend: S rows, K modes, B powers of the background, P channels (no axis for a single probe). SI, rad/s.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np

from pipeline.errors import DataError
from pipeline.sweep.bias import SteadyReading, decay_freely, find_mode, read_peak, respond_steadily, respond_to_ramp
from pipeline.units import RAD_S_PER_RPM
from pipeline.write_numbers import write_number

Rows = np.ndarray | slice
Respond = Callable[[float, float, np.ndarray, float], np.ndarray]
"""Frequency, damping, speeds (S,) and rate -> (S,) complex."""


@dataclass(frozen=True, eq=False)
class RunUp:
    """A probe, or channels, in a run-up or run-down at a constant rate; or responses to a force, at the rate 0."""

    FEWEST: ClassVar[int] = 40  # rows that are fitted
    speeds: np.ndarray  # (S,) rad/s, ascending
    vectors: np.ndarray  # (S,), or (S, P) for :func:`fit_near`; complex, angle as a lead of e^{j theta}
    rate: float  # rad/s^2
    rate_deviation: float | None = None  # rad/s^2, of a rate that was measured
    departure: float | None = None  # rad/s, the largest difference of a row from a straight ramp of that rate


@dataclass(frozen=True, eq=False)
class ModalFit:
    """Modes of a run-up, by ascending natural frequency."""

    frequencies: np.ndarray  # (K,) rad/s
    dampings: np.ndarray  # (K,)
    covariance: np.ndarray  # (2K, 2K) of the logarithms of frequencies and dampings, in turn
    amplitudes: np.ndarray  # (K,) or (K, P) complex, of A
    background: np.ndarray  # (B,) or (B, P) complex
    fitted: np.ndarray  # (S,) or (S, P) complex
    misfit: float  # root mean square of the residual over that of the vectors
    correlation: float  # tau, rows
    criterion: float  # Schwarz's, less is better

    @property
    def deviations(self) -> np.ndarray:
        """(K, 2) standard deviations of frequencies (rad/s) and damping ratios."""
        logs = np.sqrt(np.diag(self.covariance)).reshape(-1, 2)
        return logs * np.stack([self.frequencies, self.dampings], axis=1)


def measure_rate(speeds: np.ndarray, where: str) -> tuple[float, float, float]:
    """The rate of ``speeds`` (S,) rad/s, one a revolution: Omega^2 grows by 4 pi alpha a revolution.

    With it come its deviation (both rad/s^2), and the largest difference (rad/s) of a row from a straight ramp. Raises
    DataError, which begins with ``where``, for fewer than 40 rows.
    """
    if len(speeds) < RunUp.FEWEST:
        raise DataError(
            f"{where} must have at least {RunUp.FEWEST} rows (revolutions) on its ramp, but it has {len(speeds)}: give "
            "the range of the ramp (from_rpm, to_rpm)"
        )
    turns = np.arange(len(speeds))
    line, covariance = np.polyfit(turns, speeds**2, 1, cov=True)
    departure = np.abs(np.sqrt(np.maximum(np.polyval(line, turns), 0)) - speeds).max()
    scale = 1 / (4 * np.pi)
    return float(line[0] * scale), float(np.sqrt(covariance[0, 0]) * scale), float(departure)


def fit_modes(run_up: RunUp, count: int, degree: int = 2) -> ModalFit:
    """The best of ``count`` modes (1 or 2) with a background of this degree.

    Raises DataError for fewer than 40 rows, and where no peak has half its power on both sides.
    """
    if len(run_up.speeds) < RunUp.FEWEST:
        raise DataError(
            f"a run-up must have at least {RunUp.FEWEST} rows on its ramp, but it has {len(run_up.speeds)}: give the "
            "range of the ramp (from_rpm, to_rpm)"
        )
    return _fit(_Problem(run_up, count, degree), _list_starts(run_up, degree, count))


def fit_near(run_up: RunUp, modes: Sequence[tuple[float, float]], degree: int = 2) -> ModalFit:
    """The modes that are looked for near these natural frequencies (rad/s) and damping ratios, as many as are given.

    Channels count by the squares of their vectors: divide each by its noise.
    """
    return _fit(_Problem(run_up, len(modes), degree), [np.log(modes).ravel()])


def fit_decay(run_up: RunUp, near: float, degree: int = 2, small: float = 0.2, seen: float = 0.8) -> ModalFit | None:
    """The one mode, near the frequency ``near`` (rad/s), that dies away behind the peak; A is what it begins with.

    Behind the peak are the rows after the last one with the share ``small`` of the largest amplitude, in the order of
    the ramp; there it does not matter how the mode was excited. None for fewer than 40 rows, and for a decay that
    leaves more than the share ``seen`` of what a background alone leaves.
    """
    order = slice(None, None, 1 if run_up.rate > 0 else -1)
    speeds, vectors = run_up.speeds[order], run_up.vectors[order]
    sizes = np.abs(vectors)
    behind = slice(int(np.flatnonzero(sizes > small * sizes.max())[-1]) + 1, None)
    tail = RunUp(speeds[behind], vectors[behind], run_up.rate)
    if len(tail.speeds) < RunUp.FEWEST:
        return None
    fitted = _fit(
        _Problem(tail, 1, degree, decay_freely), [np.log([near * factor, 0.01]) for factor in (0.98, 1.0, 1.02)]
    )
    alone = np.vander(tail.speeds / tail.speeds.mean(), degree + 1).astype(complex)
    left = tail.vectors - alone @ np.linalg.lstsq(alone, tail.vectors, rcond=None)[0]
    return fitted if np.linalg.norm(tail.vectors - fitted.fitted) < seen * np.linalg.norm(left) else None


def respond_as_steady(run_up: RunUp, fit: ModalFit) -> np.ndarray:
    """(S,) complex, the modes and the background of a fit at constant speeds."""
    x = np.log(np.stack([fit.frequencies, fit.dampings], axis=1)).reshape(-1)
    problem = _Problem(
        run_up, len(fit.frequencies), len(fit.background) - 1, lambda w, z, speeds, _: respond_steadily(w, z, speeds)
    )
    return np.asarray(problem.columns(x) @ np.concatenate([fit.amplitudes, fit.background]))


def _fit(problem: _Problem, starts: list[np.ndarray], blocks: int = 16) -> ModalFit:
    """The best from the ``starts``; its covariance from leaving each of so many ``blocks`` of rows out."""
    solution = min((problem.solve(start) for start in starts), key=lambda tried: float(tried.cost))
    order = np.argsort(solution.x[::2])
    best = solution.x.reshape(-1, 2)[order].reshape(-1)
    columns, linear = problem.project(best)
    vectors = problem.run_up.vectors
    residual = vectors - columns @ linear
    # 1 + 2 sum of the autocorrelations up to the first that is not positive, rows.
    products = (float((residual[lag:] * residual[:-lag].conj()).real.sum()) for lag in range(1, len(residual) // 4))
    positive = sum(itertools.takewhile(lambda product: product > 0, products))
    tau = 1 + 2 * positive / float((abs(residual) ** 2).sum())
    rows = np.arange(len(vectors))
    answers = [problem.solve(best, ~np.isin(rows, block)).x for block in np.array_split(rows, blocks)]
    apart = np.array(answers) - np.mean(answers, axis=0)
    return ModalFit(
        frequencies=np.exp(best[::2]),
        dampings=np.exp(best[1::2]),
        covariance=np.asarray((blocks - 1) / blocks * apart.T @ apart),
        amplitudes=linear[: problem.count],
        background=linear[problem.count :],
        fitted=columns @ linear,
        misfit=float(np.linalg.norm(residual) / np.linalg.norm(vectors)),
        correlation=tau,
        criterion=_weigh(residual, 2 * problem.count + 2 * linear.size, tau),
    )


def fit_single_and_pair(run_up: RunUp, degree: int = 2) -> tuple[ModalFit, ModalFit]:
    """The fits with one and with two modes, of which Schwarz's criterion chooses.

    Both are weighed with the correlation of the better residual: what one mode leaves over is no noise.
    """
    single, two = fit_modes(run_up, 1, degree), fit_modes(run_up, 2, degree)
    residual = run_up.vectors - single.fitted
    return replace(single, criterion=_weigh(residual, 4 + 2 * (degree + 1), two.correlation)), two


def choose_sense(run_up: RunUp) -> tuple[RunUp, str, float]:
    """The run-up with its phases as leads, what they were (lead or lag), and how many times less is left over.

    Phases that are taken with the wrong sign go the wrong way through the resonance.
    """
    other = replace(run_up, vectors=run_up.vectors.conj())
    left = [fit_modes(run, 1).misfit for run in (run_up, other)]
    if left[0] <= left[1]:
        return run_up, "lead", left[1] / left[0]
    return other, "lag", left[0] / left[1]


@dataclass(frozen=True, eq=False)
class _Problem:
    """Variable projection of ``count`` modes; x has the logarithms of frequency and damping of each in turn.

    ``keep`` is a mask of the rows that are fitted; all by default.
    """

    run_up: RunUp
    count: int
    degree: int
    respond: Respond = respond_to_ramp

    def columns(self, x: np.ndarray) -> np.ndarray:
        """(S, K + B) complex."""
        speeds = self.run_up.speeds
        modes = [self.respond(w, z, speeds, self.run_up.rate) for w, z in np.exp(x).reshape(-1, 2).tolist()]
        ratio = speeds / speeds.mean()
        return np.stack([*modes, *(ratio**i + 0j for i in range(self.degree + 1))], axis=1)

    def project(self, x: np.ndarray, keep: Rows = slice(None)) -> tuple[np.ndarray, np.ndarray]:
        """Columns of all rows, and the linear numbers (K + B,) or (K + B, P) that fit the kept rows best."""
        columns = self.columns(x)
        return columns, np.linalg.lstsq(columns[keep], self.run_up.vectors[keep], rcond=None)[0]

    def residual(self, x: np.ndarray, keep: Rows = slice(None)) -> np.ndarray:
        """(2 S P,) real, over the root mean square of the vectors."""
        columns, linear = self.project(x, keep)
        left = (columns @ linear - self.run_up.vectors)[keep].ravel()
        return np.concatenate([left.real, left.imag]) / np.sqrt((np.abs(self.run_up.vectors) ** 2).mean())

    def solve(
        self, start: np.ndarray, keep: Rows = slice(None), least_damping: float = 1e-3, most_damping: float = 0.4
    ) -> Any:
        """The least squares from ``start`` (2K,)."""
        from scipy.optimize import least_squares

        speeds = self.run_up.speeds
        bounds = np.log([[0.5 * speeds.min(), least_damping], [1.5 * speeds.max(), most_damping]])
        least, most = (np.tile(row, self.count) for row in bounds)
        start = np.clip(start, least + 1e-6, most - 1e-6)
        scale = np.tile([0.01, 0.2], self.count)
        return least_squares(self.residual, start, bounds=(least, most), x_scale=scale, args=(keep,))


def _list_starts(
    run_up: RunUp, degree: int, count: int, apart: tuple[float, ...] = (0.95, 0.98, 1.02, 1.05, 1.1)
) -> list[np.ndarray]:
    """Where modes are looked for: the first at the peak, a second one ``apart``, over the frequency of the first."""
    reading = read_smoothed_peak(run_up, 3)
    if reading is None:
        raise DataError(
            "a run-up must have a peak with half its power on both sides, but the largest amplitude of "
            f"{write_number(run_up.speeds[0] / RAD_S_PER_RPM)} to {write_number(run_up.speeds[-1] / RAD_S_PER_RPM)} "
            "rpm has not: give a wider range (from_rpm, to_rpm)"
        )
    frequency, damping = find_mode(reading, run_up.rate)
    first = [np.log([frequency * factor, max(damping, 0.01)]) for factor in (0.98, 1.0)]
    if count == 1:
        return first
    problem = _Problem(run_up, 1, degree)
    single = min((problem.solve(start) for start in first), key=lambda tried: tried.cost).x
    return [np.concatenate([single, [single[0] + np.log(factor), single[1]]]) for factor in apart]


def _weigh(residual: np.ndarray, parameters: int, tau: float) -> float:
    independent = 2 * residual.size / tau
    mean = float((np.abs(residual) ** 2).mean())
    return independent * np.log(mean) + parameters * np.log(independent)


def read_smoothed_peak(run_up: RunUp, rows: int) -> SteadyReading | None:
    """The steady reading of the amplitude's mean over ``rows`` rows, at the ends those that there are; None without a
    peak.
    """
    both = np.abs(run_up.vectors), np.ones(len(run_up.vectors))
    total, counts = (np.convolve(each, np.ones(rows), "same") for each in both)
    return read_peak(run_up.speeds, total / counts)
