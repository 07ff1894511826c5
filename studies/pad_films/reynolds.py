"""Reynolds' equation for a journal on fixed or tilting pads: the dimensionless coefficients that tables hold.

Isothermal, laminar, rigid; the pressure is zero at the edges of each pad, and nowhere below (Reynolds' condition of a
film that breaks). With ``P = p Cb^2 / (6 eta w R^2)``, ``H = h / Cb``, z from -1 to 1 over the length and t in 1 / w

    (H^3 P_theta)_theta + (D / L)^2 (H^3 P_z)_z = H_theta + 2 H_t

by finite differences over one half of the length. Angles count from the load in the sense of rotation. Coordinates q
are the journal's x (along the load) and y over Cb and, of tilting pads, the tilt of each; g = -dH/dq makes the forces
``f = integral P g`` that belong to them, and their derivatives by perturbation (Lund and Thomsen 1978). The load is
``f_x = 1 / (3 pi S)`` with the clearance Cb of the bore in S. Pads without inertia follow the journal at the speed's
frequency: their tilts are eliminated there (coefficients reduced to the synchronous frequency).

Legend: q coordinates (2, or 2 and the pads), n + 1 nodes along a pad, m nodes along the half length.
"""

from __future__ import annotations

import contextlib
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

_BESIDE, _TILT = 0.02, 0.4
_FLAT = 0.02
"""A pad that pivots in its middle carries nothing where its film bulges less (over Cb)."""
_HALVINGS, _CHANGES, _STEPS = 6, 100, 60
_CLOSE, _LEAST_SHARE, _MOST_CONDITION = 1e-10, 1e-4, 1e12
"""Of Newton's method: what is left of the load, the least share of a step, and the largest condition of its matrix."""


@dataclass(frozen=True)
class PadBearing:
    """Equal pads; the preload is ``1 - Cb / Cp`` of the bore's clearance and the pads' own."""

    centres: tuple[float, ...]  # rad from the load, in the sense of rotation; the pivots, where the pads tilt
    arc: float  # rad
    preload: float
    length_ratio: float  # L / D
    tilting: bool = False
    elements: tuple[int, int] = (96, 12)  # along a pad, along half the length

    @property
    def n_coordinates(self) -> int:
        """x and y of the journal, and a tilt for each pad that can."""
        return 2 + (len(self.centres) if self.tilting else 0)

    def gap(self, angles: np.ndarray, pad: int) -> np.ndarray:
        """H of a pad at ``angles`` from the load, with the journal in the middle and the pad untilted."""
        return np.asarray((1 - self.preload * np.cos(angles - self.centres[pad])) / (1 - self.preload))

    def bulge(self, place: np.ndarray, pad: int) -> float:
        """How far the film of a pad is thinnest in its middle; a pad that pivots there carries nothing below 0."""
        centre = self.centres[pad]
        shift = float(place[0] * np.cos(centre) + place[1] * np.sin(centre))
        return self.preload / (1 - self.preload) + shift

    def motions(self, angles: np.ndarray, pad: int) -> np.ndarray:
        """(q, ..) g = -dH/dq at ``angles`` of a pad."""
        directions = np.zeros((self.n_coordinates, *angles.shape))
        directions[0], directions[1] = np.cos(angles), np.sin(angles)
        if self.tilting:
            directions[2 + pad] = np.sin(angles - self.centres[pad])
        return directions


@dataclass(frozen=True, eq=False)
class _Pad:
    """The grid of a pad; half nodes lie between the nodes along it."""

    bearing: PadBearing
    index: int

    @cached_property
    def nodes(self) -> np.ndarray:
        half = self.bearing.arc / 2
        return self.bearing.centres[self.index] + np.linspace(-half, half, self.bearing.elements[0] + 1)

    @cached_property
    def step(self) -> float:
        return float(self.nodes[1] - self.nodes[0])

    @cached_property
    def across(self) -> Any:
        """(m, m) minus the second difference along the length: symmetric about the middle, zero at the end."""
        from scipy.sparse import diags_array

        m = self.bearing.elements[1]
        above = -np.ones(m - 1)
        above[0] = -2.0
        return diags_array([-np.ones(m - 1), 2 * np.ones(m), above], offsets=[-1, 0, 1]) * m**2

    def operator(self, at_half: np.ndarray, at_nodes: np.ndarray) -> Any:
        """Minus the divergence of ``c grad P`` at inner nodes, for c at half nodes (n,) and inner nodes (n - 1,)."""
        from scipy.sparse import diags_array, eye_array, kron

        c = at_half / self.step**2
        axial = diags_array([-c[1:-1], c[:-1] + c[1:], -c[1:-1]], offsets=[-1, 0, 1])
        m = self.bearing.elements[1]
        ratio = self.bearing.length_ratio**-2
        return (kron(axial, eye_array(m)) + kron(diags_array(ratio * at_nodes), self.across)).tocsc()

    def weights(self) -> np.ndarray:
        """(m,) of the integral over the angle and the whole length."""
        m = self.bearing.elements[1]
        found = np.full(m, 2 * self.step / m)
        found[0] /= 2
        return found


