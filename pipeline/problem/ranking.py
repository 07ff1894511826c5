"""Order by size where sizes tie: what is said or chosen must not hang on the last bit of a processor's kernels."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from itertools import pairwise
from typing import Any, TypeVar

import numpy as np

Name = TypeVar("Name", bound=Any)


def rank(sizes: Mapping[Name, float], alike: float = 1e-6) -> list[Name]:
    """The names, the largest size first; those whose sizes tie go by name, and what is no number comes last.

    Neighbours that differ by a share ``alike`` tie: far above rounding, far below what anybody reads.
    """
    order = sorted(sizes, key=lambda name: (math.isnan(sizes[name]), -sizes[name]))
    groups = [order[:1]]
    for before, after in pairwise(order):
        if math.isclose(sizes[before], sizes[after], rel_tol=alike) or math.isnan(sizes[before]):
            groups[-1].append(after)
        else:
            groups.append([after])
    return [name for group in groups for name in sorted(group)]


def rank_indices(sizes: Iterable[float]) -> list[int]:
    """The same of a sequence: the names are its indices."""
    return rank(dict(enumerate(map(float, sizes))))


def list_leading(shares: Mapping[str, float], least: float) -> dict[str, float]:
    """A combination by its largest share, which becomes positive, and the others down to ``least``, in their order."""
    order = rank({name: abs(share) for name, share in shares.items()})
    sign = np.sign(shares[order[0]])
    return {name: sign * shares[name] for name in order if name == order[0] or abs(shares[name]) >= least}


def find_least(sizes: Mapping[Name, float]) -> Name:
    """The name of the smallest size; of those that tie the first by name."""
    return rank({name: -size for name, size in sizes.items()})[0]


def count_alike(losses: Iterable[float], same: float = 1e-3) -> int:
    """How many differ from the lowest by less than the share ``same`` of it."""
    every = list(losses)
    return sum(loss - min(every) <= same * abs(min(every)) for loss in every)


def find_distinct(losses: list[float], most: int = 3, same_valley: float = 1e-2, equal: float = 1e-6) -> list[int]:
    """The best few that lie in valleys of their own, the best first; of equals the one that was given first."""
    kept: list[int] = []
    rest = sorted(range(len(losses)), key=lambda i: losses[i])
    while rest and len(kept) < most:
        lowest = losses[rest[0]]
        kept.append(min(i for i in rest if losses[i] <= lowest * (1 + equal)))
        rest = [i for i in rest if losses[i] > lowest * (1 + same_valley)]
    return kept
