"""Coefficients of each speed from few sensors: a stationary Kalman smoother over frequency, then least squares.

With the coefficients at hand, the model predicts the motion. What its bearings lack acts as an unknown force f at
the bearings, of which the filter knows the size beforehand, a share of the bearing force. Its update from the measured
displacement gives f and the motion of the bearings, ``f = P a' (a P a' + R)^-1 (measured - predicted)``, and least
squares over the runs gives the coefficients, ``H_new q_b = H q_b - f`` (Kang, Shi, Zhang, Zhen and Gu 2020). That is
repeated until nothing changes. Kang et al. filter in time. Here the motion is stationary and its state are the complex
amplitudes, so that one measurement update with a prior, at each frequency by itself, is all that is left of the filter.

Legend: B bearings, M members (B, or 1 where they share their coefficients), S speeds, P channels, R runs, U unknowns.
"""

from __future__ import annotations

import numpy as np

from pipeline.coefficients import is_direct
from pipeline.problem.expansion import bearing_equations_of
from pipeline.problem.measurement import Measurement
from pipeline.problem.residual import linear_residual, per_speed_least_squares
from pipeline.problem.response import respond


def measure_rest(data: Measurement, values: np.ndarray) -> np.ndarray:
    """(S,) of what unknowns (M, S, U) leave over, in units of the noise."""
    predicted = data.response.predict(data.table(values))
    left_over = (predicted - data.dataset.displacement) / data.deviation
    return np.asarray((np.abs(left_over) ** 2).mean(axis=(1, 2)))


def update_unknowns(data: Measurement, values: np.ndarray, measured: np.ndarray, share: float = 1.0) -> np.ndarray:
    """(M, S, U) unknowns after one update of every run by ``measured`` (S, P, R), and least squares.

    Beforehand the root mean square of the unknown force is a ``share`` of the bearing force.
    """
    table, equations = data.table(values), data.response
    force = np.empty((len(table.speeds), 2 * len(table.nodes), measured.shape[2]), dtype=complex)
    displacements = np.empty_like(force)  # at the bearings; the force is that of the bearings on the shaft
    for block in equations.films:
        response = respond(block, equations.change(table, block))
        impedance = table.impedance(block.frequencies)  # (B, S, 2, 2)
        bearing = _product(impedance, response.bearings)
        for i, run in enumerate(block.runs):
            prior = (share * np.abs(bearing[:, :, i])) ** 2
            gain = _gain(response.receptance_sensors, prior, data.deviation[:, :, run])
            unknown = gain @ (measured[:, :, run] - response.sensors[:, :, i])[..., None]
            motion = response.bearings[:, :, [i]] + response.receptance_bearings @ unknown
            displacements[..., run] = motion[..., 0]
            force[..., run] = (unknown - _product(impedance, motion))[..., 0]
    equations_at = bearing_equations_of(equations, force, displacements)
    return per_speed_least_squares(linear_residual(equations_at, data.unknowns, data.known))[0]


def filter_bearings(
    measurement: Measurement,
    sizes: tuple[float, ...] = (1.0, 10.0, 0.1),
    explained: float = 2.0,
    hopeless: float = 0.1,
) -> tuple[np.ndarray, np.ndarray]:
    """Unknowns (M, S, U) that an update leaves as they are, and (S,) where that was reached.

    Args:
        sizes: the guess is tried in these, the later ones where the earlier ones left something unexplained.
        explained: mean square over the noise up to which readings count as such.
        hopeless: share of the speeds that must settle from the first guess for others to be tried.
    """
    unknowns = measurement.unknowns
    n_speeds, guess = len(measurement.dataset.speeds), measurement.guess.sizes(unknowns)
    direct = np.array([is_direct(name) for name in unknowns.names])
    start = np.repeat((guess * direct)[:, None], n_speeds, axis=1)
    best, settled, least = start.copy(), np.zeros(n_speeds, dtype=bool), np.full(n_speeds, np.inf)
    for size in sizes:
        todo = np.flatnonzero(~(settled & (least <= explained)))
        if not len(todo):
            break
        waiting = measurement.select(todo)
        values, still = _settle(waiting, size * start[:, todo], direct)
        left_over = np.where(still, measure_rest(waiting, values), np.inf)
        better = left_over < least[todo]
        best[:, todo[better]], least[todo[better]] = values[:, better], left_over[better]
        settled[todo[better]] = True
        if settled.mean() < hopeless:
            break
    return best, settled


def _settle(
    measurement: Measurement,
    values: np.ndarray,
    direct: np.ndarray,
    rounds: int = 300,
    at_once: int = 25,
    longest: float = 3.0,
    settled: float = 1e-10,
) -> tuple[np.ndarray, np.ndarray]:
    """Rounds from ``values`` (M, S, U) until each speed is done, and (S,) which are.

    A speed is done where a round changes no unknown by more than the share ``settled``, asked after so many rounds
    ``at_once``. Direct coefficients get no more than the ``longest`` times larger or smaller in a round.
    """
    values, still = values.copy(), np.zeros(values.shape[1], dtype=bool)
    with np.errstate(all="ignore"):  # of speeds that run away
        for _ in range(rounds // at_once):
            todo = np.flatnonzero(~still)
            if not len(todo):
                break
            waiting, estimates = measurement.select(todo), values[:, todo]
            for _ in range(at_once):
                new = update_unknowns(waiting, estimates, waiting.dataset.displacement)
                new = np.where(direct, np.clip(new, estimates / longest, estimates * longest), new)
                new = np.where(np.isfinite(new), new, estimates)
                change = np.abs(new - estimates) <= settled * np.maximum(np.abs(new), np.abs(estimates))
                estimates = new
            values[:, todo], still[todo] = estimates, np.all(change, axis=(0, 2))
    return values, still


def _gain(at_sensors: np.ndarray, prior: np.ndarray, deviation: np.ndarray) -> np.ndarray:
    """(S, 2 B, P) Kalman gain for forces of the variance ``prior`` (S, 2 B), seen through ``at_sensors`` (S, P, 2 B).

    ``P a' (a P a' + R)^-1 = (P^-1 + a' R^-1 a)^-1 a' R^-1``: the smaller of the two matrices is solved.
    """
    adjoint = at_sensors.conj().swapaxes(1, 2)
    n_channels, count = at_sensors.shape[1:]
    if n_channels < count:
        spread = prior[:, :, None] * adjoint
        innovation = at_sensors @ spread
        innovation[:, range(n_channels), range(n_channels)] += deviation**2
        return np.asarray(np.linalg.solve(innovation, spread.conj().swapaxes(1, 2)).conj().swapaxes(1, 2))
    weighted = adjoint / deviation[:, None] ** 2
    information = weighted @ at_sensors
    information[:, range(count), range(count)] += 1 / prior
    return np.asarray(np.linalg.solve(information, weighted))


def _product(impedance: np.ndarray, motion: np.ndarray) -> np.ndarray:
    """(S, 2 B, R) of blocks (B, S, 2, 2) and (S, 2 B, R)."""
    blocks = motion.reshape(len(motion), len(impedance), 2, -1)
    return np.asarray(np.einsum("bsij,sbjr->sbir", impedance, blocks).reshape(motion.shape))
