"""Vibration of a modelled machine: its response to the excitation of every run and speed, and sensors' noise."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pipeline.data.dataset import DIRECTIONS, Excitation, VibrationDataset, assemble_forces, group_runs
from pipeline.rotor.bearing_table import BearingTable
from pipeline.rotor.dynamic_stiffness import banded, solve
from pipeline.rotor.interpolation import bearing_places
from pipeline.rotor.model import TRANSLATIONS, RotorModel, translation_dof


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
    return show_everywhere(rotor, bearings, response, excitations, own_frequencies)


def show_everywhere(
    rotor: RotorModel,
    bearings: BearingTable,
    response: np.ndarray,
    excitations: tuple[Excitation, ...],
    own_frequencies: np.ndarray | None = None,
) -> VibrationDataset:
    """x and y at every node, of a ``response`` (S, n, R) in m and rad."""
    runs = tuple(dict.fromkeys(excitation.run for excitation in excitations))
    channels = tuple((node, angle) for node in range(rotor.n_nodes) for angle in DIRECTIONS.values())
    measured = [translation_dof(node, direction) for node in range(rotor.n_nodes) for direction in range(TRANSLATIONS)]
    shown = response[:, measured]
    return VibrationDataset(
        bearings.speeds, runs, channels, shown, excitations, own_frequencies, operating=bearings.operating
    )


def add_noise(dataset: VibrationDataset, deviation: np.ndarray, generator: np.random.Generator) -> VibrationDataset:
    """The data set with circular complex noise, ``E|n|^2 = deviation^2``; ``deviation`` (S, P, R) in m."""
    parts = generator.standard_normal((2, *dataset.displacement.shape)) / np.sqrt(2.0)
    return replace(dataset, displacement=dataset.displacement + deviation * (parts[0] + 1j * parts[1]))
