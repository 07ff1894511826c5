"""Vibration of a modelled machine: its response to the excitation of every run and speed, and sensors' noise.

By :func:`integrate` it follows the equations of motion in time, from rest to the steady state at each speed,

    M q'' + (C + W G) q' + K q = Re(F e^{jWt})

by the method of Hilber, Hughes and Taylor (1977), which damps what the step does not resolve. No dynamic stiffness is
made or solved: data of this kind do not come from the equations of the fit. One step of it is linear, ``z' = A z + b``,
so a revolution is too, and so are many: their matrices are powers.

Legend: S speeds, R runs, n lateral DOF, N steps a revolution, z = (q, h q', h^2 q''). SI units.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pipeline.data.dataset import DIRECTIONS, Excitation, VibrationDataset, assemble_forces, group_runs
from pipeline.errors import PipelineError
from pipeline.rotor.bearing_table import BearingTable
from pipeline.rotor.dynamic_stiffness import assemble_systems, banded, solve
from pipeline.rotor.interpolation import bearing_places
from pipeline.rotor.model import DOF_PER_NODE, TRANSLATIONS, RotorModel
from pipeline.units import RAD_S_PER_RPM


def solve_response(
    rotor: RotorModel,
    bearings: BearingTable,
    excitations: tuple[Excitation, ...],
    runs: tuple[str, ...],
    frequencies: np.ndarray | None = None,
) -> np.ndarray:
    """(S, n, R) complex displacements (m) and rotations (rad) at the speeds of ``bearings``.

    Solves ``(D_rotor(w) + H(w)) Q = F`` (paper, eqs. 1 and 4); ``frequencies`` (S, R) rad/s, None for synchronous.
    Raises PipelineError where the system is singular.
    """
    speeds, system, places = bearings.speeds, banded(rotor), bearing_places(rotor)
    if frequencies is None:
        frequencies = np.repeat(speeds[:, None], len(runs), axis=1)
    forces = assemble_forces(rotor, excitations, runs, frequencies)
    response = np.empty(forces.shape, dtype=complex)
    for alike, w in group_runs(frequencies):
        impedance = places.spread(bearings.impedance(w))
        response[..., alike] = solve(system, w, speeds, forces[..., alike], impedance, places.dof)
    return response


def simulate(
    rotor: RotorModel,
    bearings: BearingTable,
    excitations: tuple[Excitation, ...],
    own_frequencies: np.ndarray | None = None,
) -> VibrationDataset:
    """The data set of a machine whose x and y are measured at every node, without noise.

    ``own_frequencies`` (S, R) rad/s, runs in the order in which ``excitations`` first names them; None for synchronous.
    """
    runs = tuple(dict.fromkeys(excitation.run for excitation in excitations))
    response = solve_response(rotor, bearings, excitations, runs, own_frequencies)
    return show_everywhere(rotor, bearings, runs, response, excitations, own_frequencies)


def show_everywhere(
    rotor: RotorModel,
    bearings: BearingTable,
    runs: tuple[str, ...],
    response: np.ndarray,
    excitations: tuple[Excitation, ...],
    own_frequencies: np.ndarray | None = None,
) -> VibrationDataset:
    """x and y at every node that a probe may have, of a ``response`` (S, n, R) in m and rad."""
    channels = tuple((node, angle) for node in range(rotor.n_views) for angle in DIRECTIONS.values())
    shaft = np.arange(DOF_PER_NODE * rotor.n_nodes).reshape(-1, DOF_PER_NODE)[:, :TRANSLATIONS].ravel()
    seen = [rotor.show(node) @ response for node in range(rotor.n_nodes, rotor.n_views)]
    shown = np.concatenate([response[:, shaft], *seen], axis=1)
    return VibrationDataset(
        bearings.speeds, runs, channels, shown, excitations, own_frequencies, operating=bearings.operating
    )


def add_noise(dataset: VibrationDataset, deviation: np.ndarray, generator: np.random.Generator) -> VibrationDataset:
    """The data set with circular complex noise, ``E|n|^2 = deviation^2``; ``deviation`` (S, P, R) in m."""
    parts = generator.standard_normal((2, *dataset.displacement.shape)) / np.sqrt(2.0)
    return replace(dataset, displacement=dataset.displacement + deviation * (parts[0] + 1j * parts[1]))


# --- by integration in time -----------------------------------------------------------------------


def integrate(
    rotor: RotorModel, bearings: BearingTable, excitations: tuple[Excitation, ...], steps: int = 720
) -> VibrationDataset:
    """As :func:`pipeline.data.simulate.simulate`, of runs that turn with the rotor.

    The error falls with the square of the ``steps`` a revolution.
    Raises PipelineError where the vibration does not settle, as that of an unstable rotor.
    """
    runs = tuple(dict.fromkeys(excitation.run for excitation in excitations))
    forces = assemble_forces(rotor, excitations, runs, bearings.speeds)
    settled = [_settle(rotor, bearings, s, force, steps) for s, force in enumerate(forces)]
    return show_everywhere(rotor, bearings, runs, np.stack(settled), excitations)


def _settle(
    rotor: RotorModel,
    bearings: BearingTable,
    s: int,
    force: np.ndarray,
    steps: int,
    alpha: float = -0.05,
    doublings: int = 12,
    settled: float = 1e-6,
) -> np.ndarray:
    """(n, R) complex 1X vectors of the steady state at the speed ``s``, of a ``force`` (n, R).

    ``alpha`` is the method's damping. Before the reading
    are two to the power ``doublings`` revolutions; a steady state changes by a share of ``settled`` at most.
    """
    speed, n = float(bearings.speeds[s]), rotor.n_dof
    step, load = _one_step(rotor, bearings, s, 2 * np.pi / steps / speed, alpha)
    turns = np.exp(2j * np.pi * np.arange(steps + 1) / steps)
    shown = (1 + alpha) * turns[1:] - alpha * turns[:-1]  # the method's mean of two moments
    pushed = np.einsum("k,nr->knr", shown, load @ force).real
    state = np.zeros((3 * n, force.shape[1]))
    for push in pushed:
        state = step @ state + push
    # From rest, one revolution leads to this state; m of them to (1 + P + .. + P^(m-1)) of it.
    turn = np.linalg.matrix_power(step, steps)
    with np.errstate(over="ignore", invalid="ignore"):  # of an unstable rotor
        for _ in range(doublings):
            before, state = state, state + turn @ state
            turn = turn @ turn
        change = np.abs(state - before).max()
    if not change <= settled * np.abs(state).max():
        raise PipelineError(
            f"the vibration must settle to be read, but at {speed / RAD_S_PER_RPM:g} rpm it still changes after "
            f"{2**doublings} revolutions: use machine.as_built.method=frequency, or stable bearings"
        )
    total = np.zeros((n, force.shape[1]), dtype=complex)
    for k, push in enumerate(pushed):
        total += state[:n] * turns[k].conj()
        state = step @ state + push
    return 2 / steps * total  # least squares over a whole revolution


def _one_step(
    rotor: RotorModel, bearings: BearingTable, s: int, h: float, alpha: float
) -> tuple[np.ndarray, np.ndarray]:
    """The matrix A (3 n, 3 n) of a step of ``h`` seconds, and (3 n, n) what a force adds."""
    n = rotor.n_dof
    mass, (damping,), (stiffness,) = assemble_systems(rotor, bearings.at(np.array([s])))
    mass = mass.reshape(n, n)
    beta, gamma, more = (1 - alpha) ** 2 / 4, (1 - 2 * alpha) / 2, 1 + alpha
    k, c = h**2 * stiffness, h * damping
    system = mass + more * (gamma * c + beta * k)
    now = np.hstack([k, c + more * k, more * ((1 - gamma) * c + (0.5 - beta) * k)])
    last = np.linalg.solve(system, np.hstack([-now, h**2 * np.eye(n)]))
    bent, load = last[:, : 3 * n], last[:, 3 * n :]
    identity, none = np.eye(n), np.zeros((n, n))
    first = np.hstack([identity, identity, (0.5 - beta) * identity]) + beta * bent
    second = np.hstack([none, identity, (1 - gamma) * identity]) + gamma * bent
    return np.vstack([first, second, bent]), np.vstack([beta * load, gamma * load, load])
