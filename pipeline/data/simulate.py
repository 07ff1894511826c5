"""Vibration of a modelled machine: the unbalance response of every run and speed."""

from __future__ import annotations

import numpy as np

from pipeline.data.dataset import Excitation, VibrationDataset, force_vectors
from pipeline.rotor.bearing_table import BearingTable
from pipeline.rotor.dynamic_stiffness import banded, solve
from pipeline.rotor.model import TRANSLATIONS, RotorModel, bearing_dof, translation_dof


def unbalance_response(
    rotor: RotorModel, bearings: BearingTable, excitations: tuple[Excitation, ...], runs: tuple[str, ...]
) -> np.ndarray:
    """(S, n, R) complex displacements (m) and rotations (rad) at the speeds of ``bearings``.

    Solves ``(D_rotor(w) + H(w)) Q = F`` (paper, eqs. 1 and 4) with synchronous excitation.
    Raises PipelineError where the system is singular.
    """
    speeds = bearings.speeds
    forces = force_vectors(rotor, excitations, runs, speeds)
    return solve(banded(rotor), speeds, speeds, forces, bearings.impedance(), bearing_dof(rotor))


def simulate(rotor: RotorModel, bearings: BearingTable, excitations: tuple[Excitation, ...]) -> VibrationDataset:
    """The data set of a machine whose x and y are measured at every node, without noise."""
    runs = tuple(dict.fromkeys(excitation.run for excitation in excitations))
    response = unbalance_response(rotor, bearings, excitations, runs)
    channels = tuple((node, direction) for node in range(rotor.n_nodes) for direction in range(TRANSLATIONS))
    measured = [translation_dof(node, direction) for node, direction in channels]
    return VibrationDataset(bearings.speeds, runs, channels, response[:, measured], excitations)
