"""The known part of the machine: finite element matrices of shaft and discs, without bearings.

Legend: N nodes, n = 4 N lateral DOF ordered node by node as (x, y, alpha, beta); axial and torsional
DOF are uncoupled from these and left out. T seals, S speeds, R rows of seals. SI units.
"""

from __future__ import annotations

import hashlib
from collections.abc import Collection, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

DOF_PER_NODE = 4
TRANSLATIONS = 2
"""x and y come first among the DOF of a node."""
COLUMNS = tuple(f"{kind}{axes}" for kind in "kcm" for axes in ("xx", "xy", "yx", "yy"))


@dataclass(frozen=True, eq=False)
class Seals:
    """The coefficients of all seals, as the file of the rotor has them; between its speeds by ROSS's own spline."""

    rows: np.ndarray  # (R, 15): seal, its node, rotor speed in rad/s (NaN: at every speed), and COLUMNS in SI units

    @cached_property
    def nodes(self) -> tuple[int, ...]:
        """T."""
        return tuple(int(rows[0, 1]) for rows in self._by_seal)

    @cached_property
    def _by_seal(self) -> list[np.ndarray]:
        return [self.rows[self.rows[:, 0] == seal] for seal in np.unique(self.rows[:, 0])]

    def matrices(self, speeds: np.ndarray) -> np.ndarray:
        """(T, S, 3, 2, 2) stiffness, damping and mass at the rotor ``speeds`` (S,) rad/s."""
        interpolated = [_interpolate(rows[:, 2], rows[:, 3:], speeds) for rows in self._by_seal]
        return np.array(interpolated).reshape(len(interpolated), len(speeds), 3, 2, 2)

    def impedance(self, frequencies: np.ndarray, speeds: np.ndarray) -> np.ndarray:
        """(T, S, 2, 2) complex ``K + j w C - w^2 M`` in N/m at ``frequencies`` w (S,) and rotor ``speeds`` (S,)."""
        stiffness, damping, mass = np.moveaxis(self.matrices(speeds), 2, 0)
        w = frequencies[:, None, None]
        return stiffness + 1j * w * damping - w**2 * mass


NO_SEALS = Seals(np.zeros((0, 3 + len(COLUMNS))))


def _interpolate(at: np.ndarray, values: np.ndarray, speeds: np.ndarray, spline_points: int = 4) -> np.ndarray:
    """(S, 12): constant, a polynomial through two or three points, or a spline, as ROSS 2.3.0 has it."""
    if len(at) == 1:
        return np.tile(values[0], (len(speeds), 1))
    from scipy.interpolate import UnivariateSpline, interp1d

    if len(at) < spline_points:
        curve = interp1d(at, values, kind=len(at) - 1, axis=0, fill_value="extrapolate")
        return np.asarray(curve(speeds))
    return np.stack([UnivariateSpline(at, column)(speeds) for column in values.T], axis=1)


