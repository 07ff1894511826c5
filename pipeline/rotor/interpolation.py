"""The shaft between its nodes: what stands beside a node shows, or loads, the beam there.

The shape functions are those of the Timoshenko element (Friedman and Kosmatka 1993, Comput. Struct. 47), whose static
deflection they are. An element of bending stiffness EI, length L and shear number ``s`` couples its ends by
``12 EI / (L^3 (1 + s))`` (displacements) and ``(2 - s) EI / (L (1 + s))`` (rotations), so that its matrix tells ``s``.

Legend: N nodes, n lateral DOF, B bearings, S speeds, R right-hand sides. SI units.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from pipeline.rotor.model import DOF_PER_NODE, TRANSLATIONS, RotorModel, bearing_dof, translation_dof


def shaft_rows(rotor: RotorModel, node: int, shift: float, slope: bool = False) -> np.ndarray:
    """(2, n) x and y of the shaft at ``shift`` m beyond the ``node``, or their ``slope`` along it, 1/m.

    Beyond its ends the shaft goes on straight. At a node itself the slope is that of the element that follows.
    """
    rows, i = np.zeros((TRANSLATIONS, rotor.n_dof)), node - rotor.n_nodes
    if i >= 0:  # a casing has no length
        still = 0.0 if slope else rotor.show(node)
        relative = i - len(rotor.casings)
        if relative < 0:
            return rows + still
        seen = rotor.casings[relative]
        return np.asarray(still + shaft_rows(rotor, seen, shift, slope) - (0.0 if slope else rotor.show(seen)))
    dof, shape, turn = _element(rotor, node, shift)
    four = turn if slope else shape
    rows[0, dof[[0, 3, 4, 7]]] = four  # x' = beta
    rows[1, dof[[1, 2, 5, 6]]] = four * [1.0, -1.0, 1.0, -1.0]  # y' = -alpha
    return rows


def _element(rotor: RotorModel, node: int, shift: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The DOF (8,) of the element at a place; what its ends' (w, w') show there, (4,), and the slope of that."""
    ends, place = rotor.positions, rotor.positions[node] + shift
    i = int(np.clip(np.searchsorted(ends, place, side="right") - 1, 0, rotor.n_nodes - 2))
    i = min(node, rotor.n_nodes - 2) if shift == 0.0 else i  # nodes may share a place
    dof = translation_dof(i, 0) + np.arange(2 * DOF_PER_NODE)
    length = float(ends[i + 1] - ends[i])
    if length == 0.0:  # a coupling: it shows its node as it is
        return dof, np.array([1.0, 0.0, 0.0, 0.0]), np.array([0.0, 1.0, 0.0, 0.0])
    inside = float(np.clip(place - ends[i], 0.0, length))
    # The shear number 12 EI / (G A_s L^2); 0 where it is no beam.
    pulled, turned = -rotor.stiffness[dof[0], dof[4]], rotor.stiffness[dof[3], dof[7]]
    s = max(2.0 - 12.0 * float(turned / (pulled * length**2)), 0.0) if pulled > 0 else 0.0
    t = inside / length
    displacement = [
        1 - 3 * t**2 + 2 * t**3 + s * (1 - t),
        length * (t - 2 * t**2 + t**3 + s / 2 * (t - t**2)),
        3 * t**2 - 2 * t**3 + s * t,
        length * (t**3 - t**2 - s / 2 * (t - t**2)),
    ]
    slope = [
        (-6 * t + 6 * t**2 - s) / length,
        1 - 4 * t + 3 * t**2 + s / 2 * (1 - 2 * t),
        (6 * t - 6 * t**2 + s) / length,
        3 * t**2 - 2 * t - s / 2 * (1 - 2 * t),
    ]
    shape, turn = np.array(displacement) / (1 + s), np.array(slope) / (1 + s)
    return dof, shape + (place - ends[i] - inside) * turn, turn


