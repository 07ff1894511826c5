"""Correction weights at given holes: the choice of holes and masses that leaves least.

What a choice leaves is ``A c + b``: c (N,) complex kg m are the unbalances that the weights make in the planes, b is
what is there without them, and A how the weights act on it. With A the identity and b the unbalance, the choice leaves
least unbalance; with influence coefficients for A and vibration for b, least vibration. The search is exact: with the
QR factorisation of A the cost is a sum over planes, each with the choices of the planes before it fixed, so that a
choice whose sum already exceeds the best known is left out with all that follow (the sphere decoder of Fincke and
Pohst, 1985).

Legend: N planes, M rows, H holes of a plane, K choices of a plane.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations, product
from typing import TYPE_CHECKING

import numpy as np

from pipeline.config.balance import ANY, BalancePlaneConfig, WeightsConfig
from pipeline.errors import ConfigError
from pipeline.ingest.conventions import SourceUnits

if TYPE_CHECKING:
    from scipy.spatial import KDTree


@dataclass(frozen=True, eq=False)
class Holes:
    """The holes of one plane, and what can be put into them."""

    angles: np.ndarray  # (H,) rad, from x at the pulse
    radius: float  # m
    masses: tuple[float, ...] | None  # kg, each as often as it is wanted; None for any mass
    most: int  # weights at once, each in a hole of its own

    @property
    def unit(self) -> np.ndarray:
        """(H,) complex m: the unbalance of 1 kg in each hole."""
        return self.radius * np.exp(1j * self.angles)


@dataclass(frozen=True)
class Weight:
    """A mass (kg) in a hole, counted from 1."""

    hole: int
    mass: float


def place_holes(given: WeightsConfig, nodes: Sequence[int], source: SourceUnits) -> list[Holes | None]:
    """The holes of the planes at the ``nodes`` (N); None where there are none.

    Raises ConfigError for a plane that is not among them.
    """
    planes = {plane.node: plane for plane in given.planes}
    for node in planes:
        if node not in nodes:
            raise ConfigError(
                "machine.balance.planes must be planes that had weights in some condition, since the influence of "
                f"others is not known, but node {node} had none ({', '.join(map(str, nodes))} had)"
            )
    masses = None if given.masses == ANY else tuple(given.masses)

    def place(plane: BalancePlaneConfig) -> Holes:
        turn = 2 * np.pi * np.arange(plane.holes) / plane.holes
        sense = 1 if plane.numbering == "with_rotation" else -1
        return Holes(source.recordings.angle_from_x(plane.first_angle) + sense * turn, plane.radius, masses, given.most)

    return [place(planes[node]) if node in planes else None for node in nodes]


def choose_weights(
    acting: np.ndarray, read: np.ndarray, planes: Sequence[Holes]
) -> tuple[tuple[tuple[Weight, ...], ...], np.ndarray]:
    """The weights of each plane whose ``acting @ c + there`` has the least norm, and c: (N,) kg m that they make.

    ``acting`` (M, N) complex with M >= N, ``there`` (M,) complex; all planes have masses of a list, or all have any.
    Raises ConfigError where there are too many choices, or two planes act alike.
    """
    # The cost is |triangle (c - wanted)|^2 and a constant, with the unbalance (N,) that would leave least.
    q, triangle = np.linalg.qr(acting)
    size = np.abs(np.diag(triangle))
    if size.min() <= 1e-9 * size.max():
        raise ConfigError(
            "machine.balance.planes must act differently on the vibration, but two of them act alike at these probes "
            "and speeds: leave one of them out, or balance at more speeds (balance.speeds_rpm)"
        )
    wanted = np.linalg.solve(triangle, -q.conj().T @ read)
    if planes[0].masses is not None:
        choices = [_list_choices(plane) for plane in planes]
        chosen = [choice.weights(k) for choice, k in zip(choices, _search(triangle, wanted, choices), strict=True)]
    elif min(plane.most for plane in planes) > 1:
        chosen = [split_vector(complex(c), plane) for c, plane in zip(wanted, planes, strict=True)]
    else:
        chosen = _choose_holes(triangle, wanted, planes)
    made = [
        sum(w.mass * plane.unit[w.hole - 1] for w in weights) for weights, plane in zip(chosen, planes, strict=True)
    ]
    return tuple(chosen), np.array(made, dtype=complex)


def split_vector(unbalance: complex, holes: Holes, same: float = 1e-9) -> tuple[Weight, ...]:
    """Any masses in the two neighbouring holes that make ``unbalance`` (kg m) together; one where it points at a hole.

    The holes stand all round: at least three, evenly spaced. A mass below the share ``same`` of the other is none.
    """
    if unbalance == 0:
        return ()
    turns = np.mod(holes.angles - np.angle(unbalance), 2 * math.pi)
    pair = [int(turns.argmax()), int(turns.argmin())]  # the last one before it, the first one from it on
    matrix = np.array([holes.unit[pair].real, holes.unit[pair].imag])
    masses = np.linalg.solve(matrix, [unbalance.real, unbalance.imag])
    weights = (Weight(hole + 1, float(mass)) for hole, mass in zip(pair, masses, strict=True))
    return tuple(weight for weight in weights if weight.mass > same * masses.max())


# --- masses of a list --------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class _Choices:
    """Every set of weights of a plane; of sets that make the same unbalance the one of fewest and lightest weights."""

    unbalance: np.ndarray  # (K,) complex kg m
    holes: np.ndarray  # (K, most), -1 for none
    masses: np.ndarray  # (K, most) kg

    @cached_property
    def tree(self) -> KDTree:
        """For the choices nearest to a vector."""
        from scipy.spatial import KDTree

        return KDTree(_as_points(self.unbalance))

    def weights(self, index: int) -> tuple[Weight, ...]:
        """The weights of one choice, by hole."""
        pairs = zip(self.holes[index].tolist(), self.masses[index].tolist(), strict=True)
        return tuple(Weight(hole + 1, mass) for hole, mass in pairs if hole >= 0)


def _as_points(values: np.ndarray) -> np.ndarray:
    return np.stack([values.real, values.imag], axis=-1)


def _list_choices(holes: Holes, most_choices: int = 3_000_000, same: float = 1e-9) -> _Choices:
    """All choices of a plane; more than ``most_choices`` would not fit into memory at once.

    Two of them are called the same where they differ by less than the share ``same`` of the largest.
    """
    count, most = len(holes.angles), min(holes.most, len(holes.angles))
    listed = np.unique(np.array(holes.masses, dtype=float))
    total = sum(math.comb(count, k) * len(listed) ** k for k in range(most + 1))
    if total > most_choices:
        raise ConfigError(
            f"a plane must have at most {most_choices} choices of weights, but {count} holes, {len(listed)} masses and "
            f"up to {most} weights make {total}: give fewer masses, or a smaller machine.balance.most"
        )
    at, chosen = np.full((1, most), -1), np.zeros((1, most))
    for k in range(1, most + 1):
        places = np.array(list(combinations(range(count), k)))
        sizes = np.array(list(product(listed, repeat=k)))
        blank = ((0, 0), (0, most - k))
        at = np.concatenate([at, np.pad(np.repeat(places, len(sizes), axis=0), blank, constant_values=-1)])
        chosen = np.concatenate([chosen, np.pad(np.tile(sizes, (len(places), 1)), blank)])
    made = (holes.unit[at] * chosen).sum(axis=1)
    order = np.lexsort((chosen.sum(axis=1), (at >= 0).sum(axis=1)))
    grid = np.round(_as_points(made[order]) / (same * np.abs(made).max()))
    _, first = np.unique(grid, axis=0, return_index=True)
    kept = order[np.sort(first)]
    return _Choices(made[kept], at[kept], chosen[kept])


def _search(triangle: np.ndarray, wanted: np.ndarray, choices: Sequence[_Choices]) -> list[int]:
    """The choice of each plane with the least cost: from the last plane to the first, nearest choices first."""
    best: list[int] = []
    least = math.inf

    def descend(i: int, fixed: list[int], spent: float) -> None:
        """Choose plane i and those before it, where the planes after it are ``fixed`` and have cost ``spent``."""
        nonlocal best, least
        rest = sum(triangle[i, j] * (choices[j].unbalance[k] - wanted[j]) for j, k in enumerate(fixed, i + 1))
        target, size = wanted[i] - rest / triangle[i, i], abs(triangle[i, i])
        if i == 0:
            near, k = choices[0].tree.query([target.real, target.imag])
            if spent + (size * near) ** 2 < least:
                best, least = [int(k), *fixed], spent + (size * near) ** 2
            return
        far = np.abs(choices[i].unbalance - target)
        for k in np.argsort(far, kind="stable"):
            if far[k] >= math.sqrt(max(least - spent, 0.0)) / size:
                return
            descend(i - 1, [int(k), *fixed], spent + (size * float(far[k])) ** 2)

    descend(len(choices) - 1, [], 0.0)
    return best


# --- any mass ----------------------------------------------------------------------------------------


def _choose_holes(
    triangle: np.ndarray, wanted: np.ndarray, planes: Sequence[Holes], most_sets: int = 30_000
) -> list[tuple[Weight, ...]]:
    """One weight of any mass a plane: every set of holes, each with its masses by non-negative least squares.

    At most ``most_sets`` are tried one by one, which takes a second.
    """
    from scipy.optimize import nnls

    count = math.prod(len(plane.angles) for plane in planes)
    if count > most_sets:
        raise ConfigError(
            f"weights of any mass, one a plane, must have at most {most_sets} sets of holes, but there are {count}: "
            "allow two weights a plane (machine.balance.most=2), which can make any vector"
        )
    right = _as_points(triangle @ wanted).ravel()
    best, least = [], math.inf
    for holes in product(*(range(len(plane.angles)) for plane in planes)):
        units = np.array([plane.unit[h] for h, plane in zip(holes, planes, strict=True)])
        matrix = _as_points((triangle * units).T).transpose(1, 2, 0).reshape(len(right), -1)
        masses, left = nnls(matrix, right)
        if left < least:
            best, least = list(zip(holes, masses.tolist(), strict=True)), left
    return [(Weight(hole + 1, mass),) if mass > 0 else () for hole, mass in best]
