"""Which coefficients are unknown, and what ties them together.

An unknown is a free number; a coefficient is what it stands for. Without a structure each unknown is one
coefficient. A structure lets one unknown stand for two, so that the identified coefficients obey it exactly:

    symmetric_damping   cxy = cyx
    isotropic           kxx = kyy, kxy = -kyx, cxx = cyy, cxy = -cyx

Legend: B bearings, U unknowns (of all bearings together), 8 coefficients in the order of
:data:`pipeline.coefficients.COEFFICIENTS`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np

from pipeline.coefficients import COEFFICIENTS, CoefficientName

Structure = Literal["none", "symmetric_damping", "isotropic"]

# (follower, leader, sign): the follower is sign times the leader.
_TIES: dict[str, tuple[tuple[str, str, int], ...]] = {
    "none": (),
    "symmetric_damping": (("cyx", "cxy", 1),),
    "isotropic": (("kyy", "kxx", 1), ("kyx", "kxy", -1), ("cyy", "cxx", 1), ("cyx", "cxy", -1)),
}


@dataclass(frozen=True)
class BearingUnknowns:
    """The coefficients that are identified at one bearing, and their structure."""

    coefficients: tuple[CoefficientName, ...]
    structure: Structure = "none"

    def __post_init__(self) -> None:
        for follower, leader, _ in _TIES[self.structure]:
            if (follower in self.coefficients) != (leader in self.coefficients):
                named, other = (follower, leader) if follower in self.coefficients else (leader, follower)
                raise ValueError(
                    f"structure {self.structure} ties {leader} and {follower}: both must be unknown or neither, but "
                    f"{named} is and {other} is not"
                )

    def places(self) -> dict[str, tuple[str, int]]:
        """Coefficient -> (its unknown, sign)."""
        followers = {follower: (leader, sign) for follower, leader, sign in _TIES[self.structure]}
        return {name: followers.get(name, (name, 1)) for name in self.coefficients}


@dataclass(frozen=True, eq=False)
class UnknownSet:
    """The unknowns of all bearings, and how coefficients follow from them: ``coefficients = expansion @ unknowns``."""

    names: tuple[CoefficientName, ...]  # U, each by the coefficient that leads it
    expansion: np.ndarray  # (B, 8, U) of 0, 1 and -1; a row of zeros is a known coefficient

    @property
    def present(self) -> np.ndarray:
        """(B, U) mask: False where a bearing does not have an unknown."""
        return (self.expansion != 0).any(axis=1)

    @property
    def identified(self) -> np.ndarray:
        """(B, 8) mask of the coefficients that are not known."""
        return (self.expansion != 0).any(axis=2)

    def coefficients(self, b: int) -> tuple[str, ...]:
        """Names of what is identified at bearing b."""
        return tuple(name for name, free in zip(COEFFICIENTS, self.identified[b], strict=True) if free)

    @property
    def by_bearing(self) -> tuple[tuple[str, ...], ...]:
        """Names of what is identified, bearing by bearing."""
        return tuple(self.coefficients(b) for b in range(len(self.expansion)))

    def expand(self, values: np.ndarray, known: np.ndarray) -> np.ndarray:
        """(B, S, 8) coefficients from unknowns (B, S, U) and, where nothing is identified, ``known`` (B, S, 8)."""
        found = np.einsum("bcu,bsu->bsc", self.expansion, values)
        return np.where(self.identified[:, None], found, known)


def unknown_set(of: Mapping[int, BearingUnknowns]) -> UnknownSet:
    """The unknowns of the bearings at these nodes, in the order of the mapping."""
    places = [bearing.places() for bearing in of.values()]
    asked = dict.fromkeys(name for bearing in of.values() for name in bearing.coefficients)
    leaders = {leader for place in places for leader, _ in place.values()}
    names = tuple(name for name in asked if name in leaders)
    expansion = np.zeros((len(places), len(COEFFICIENTS), len(names)))
    for b, place in enumerate(places):
        for coefficient, (leader, sign) in place.items():
            expansion[b, COEFFICIENTS.index(coefficient), names.index(leader)] = sign
    return UnknownSet(names, expansion)
