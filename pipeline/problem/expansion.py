"""Expansion: forces and motion at the bearings from whatever sensors there are.

Where the sensors are enough to tell the forces at the bearings, least squares on ``q_s = u0_s + a_sb f``
(:mod:`pipeline.problem.response`) gives f, the motion q_b of the bearings follows, and ``r = f + dH q_b`` is the
residual of the equation of motion.

Else a stationary Kalman smoother over frequency: with the coefficients at hand, the model predicts the motion. What its
bearings lack acts as an unknown force f at the bearings, of which the filter knows the size beforehand, a share of the
bearing force. Its update from the measured displacement gives f and the motion of the bearings,
``f = P a' (a P a' + R)^-1 (measured - predicted)``, and least squares over the runs gives the coefficients,
``H_new q_b = H q_b - f`` (Kang, Shi, Zhang, Zhen and Gu 2020). That is repeated until nothing changes. Kang et al.
filter in time. Here the motion is stationary and its state are the complex amplitudes, so that one measurement update
with a prior, at each frequency by itself, is all that is left of the filter.

Legend: S speeds, P channels, R runs, B bearings, M members (B, or 1 where they share their coefficients), U unknowns.
SI units.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.coefficients import is_direct
from pipeline.problem.measurement import Measurement
from pipeline.problem.noise import UNMEASURED
from pipeline.problem.residual import BearingEquations, linear_residual, per_speed_least_squares
from pipeline.problem.response import ResponseEquations, respond
from pipeline.rotor.bearing_table import BearingTable


@dataclass(frozen=True, eq=False)
class Expansion:
    """The residual at the bearings, from whatever sensors there are, and what their noise makes of it."""

    equations: BearingEquations
    receptance: np.ndarray  # a_bb of every run, (S, R, 2 B, 2 B)
    force_root: np.ndarray  # of the covariance of f, (S, R, 2 B, P) N

    def residual_root(self, equations: ResponseEquations, bearings: BearingTable) -> np.ndarray:
        """(S, R, 2 B, P) complex, N, of the covariance: ``dr = (I + dH a_bb) df``, near the ``bearings``."""
        result = np.empty_like(self.force_root)
        for block in equations.films:
            change = equations.change(bearings, block)[:, None]
            factor = np.eye(change.shape[-1]) + change @ self.receptance[:, block.runs]
            result[:, block.runs] = factor @ self.force_root[:, block.runs]
        return result


def expand(
    equations: ResponseEquations, displacement: np.ndarray, deviation: np.ndarray, dependent: float = 1e-6
) -> Expansion | None:
    """Forces and motion at the bearings by least squares, weighted by the noise; None where the sensors are too few.

    Args:
        displacement: (S, P, R) complex, m.
        deviation: (S, P, R) root mean square of its noise, m; infinite where a run was not measured, which then says
            nothing: no force, and a covariance beyond all others.
        dependent: sensors whose smallest singular value is below this share say nothing of some bearing force.
    """
    n_speeds, n_channels, n_runs = displacement.shape
    count = 2 * len(equations.bearing_nodes)
    if n_channels < count:
        return None
    force = np.empty((n_speeds, n_runs, count), dtype=complex)
    displacements, receptance = np.empty_like(force), np.empty((n_speeds, n_runs, count, count), dtype=complex)
    root = np.empty((n_speeds, n_runs, count, n_channels), dtype=complex)
    for block in equations.films:
        here = np.isfinite(deviation[:, :, block.runs]).all(axis=1)[..., None]  # (S, R, 1)
        weight = 1.0 / np.where(here, deviation[:, :, block.runs].swapaxes(1, 2), 1.0)  # (S, R, P)
        matrix = block.receptance_sensors[:, None] * weight[..., None]
        length = np.linalg.norm(matrix, axis=2, keepdims=True)
        left, singular, right = np.linalg.svd(matrix / length, full_matrices=False)
        if (singular[..., -1] < dependent).any():
            return None
        inverse = (left / singular[..., None, :] @ right / length).conj().swapaxes(2, 3)
        off = (displacement[:, :, block.runs] - block.forced_sensors).swapaxes(1, 2) * weight
        solved = (inverse @ off[..., None])[..., 0]  # (S, R, 2 B)
        motion = block.forced_bearings.swapaxes(1, 2) + solved @ block.receptance_bearings.swapaxes(1, 2)
        force[:, block.runs], displacements[:, block.runs] = np.where(here, solved, 0.0), np.where(here, motion, 0.0)
        root[:, block.runs] = np.where(here[..., None], inverse, UNMEASURED * np.eye(count, n_channels))
        receptance[:, block.runs] = block.receptance_bearings[:, None]
    force, displacements = force.swapaxes(1, 2), displacements.swapaxes(1, 2)
    return Expansion(
        bearing_equations_of(equations, force - equations.reference * displacements, displacements),
        receptance,
        root,
    )


def bearing_equations_of(
    equations: ResponseEquations, force: np.ndarray, displacements: np.ndarray
) -> BearingEquations:
    """The residual ``r = force + H q`` from forces and displacements at the bearings, (S, 2 B, R) each."""
    shape = (len(force), len(equations.bearing_nodes), 2, force.shape[2])
    return BearingEquations(
        equations.bearing_nodes,
        equations.speeds,
        equations.frequencies,
        force.reshape(shape).swapaxes(0, 1),
        displacements.reshape(shape).swapaxes(0, 1),
    )


# --- from fewer sensors: a stationary Kalman smoother -------------------------------------------------


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
        prior = (share * np.abs(_product(impedance, response.bearings))) ** 2
        deviation, apart = data.deviation[:, :, block.runs], measured[:, :, block.runs] - response.sensors
        gain = _gain(response.receptance_sensors[:, None], prior.swapaxes(1, 2), deviation.swapaxes(1, 2))
        unknown = gain @ apart.swapaxes(1, 2)[..., None]  # (S, R, 2 B, 1)
        motion = response.bearings + (response.receptance_bearings[:, None] @ unknown)[..., 0].swapaxes(1, 2)
        displacements[..., block.runs] = motion
        force[..., block.runs] = unknown[..., 0].swapaxes(1, 2) - _product(impedance, motion)
    equations_at = bearing_equations_of(equations, force, displacements)
    return per_speed_least_squares(linear_residual(equations_at, data.unknowns, data.known))


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
    n_speeds, direct = len(measurement.dataset.speeds), np.array([is_direct(name) for name in unknowns.names])
    start = np.repeat(measurement.guess.direct(unknowns)[:, None], n_speeds, axis=1)
    best, settled, least = start.copy(), np.zeros(n_speeds, dtype=bool), np.full(n_speeds, np.inf)
    for size in sizes:
        todo = np.flatnonzero(~(settled & (least <= explained)))
        if not len(todo):
            break
        waiting = measurement.select(todo)
        values, still = _settle(waiting, size * start[:, todo], direct)
        off = waiting.response.predict(waiting.table(values)) - waiting.dataset.displacement
        left_over = np.where(still, (np.abs(off / waiting.deviation) ** 2).mean(axis=(1, 2)), np.inf)
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
    """(.., 2 B, P) Kalman gain for forces of variance ``prior`` (.., 2 B), seen through ``at_sensors`` (.., P, 2 B).

    ``P a' (a P a' + R)^-1 = (P^-1 + a' R^-1 a)^-1 a' R^-1``: the smaller of the two matrices is solved.
    """
    adjoint = at_sensors.conj().swapaxes(-1, -2)
    n_channels, count = at_sensors.shape[-2:]
    if n_channels < count:
        spread = prior[..., None] * adjoint
        innovation = at_sensors @ spread
        innovation[..., range(n_channels), range(n_channels)] += deviation**2
        return _solve(innovation, spread.conj().swapaxes(-1, -2)).conj().swapaxes(-1, -2)
    weighted = adjoint / deviation[..., None, :] ** 2
    information = weighted @ at_sensors
    information[..., range(count), range(count)] += 1 / prior
    return _solve(information, weighted)


def _solve(matrix: np.ndarray, right: np.ndarray) -> np.ndarray:
    """``matrix x = right``; at the resonance of an estimate without damping, rounding leaves a single mode of it."""
    try:
        return np.asarray(np.linalg.solve(matrix, right))
    except np.linalg.LinAlgError:
        return np.asarray(np.linalg.pinv(matrix, hermitian=True) @ right)


def _product(impedance: np.ndarray, motion: np.ndarray) -> np.ndarray:
    """(S, 2 B, R) of blocks (B, S, 2, 2) and (S, 2 B, R)."""
    blocks = motion.reshape(len(motion), len(impedance), 2, -1)
    return np.asarray(np.einsum("bsij,sbjr->sbir", impedance, blocks).reshape(motion.shape))
