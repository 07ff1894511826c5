"""Vibration by integration of the equations of motion in time, from rest to the steady state at each speed.

    M q'' + (C + W G) q' + K q = Re(F e^{jWt})

by the method of Hilber, Hughes and Taylor (1977), which damps what the step does not resolve. No dynamic stiffness is
made or solved: data of this kind do not come from the equations of the fit. One step of it is linear, ``z' = A z + b``,
so a revolution is too, and so are many: their matrices are powers.

Legend: S speeds, R runs, n lateral DOF, N steps a revolution, z = (q, h q', h^2 q''). SI units.
"""

from __future__ import annotations

import numpy as np

from pipeline.data.dataset import DIRECTIONS, Excitation, VibrationDataset, assemble_forces
from pipeline.errors import PipelineError
from pipeline.rotor.bearing_table import BearingTable
from pipeline.rotor.model import TRANSLATIONS, RotorModel, bearing_dof, seal_dof, translation_dof
from pipeline.units import RAD_S_PER_RPM

STEPS = 720
"""A revolution; the error falls with their square."""
_ALPHA = -0.05
_DOUBLINGS = 12
"""The number of revolutions before the reading is two to this power."""
_SETTLED = 1e-6


def integrate(rotor: RotorModel, bearings: BearingTable, excitations: tuple[Excitation, ...]) -> VibrationDataset:
    """As :func:`pipeline.data.simulate.simulate`, of runs that turn with the rotor.

    Raises PipelineError where the vibration does not settle, as that of an unstable rotor.
    """
    runs = tuple(dict.fromkeys(excitation.run for excitation in excitations))
    forces = assemble_forces(rotor, excitations, runs, bearings.speeds)
    response = np.stack([_settle(rotor, bearings, s, forces[s]) for s in range(len(bearings.speeds))])
    channels = tuple((node, angle) for node in range(rotor.n_nodes) for angle in DIRECTIONS.values())
    measured = [translation_dof(node, direction) for node in range(rotor.n_nodes) for direction in range(TRANSLATIONS)]
    shown = response[:, measured]
    return VibrationDataset(bearings.speeds, runs, channels, shown, excitations, operating=bearings.operating)


def _settle(rotor: RotorModel, bearings: BearingTable, s: int, force: np.ndarray) -> np.ndarray:
    """(n, R) complex 1X vectors of the steady state at the speed ``s``, of a ``force`` (n, R)."""
    speed, n = float(bearings.speeds[s]), rotor.n_dof
    step, load = _one_step(rotor, bearings, s, 2 * np.pi / STEPS / speed)
    turns = np.exp(2j * np.pi * np.arange(STEPS + 1) / STEPS)
    shown = (1 + _ALPHA) * turns[1:] - _ALPHA * turns[:-1]  # the method's mean of two moments
    pushed = np.einsum("k,nr->knr", shown, load @ force).real
    state = np.zeros((3 * n, force.shape[1]))
    for push in pushed:
        state = step @ state + push
    # From rest, one revolution leads to this state; m of them to (1 + P + .. + P^(m-1)) of it.
    turn = np.linalg.matrix_power(step, STEPS)
    before = state
    with np.errstate(over="ignore", invalid="ignore"):  # of an unstable rotor
        for _ in range(_DOUBLINGS):
            before, state = state, state + turn @ state
            turn = turn @ turn
        change = np.abs(state - before).max()
    if not change <= _SETTLED * np.abs(state).max():
        raise PipelineError(
            f"the vibration must settle to be read, but at {speed / RAD_S_PER_RPM:g} rpm it still changes after "
            f"{2**_DOUBLINGS} revolutions: use machine.as_built.method=frequency, or stable bearings"
        )
    total = np.zeros((n, force.shape[1]), dtype=complex)
    for k, push in enumerate(pushed):
        total += state[:n] * turns[k].conj()
        state = step @ state + push
    return 2 / STEPS * total  # least squares over a whole revolution


def _one_step(rotor: RotorModel, bearings: BearingTable, s: int, h: float) -> tuple[np.ndarray, np.ndarray]:
    """The matrix A (3 n, 3 n) of a step of ``h`` seconds, and (3 n, n) what a force adds."""
    n, places = rotor.n_dof, bearing_dof(rotor)
    stiffness = rotor.stiffness.copy()
    damping = rotor.damping + bearings.speeds[s] * rotor.gyroscopic
    for b, rows in enumerate(places):
        four = bearings.values[b, s].reshape(2, 2, 2)
        stiffness[np.ix_(rows, rows)] += four[0]
        damping[np.ix_(rows, rows)] += four[1]
    mass = rotor.mass.copy()
    for block, rows in zip(rotor.seals.matrices(bearings.speeds[[s]])[:, 0], seal_dof(rotor), strict=True):
        for matrix, stacked in zip((stiffness, damping, mass), block, strict=True):
            matrix[np.ix_(rows, rows)] += stacked
    beta, gamma, more = (1 - _ALPHA) ** 2 / 4, (1 - 2 * _ALPHA) / 2, 1 + _ALPHA
    k, c = h**2 * stiffness, h * damping
    system = mass + more * (gamma * c + beta * k)
    now = np.hstack([k, c + more * k, more * ((1 - gamma) * c + (0.5 - beta) * k)])
    last = np.linalg.solve(system, np.hstack([-now, h**2 * np.eye(n)]))
    bent, load = last[:, : 3 * n], last[:, 3 * n :]
    identity, none = np.eye(n), np.zeros((n, n))
    first = np.hstack([identity, identity, (0.5 - beta) * identity]) + beta * bent
    second = np.hstack([none, identity, (1 - gamma) * identity]) + gamma * bent
    return np.vstack([first, second, bent]), np.vstack([beta * load, gamma * load, load])