@dataclass(frozen=True, eq=False, kw_only=True)
class RotorModel:
    """Matrices of shaft and discs and the places of bearings and discs on it."""

    mass: np.ndarray  # (n, n) kg, kg m, kg m^2
    damping: np.ndarray  # (n, n) N s/m ..., of the shaft itself
    gyroscopic: np.ndarray  # (n, n), multiplied by the rotor speed in rad/s
    stiffness: np.ndarray  # (n, n) N/m, N, N m
    shaft_mass: np.ndarray  # (n, n) the share of the shaft alone, without discs
    shaft_gyroscopic: np.ndarray  # (n, n) likewise
    positions: np.ndarray  # (N,) m, along the shaft
    bearing_nodes: tuple[int, ...]
    disc_nodes: tuple[int, ...]
    total_mass: float  # kg
    seals: Seals = NO_SEALS
    supported_nodes: tuple[int, ...] = ()  # bearing nodes whose supports are part of the bearing
    bearing_shifts: tuple[float, ...] = ()  # B m, of each bearing beyond its node along the shaft; none for all zero
    casings: tuple[int, ...] = ()  # bearing nodes that stand on soft ground: their casings are the nodes N, N + 1, ..
    participation: np.ndarray = field(default_factory=lambda: np.empty((0, TRANSLATIONS, 0)))  # see :attr:`shapes`

    @property
    def n_nodes(self) -> int:
        """N, of the shaft."""
        return len(self.positions)

    @property
    def n_places(self) -> int:
        """Nodes of the shaft and C of the ground, whose x and y are those of a casing, or coordinates of a base."""
        return self.n_dof // DOF_PER_NODE

    @property
    def n_ground(self) -> int:
        """C."""
        return self.n_places - self.n_nodes

    @property
    def reach(self) -> np.ndarray:
        """(Q, k) the DOF of the ground that each casing moves with: its own, or all modes of the base."""
        dof = casing_dof(self)
        return np.tile(dof.ravel(), (len(self.casings), 1)) if self.participation.size else dof

    @property
    def shapes(self) -> np.ndarray:
        """(Q, 2, k) how: as it is, or by the participation (Q, 2, 2 C) in the modes of a base, 1/sqrt(kg)."""
        alone = np.broadcast_to(np.eye(TRANSLATIONS), (len(self.casings), TRANSLATIONS, TRANSLATIONS))
        return self.participation if self.participation.size else alone

    @property
    def n_views(self) -> int:
        """Nodes that probes may have: shaft and casings, and for each casing the shaft's motion less it."""
        return self.n_nodes + 2 * len(self.casings)

    def unseen_casings(self, channels: Collection[tuple[int, float]]) -> dict[int, int]:
        """Bearing node -> the node of its casing, of those along which no channel (node, angle) looks."""
        places, seen = enumerate(self.casings, self.n_nodes), {node for node, _ in channels}
        return {node: casing for casing, node in places if casing not in seen}

    def show(self, node: int) -> np.ndarray:
        """(2, n) x and y that a probe with this ``node`` shows of the DOF."""
        rows, i = np.zeros((TRANSLATIONS, self.n_dof)), node - self.n_nodes
        relative = i >= len(self.casings)
        if i >= 0:
            i -= relative * len(self.casings)
            rows[:, self.reach[i]] = -self.shapes[i] if relative else self.shapes[i]
            node = self.casings[i]
        if i < 0 or relative:
            rows[:, translation_dof(node, 0) + np.arange(TRANSLATIONS)] = np.eye(TRANSLATIONS)
        return rows

    @property
    def view_positions(self) -> np.ndarray:
        """m, along the shaft, of each node that a probe may have."""
        return self.positions[[*range(self.n_nodes), *self.casings, *self.casings]]

    @property
    def n_dof(self) -> int:
        """4 N, and 4 for each casing."""
        return self.mass.shape[0]

    @cached_property
    def fingerprint(self) -> str:
        """Identity of the mechanical model: equal for equal matrices, to nine digits."""
        digest = hashlib.sha256()
        for matrix in (self.mass, self.damping, self.gyroscopic, self.stiffness):
            scale = np.abs(matrix).max() or 1.0
            # + 0.0 turns a rounded -0.0 into 0.0, which has other bytes.
            digest.update((np.round(matrix / scale, 9) + 0.0).tobytes())
            digest.update(f"{scale:.9e}".encode())
        if len(self.seals.rows):
            digest.update(self.seals.rows.tobytes())
        if self.casings:
            digest.update(np.array(self.casings).tobytes() + self.participation.tobytes())
        if any(self.bearing_shifts):
            digest.update(np.array(self.bearing_shifts).tobytes())
        return digest.hexdigest()[:16]


def translation_dof(node: int, direction: int) -> int:
    """Index of x (direction 0) or y (direction 1) of a node among the lateral DOF."""
    return DOF_PER_NODE * node + direction


def bearing_dof(rotor: RotorModel) -> np.ndarray:
    """(B, 2) indices of x and y at each bearing."""
    return list_translations(rotor.bearing_nodes)


def casing_dof(rotor: RotorModel) -> np.ndarray:
    """(C, 2) indices of x and y of each node of the ground."""
    return list_translations(range(rotor.n_nodes, rotor.n_places))


def list_translations(nodes: Sequence[int]) -> np.ndarray:
    """(n, 2) indices of x and y at each of the ``nodes`` (n)."""
    return DOF_PER_NODE * np.array(nodes, dtype=int)[:, None] + np.arange(TRANSLATIONS)