@dataclass(frozen=True, eq=False)
class BearingPlaces:
    """Which DOF the bearings act on, and by what shares: those of its node, or of an element where it is beside it.

    On soft ground a bearing feels the shaft's motion less its casing's, and pushes both.
    """

    dof: np.ndarray  # (B, k) indices; x and y of the node where k is 2
    shares: np.ndarray  # (B, 2, k)

    def show(self, motion: np.ndarray) -> np.ndarray:
        """(S, 2 B, R) m at the bearings, of the ``motion`` (S, n, R)."""
        return np.asarray((self.shares @ motion[:, self.dof]).reshape(len(motion), -1, motion.shape[-1]))

    def loads(self, n_dof: int) -> np.ndarray:
        """(n, 2 B) what 1 N in x and in y of each bearing is on the DOF."""
        result = np.zeros((n_dof, self.shares[..., 0].size))
        for b, dof in enumerate(self.dof):
            result[dof, TRANSLATIONS * b : TRANSLATIONS * (b + 1)] = self.shares[b].T
        return result

    def spread(self, blocks: np.ndarray) -> np.ndarray:
        """(B, .., k, k) on the DOF, of what acts in x and y of each bearing, ``blocks`` (B, .., 2, 2)."""
        shares = self.shares.reshape(len(self.shares), *[1] * (blocks.ndim - 3), *self.shares.shape[1:])
        return np.asarray(shares.swapaxes(-1, -2) @ blocks @ shares)


def bearing_places(rotor: RotorModel) -> BearingPlaces:
    """Where the rotor's bearings act."""
    nodes, dof = rotor.bearing_nodes, bearing_dof(rotor)
    if rotor.casings:
        reach, shapes, eye = rotor.reach, rotor.shapes, np.eye(TRANSLATIONS)
        on = [rotor.casings.index(node) if node in rotor.casings else -1 for node in nodes]
        elsewhere = dof + TRANSLATIONS if reach.shape[1] == TRANSLATIONS else reach[:1].repeat(len(nodes), axis=0)
        beside = [reach[i] if i >= 0 else elsewhere[b] for b, i in enumerate(on)]
        shares = [np.hstack([eye, (-1.0 if i >= 0 else 0.0) * shapes[i]]) for i in on]
        return BearingPlaces(np.hstack([dof, np.array(beside)]), np.stack(shares))
    if not any(rotor.bearing_shifts):
        return BearingPlaces(dof, np.broadcast_to(np.eye(TRANSLATIONS), (len(nodes), TRANSLATIONS, TRANSLATIONS)))
    places = list(zip(nodes, rotor.bearing_shifts, strict=True))
    elements = np.stack([_element(rotor, *place)[0] for place in places])
    rows = [shaft_rows(rotor, *place)[:, element] for place, element in zip(places, elements, strict=True)]
    return BearingPlaces(elements, np.stack(rows))


def move_bearing(rotor: RotorModel, bearing: int, shift: float) -> RotorModel:
    """The same with the place of a bearing ``shift`` m further along the shaft."""
    shifts = np.array(rotor.bearing_shifts or [0.0] * len(rotor.bearing_nodes))
    shifts[bearing] += shift
    return replace(rotor, bearing_shifts=tuple(shifts.tolist()))


def move_casing(rotor: RotorModel, place: int, shift: float) -> RotorModel:
    """The same with one participation of the base, by its ``place`` among them all, that is by ``shift`` larger."""
    participation = rotor.participation.copy()
    participation.flat[place] += shift
    return replace(rotor, participation=participation)


def derive_by_bearing(rotor: RotorModel, bearing: int) -> np.ndarray:
    """(2 B, n) derivative of what bearings feel of the DOF, by the shift of one of them along the shaft, 1/m."""
    rows = np.zeros((TRANSLATIONS * len(rotor.bearing_nodes), rotor.n_dof))
    shift = rotor.bearing_shifts[bearing] if rotor.bearing_shifts else 0.0
    felt = slice(TRANSLATIONS * bearing, TRANSLATIONS * (bearing + 1))
    rows[felt] = shaft_rows(rotor, rotor.bearing_nodes[bearing], shift, True)
    return rows


def derive_by_casing(rotor: RotorModel, place: int) -> np.ndarray:
    """(2 B, n) likewise by a participation of the base, in which it is linear."""
    before, after = (bearing_places(r).loads(rotor.n_dof).T for r in (rotor, move_casing(rotor, place, 1.0)))
    return np.asarray(after - before)
