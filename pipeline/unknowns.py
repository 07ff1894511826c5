"""Which coefficients are unknown, and what ties them together.

An unknown is a number to be found; a coefficient is what it stands for. Without a structure each unknown is one
coefficient. A structure lets one unknown stand for two, so that the identified coefficients obey it exactly:

    symmetric_damping   cxy = cyx
    isotropic           kxx = kyy, kxy = -kyx, cxx = cyy, cxy = -cyx

Legend: B bearings, M members (B, or 1 where all bearings share their coefficients), U unknowns, A those of them that
members have, S speeds, 8 coefficients in the order of :data:`pipeline.coefficients.COEFFICIENTS`.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal

import numpy as np

from pipeline.coefficients import COEFFICIENTS, CoefficientName

Structure = Literal["none", "symmetric_damping", "isotropic"]

# (follower, leader, sign): the follower is sign times the leader.
_TIES: dict[str, tuple[tuple[str, str, int], ...]] = {
    "none": (),
    "symmetric_damping": (("cyx", "cxy", 1),),
    "isotropic": (("kyy", "kxx", 1), ("kyx", "kxy", -1), ("cyy", "cxx", 1), ("cyx", "cxy", -1)),
}


Tied = Mapping[CoefficientName, tuple[str, int]]
"""What is identified at one bearing: coefficient -> (its unknown, sign)."""


def tie(coefficients: Sequence[CoefficientName], structure: Structure = "none") -> Tied:
    """The ``coefficients`` that are identified at one bearing, of a structure. Raises ValueError for half of a tie."""
    for follower, leader, _ in _TIES[structure]:
        if (follower in coefficients) != (leader in coefficients):
            named, other = (follower, leader) if follower in coefficients else (leader, follower)
            raise ValueError(
                f"structure {structure} ties {leader} and {follower}: both must be unknown or neither, but {named} is "
                f"and {other} is not"
            )
    followers = {follower: (leader, sign) for follower, leader, sign in _TIES[structure]}
    return {name: followers.get(name, (name, 1)) for name in coefficients}


@dataclass(frozen=True, eq=False)
class UnknownSet:
    """What is identified: the unknowns of all bearings, and how coefficients follow from them.

    ``coefficients = expansion @ unknowns``. A member has unknowns of its own: each bearing, or all of them together
    where they share their coefficients.
    """

    names: tuple[CoefficientName, ...]  # U, each by the coefficient that leads it
    expansion: np.ndarray  # (B, 8, U) of 0, 1 and -1; a row of zeros is a known coefficient
    shared: bool = False  # all bearings share their coefficients
    planes: tuple[int, ...] = ()  # nodes whose residual unbalance is identified too

    @property
    def n_members(self) -> int:
        """M."""
        return 1 if self.shared else len(self.expansion)

    @property
    def present(self) -> np.ndarray:
        """(M, U) mask: False where a member does not have an unknown."""
        return (self.expansion != 0).any(axis=1)[: self.n_members]

    @cached_property
    def active(self) -> tuple[tuple[int, int], ...]:
        """The unknowns that members have, A of (member, unknown)."""
        return tuple((int(m), int(u)) for m, u in np.argwhere(self.present))

    @property
    def identified(self) -> np.ndarray:
        """(B, 8) mask of the coefficients that are not known."""
        return (self.expansion != 0).any(axis=2)

    @property
    def by_bearing(self) -> tuple[tuple[str, ...], ...]:
        """Names of what is identified, bearing by bearing."""
        return tuple(tuple(itertools.compress(COEFFICIENTS, bearing)) for bearing in self.identified)

    @cached_property
    def influence(self) -> np.ndarray:
        """(B, 8, A) which coefficients each active unknown moves, and with what sign."""
        result = np.zeros((*self.expansion.shape[:2], len(self.active)))
        for a, (m, u) in enumerate(self.active):
            members = slice(None) if self.shared else slice(m, m + 1)
            result[members, :, a] = self.expansion[members, :, u]
        return result

    def expand(self, values: np.ndarray, known: np.ndarray) -> np.ndarray:
        """(B, S, 8) coefficients from unknowns (M, S, U), or constants (M, 1, U), and, where nothing is identified,
        ``known`` (B, S, 8).
        """
        # @ would warn of 0 x inf, where functions overflow. What bearings share is spread over them.
        expanded = np.einsum("bcu,bsu->bsc", self.expansion, values)
        return np.where(self.identified[:, None], expanded, known)

    def expand_deviation(self, deviation: np.ndarray) -> np.ndarray:
        """(B, S, 8) standard deviations from those of the unknowns (M, S, U); NaN where nothing is identified."""
        # Each coefficient follows one unknown, with a sign that no deviation has. 0 x inf would be NaN.
        follows = np.abs(self.expansion).argmax(axis=2)  # (B, 8)
        return np.where(self.identified[:, None], np.take_along_axis(deviation, follows[:, None, :], axis=2), np.nan)

    def leading(self, values: np.ndarray) -> np.ndarray:
        """(M, S, U) unknowns from coefficients (B, S, 8): each is the coefficient that leads it; zero where absent."""
        leaders = [COEFFICIENTS.index(name) for name in self.names]
        return values[: self.n_members][..., leaders] * self.present[:, None]

    def to_active(self, values: np.ndarray) -> np.ndarray:
        """(S, A) the active unknowns of all (M, S, U)."""
        return np.stack([values[m, :, u] for m, u in self.active], axis=-1)

    def expand_slopes(self, slopes: np.ndarray) -> np.ndarray:
        """(B, S, 8, n) derivative of the coefficients, from that of the active unknowns (S, A, n)."""
        result = np.zeros((len(self.expansion), len(slopes), len(COEFFICIENTS), slopes.shape[-1]))
        for b, signs in enumerate(self.influence):
            mine = signs.any(axis=0)  # what runs away at another bearing is none of this one's
            result[b] = np.einsum("ca,san->scn", signs[:, mine], slopes[:, mine], optimize=True)
        return result

    def from_active(self, columns: np.ndarray) -> np.ndarray:
        """(M, S, U) from the active unknowns (S, A); zero where a member lacks an unknown."""
        result = np.zeros((self.n_members, len(columns), len(self.names)))
        for a, (m, u) in enumerate(self.active):
            result[m, :, u] = columns[:, a]
        return result


def unknown_set(tied: Mapping[int, Tied], shared: bool = False, planes: tuple[int, ...] = ()) -> UnknownSet:
    """The unknowns of the bearings at these nodes, in the order of the mapping."""
    asked = dict.fromkeys(name for bearing in tied.values() for name in bearing)
    leaders = {leader for bearing in tied.values() for leader, _ in bearing.values()}
    names = tuple(name for name in asked if name in leaders)
    expansion = np.zeros((len(tied), len(COEFFICIENTS), len(names)))
    for b, bearing in enumerate(tied.values()):
        for coefficient, (leader, sign) in bearing.items():
            expansion[b, COEFFICIENTS.index(coefficient), names.index(leader)] = sign
    return UnknownSet(names, expansion, shared, planes)


# --- from what a model puts out to unknowns -------------------------------------------------------------


def scale_outputs(outputs: Any, size: Any, positive: Any, base: Any = 0.0) -> tuple[Any, Any]:
    """Unknowns, N/m and N s/m, and their derivative by the ``outputs`` x of a model.

    ``size exp(x)`` where an unknown must be ``positive`` (mask), ``base + size x`` elsewhere. For arrays of NumPy and
    for tensors of torch that broadcast, and whose last axis is the unknowns'.
    """
    if isinstance(outputs, np.ndarray):
        library: Any = np
    else:
        import torch as library
    if positive.all():
        values = size * library.exp(outputs)
        return values, values
    # The exponential sees zeros in place of the others: an overflow there would spoil their gradient.
    growth = library.exp(library.where(positive, outputs, 0.0))
    values = library.where(positive, size * growth, base + size * outputs)
    return values, library.where(positive, values, size)


def outputs_of(values: Any, size: Any, positive: Any, least: float = 1e-3) -> Any:
    """The outputs that :func:`scale_outputs` makes ``values`` of; what must be positive is kept above a share ``least``
    of its size, since measured values may have any sign.
    """
    relative = values / size
    if isinstance(relative, np.ndarray):
        return np.where(positive, np.log(np.maximum(relative, least)), relative)
    import torch

    return torch.where(positive, relative.clamp(min=least).log(), relative)
