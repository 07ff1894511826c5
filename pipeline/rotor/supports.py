"""What stands between the shaft and the ground in a rotor of ROSS: bearings on supports, seals, thrust bearings.

A bearing on a support is identified as the shaft feels it, film and support in series: no vibration of the shaft tells
one from the other. With a support's node i and a shaft's node s it is

    Z = Z_ss - Z_si Z_ii^-1 Z_is,     K = Re Z,     C = Im Z / w,     each part K + j w C - w^2 M

at the speed w: exact where the frequency is the rotor's.

Legend: m nodes of a stand, the shaft's first. SI units.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from pipeline.errors import ConfigError
from pipeline.rotor.seals import COLUMNS, NO_SEALS, Seals


@dataclass(frozen=True, eq=False)
class Stand:
    """Everything that holds one node of the shaft: ROSS's bearing elements, and point masses beside the shaft."""

    node: int
    elements: tuple[Any, ...]
    masses: tuple[Any, ...] = ()

    @property
    def supported(self) -> bool:
        """True where the coefficients that the shaft feels hold at the rotor's own frequency alone."""
        linked = any(_ends(element) != {self.node} for element in self.elements)
        return linked or any(_has(element, "m") for element in self.elements)

    def blocks(self, speed: float) -> tuple[np.ndarray, np.ndarray]:
        """K and C (2, 2) that the shaft feels at ``speed`` rad/s."""
        if not self.supported:  # as they stand in the file
            stiffness = sum(element.K(speed)[:2, :2] for element in self.elements)
            return np.asarray(stiffness), np.asarray(sum(element.C(speed)[:2, :2] for element in self.elements))
        felt = self._condense(speed)
        return felt.real, felt.imag / speed

    def _condense(self, w: float) -> np.ndarray:
        nodes = list(dict.fromkeys([self.node, *(end for one in self.elements for end in sorted(_ends(one)))]))
        total = np.zeros((len(nodes), 2, len(nodes), 2), dtype=complex)
        for element in self.elements:
            whole = element.K(w) + 1j * w * element.C(w) - w**2 * element.M(w)
            ends = [nodes.index(int(element.n))]
            ends += [nodes.index(int(element.n_link))] if element.n_link is not None else []
            for i, a in enumerate(ends):
                for j, b in enumerate(ends):
                    total[a, :, b] += whole[3 * i : 3 * i + 2, 3 * j : 3 * j + 2]
        for mass in self.masses:
            at = nodes.index(int(mass.n))
            total[at, :, at] -= w**2 * mass.M()[:2, :2]
        matrix = total.reshape(2 * len(nodes), 2 * len(nodes))
        try:
            solution = np.linalg.solve(matrix[2:, 2:], matrix[2:, :2])
        except np.linalg.LinAlgError:
            raise ConfigError(
                f"a support must be held to give its bearing coefficients, but that of node {self.node} is not at "
                f"{w:.6g} rad/s: add a bearing element from its node to the ground"
            ) from None
        return np.asarray(matrix[:2, :2] - matrix[:2, 2:] @ solution)


def find_stands(elements: Iterable[Any], masses: Sequence[Any], last: int, seal_class: type) -> tuple[Stand, ...]:
    """The bearings of a rotor whose shaft ends at the node ``last``, one for each node of the shaft that one stands at.

    Raises ConfigError for bearings that hold two nodes of the shaft together.
    """
    bearings = [element for element in elements if not isinstance(element, seal_class) and not _is_axial(element)]
    stands = []
    for node in sorted({end for bearing in bearings for end in _ends(bearing) if end <= last}):
        joined, found = {node}, []
        rest = list(bearings)
        # From the shaft's node through the supports; another node of the shaft ends the way.
        while grown := [element for element in rest if _ends(element) & joined]:
            rest = [element for element in rest if element not in grown]
            found += grown
            joined |= {end for element in grown for end in _ends(element) if end > last}
            both = sorted({end for element in grown for end in _ends(element) if end <= last} | {node})
            if len(both) > 1:
                raise ConfigError(
                    "machine.rotor.file must hold each bearing node of the shaft by itself, but "
                    f"'{grown[0].tag}' holds the nodes {both[0]} and {both[1]} together: give each bearing a support "
                    "of its own, or link it to none (n_link)"
                )
        beside = tuple(mass for mass in masses if int(mass.n) in joined and int(mass.n) > last)
        stands.append(Stand(node, tuple(found), beside))
    return tuple(stands)


def find_seals(elements: Iterable[Any], last: int, seal_class: type) -> Seals:
    """The seals of a rotor. Raises ConfigError for one on a support, and one beside the shaft."""
    rows: list[list[float]] = []
    seals: list[Any] = [element for element in elements if isinstance(element, seal_class)]
    for seal, spring in enumerate(seals):
        if spring.n_link is not None or spring.n > last:
            raise ConfigError(
                f"machine.rotor.file must have seals between shaft and ground, but '{spring.tag}' at node {spring.n} "
                "stands on a support: leave out its n_link"
            )
        constant = spring.frequency is None or len(spring.kxx) == 1
        speeds = np.array([np.nan]) if constant else np.array(spring.frequency, dtype=float)
        columns = np.array([np.asarray(getattr(spring, name), dtype=float) for name in COLUMNS])
        rows += [[seal, spring.n, speed, *values] for speed, values in zip(speeds, columns.T, strict=True)]
    return Seals(np.array(rows)) if rows else NO_SEALS


def _ends(element: Any) -> set[int]:
    """The nodes that an element joins to each other or to the ground."""
    return {int(element.n)} | ({int(element.n_link)} if element.n_link is not None else set())


def _is_axial(element: Any) -> bool:
    """True for a thrust bearing: it holds the shaft along its axis alone."""
    return not _has(element, "kcm") and any(np.any(np.asarray(getattr(element, name))) for name in ("kzz", "czz"))


def _has(element: Any, kinds: str) -> bool:
    """Whether any lateral coefficient of these kinds (k, c, m) is not zero."""
    names = [name for name in COLUMNS if name[0] in kinds]
    return any(np.any(np.asarray(getattr(element, name), dtype=float)) for name in names)