def _solve_cavitated(matrix: Any, right: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """P with ``P >= 0``, ``matrix P >= right`` and one of both equal; the nodes where P is above zero.

    A primal-dual active set method (Hintermueller, Ito and Kunisch 2003), which ends on such matrices.
    """
    from scipy.sparse.linalg import spsolve

    full = right > 0
    pressure = np.zeros_like(right)
    for _ in range(_CHANGES):
        pressure = np.zeros_like(right)
        if full.any():
            pressure[full] = spsolve(matrix[full][:, full], right[full])
        next_full = np.where(full, pressure > 0, matrix @ pressure < right)
        if (next_full == full).all():
            return pressure, full
        full = next_full
    raise ArithmeticError("the edge of the film was not found")


def film_forces(bearing: PadBearing, place: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Forces (q,), and their derivatives (q, q) by ``place`` (q,) and by its speed. Raises ArithmeticError."""
    q = bearing.n_coordinates
    force, stiffness, damping = np.zeros(q), np.zeros((q, q)), np.zeros((q, q))
    for index in range(len(bearing.centres)):
        if bearing.tilting and bearing.bulge(place, index) <= _FLAT:
            stiffness[2 + index, 2 + index] = 1.0  # it carries nothing at any tilt: it keeps the one that it has
            continue
        pad_forces = _pad_forces(_Pad(bearing, index), place)
        force, stiffness, damping = force + pad_forces[0], stiffness + pad_forces[1], damping + pad_forces[2]
    return force, stiffness, damping


def _pad_forces(pad: _Pad, place: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """What one pad adds to :func:`film_forces`."""
    from scipy.sparse.linalg import splu

    bearing, index, inner = pad.bearing, pad.index, pad.nodes[1:-1]
    half, q = (pad.nodes[1:] + pad.nodes[:-1]) / 2, len(place)
    g_half, g = bearing.motions(half, index), bearing.motions(inner, index)
    h_half, h = bearing.gap(half, index) - place @ g_half, bearing.gap(inner, index) - place @ g
    if min(h.min(), h_half.min()) <= 0:
        raise ArithmeticError("the journal touches a pad")
    weights = pad.weights()
    across = np.ones_like(weights)
    matrix = pad.operator(h_half**3, h**3)
    pressure, full = _solve_cavitated(matrix, np.kron(-np.diff(h_half) / pad.step, across))
    if not full.any():
        if bearing.tilting:
            raise ArithmeticError("a pad carries nothing: it may have any tilt")
        return np.zeros(q), np.zeros((q, q)), np.zeros((q, q))
    shown = np.kron(g, weights)  # what a pressure counts in each force
    slopes = [pad.operator(3 * h_half**2 * gap_half, 3 * h**2 * gap) for gap_half, gap in zip(g_half, g, strict=True)]
    by_place = [
        np.kron(np.diff(gap_half) / pad.step, across) + change @ pressure
        for gap_half, change in zip(g_half, slopes, strict=True)
    ]
    by_speed = [2 * np.kron(gap, across) for gap in g]
    # Where the film breaks, the pressure's derivative is zero: the edge moves, but counts in the second order alone.
    solution = splu(matrix[full][:, full]).solve(np.stack([*by_place, *by_speed], axis=1)[full])
    both = shown[:, full] @ solution
    return shown @ pressure, both[:, :q], both[:, q:]


def find_place(bearing: PadBearing, sommerfeld: float, start: np.ndarray) -> np.ndarray:
    """The static place (q,) of the journal, and tilts, by Newton's method from ``start``. Raises ArithmeticError."""
    place, wanted = start.copy(), np.zeros(bearing.n_coordinates)
    wanted[0] = 1 / (3 * np.pi * sommerfeld)
    force, stiffness, _ = film_forces(bearing, place)
    for _ in range(_STEPS):
        miss = wanted - force
        if np.abs(miss).max() < _CLOSE * wanted[0]:
            return place
        if np.linalg.cond(stiffness) > _MOST_CONDITION:
            break
        move, share = np.linalg.solve(stiffness, miss), 1.0
        while share > _LEAST_SHARE:
            with contextlib.suppress(ArithmeticError):
                force, stiffness, _ = film_forces(bearing, place + share * move)
                if np.abs(wanted - force).max() < np.abs(miss).max():
                    break
            share /= 2
        place = place + share * move
    raise ArithmeticError(f"no static place was found at S = {sommerfeld:g}")


def _follow(bearing: PadBearing, before: float, to: float, start: np.ndarray, depth: int = 0) -> np.ndarray:
    """The static place at ``to``, from that ``before``: by way of places between, where it is too far."""
    try:
        return find_place(bearing, to, start)
    except ArithmeticError:
        if depth == _HALVINGS or before == to:
            raise
    between = float(np.sqrt(before * to))
    return _follow(bearing, between, to, _follow(bearing, before, between, start, depth + 1), depth + 1)


def tabulate_bearing(bearing: PadBearing, sommerfeld: np.ndarray) -> np.ndarray:
    """(n, 8) Kbar and Bbar at Sommerfeld numbers (n,), in any order. Raises ArithmeticError.

    ``k = Kbar W / Cb``, ``c = Bbar W / (w Cb)``; x along the load.
    """
    order = np.argsort(sommerfeld)[::-1]  # from light loads, where the journal is in the middle
    place, rows = np.zeros(bearing.n_coordinates), np.zeros((len(sommerfeld), 8))
    place[1], place[2:] = _BESIDE, _TILT  # without them there may be no pressure
    before = float(sommerfeld[order[0]])
    for i in order:
        place, before = _follow(bearing, before, float(sommerfeld[i]), place), float(sommerfeld[i])
        _, stiffness, damping = film_forces(bearing, place)
        impedance = (stiffness + 1j * damping) * 3 * np.pi * sommerfeld[i]
        if bearing.tilting:
            inside = np.linalg.solve(impedance[2:, 2:], impedance[2:, :2])
            impedance = impedance[:2, :2] - impedance[:2, 2:] @ inside
        rows[i] = np.concatenate([impedance[:2, :2].real.ravel(), impedance[:2, :2].imag.ravel()])
    return rows
