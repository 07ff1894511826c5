"""What a rotor's weight says of its bearings before anything is measured: their static loads, and the size of journals.

Legend: B bearings. SI units.
"""

from __future__ import annotations

import numpy as np

from pipeline.rotor.model import DOF_PER_NODE, RotorModel, bearing_dof

GRAVITY = 9.80665


def find_static_loads(rotor: RotorModel, least: float = 0.1, rigid: float = 1e3) -> np.ndarray:
    """(B,) N of a horizontal rotor on bearings in line, ``rigid`` times as stiff as the shaft.

    Where a bearing hardly carries anything (or lifts), its load hangs on an alignment that nobody states: it is at
    ``least`` this share of the weight.
    """
    vertical = np.arange(rotor.n_dof) % DOF_PER_NODE == 1
    weight = GRAVITY * rotor.mass[:, vertical].sum(axis=1)
    places = bearing_dof(rotor)[:, 1]
    stiffness = rigid * float(np.abs(np.diag(rotor.stiffness)[vertical]).max())
    supported = rotor.stiffness.copy()
    supported[places, places] += stiffness
    in_plane = np.isin(np.arange(rotor.n_dof) % DOF_PER_NODE, (1, 2))
    sag = np.linalg.solve(supported[np.ix_(in_plane, in_plane)], weight[in_plane])
    reaction = stiffness * sag[np.searchsorted(np.flatnonzero(in_plane), places)]
    return np.maximum(np.abs(reaction), least * weight[vertical].sum())


def estimate_journals(rotor: RotorModel, density: float = 7850.0) -> np.ndarray:
    """(B,) m, diameters of the shaft at its bearings, from its mass as that of solid steel."""
    lateral = np.arange(0, rotor.n_dof, DOF_PER_NODE)
    mass = rotor.shaft_mass[np.ix_(lateral, lateral)].sum(axis=1)  # kg, of each node
    length = np.gradient(rotor.positions) if rotor.n_nodes > 2 else np.full(rotor.n_nodes, np.ptp(rotor.positions) / 2)
    length[[0, -1]] /= 2
    nodes = list(rotor.bearing_nodes)
    return np.asarray(np.sqrt(4 * mass[nodes] / (np.pi * density * np.maximum(length[nodes], 1e-6))))
