"""How well the data determine each coefficient at the stated noise, in the words of an engineer.

Rank (:mod:`pipeline.problem.identifiability`) says what could be solved for without noise. A coefficient that is known
to 20 times its size is of no use all the same: the verdict compares its standard deviation with its size.

Legend: B bearings, S speeds.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Any

import numpy as np

from pipeline.coefficients import COEFFICIENTS
from pipeline.problem.ranking import rank_indices
from pipeline.rotor.bearing_table import BearingTable
from pipeline.write_numbers import write_percent, write_where

WELL_BELOW = 0.05
"""The 95 % interval is then within 10 % of the coefficient. A critical speed goes with the root of a stiffness, so it
is known to 5 % at worst; a clearance within 3 % of its drawing moves a film's stiffness, which goes with its inverse
cube, as much."""
WEAKLY_BELOW = 0.30
"""Zero is then more than three standard deviations away: sign and order of magnitude are certain, no more."""


class Verdict(StrEnum):
    """Can it be used? From the most to the least favourable."""

    GOOD = "good"
    WITH_CARE = "with care"
    NO = "no"

    @property
    def determined(self) -> str:
        """What a deviation that allows it says of a coefficient."""
        return {"good": "well determined", "with care": "weakly determined", "no": "not determined"}[self]


@dataclass(frozen=True)
class Determined:
    """One coefficient of one bearing."""

    node: int
    name: str
    deviation: float  # standard deviation over size, median over the speeds
    lost: float = 0.0  # share of the speeds at which it is not determined
    where: str = ""  # these speeds, in words

    @property
    def verdict(self) -> Verdict:
        """By the limits above; a deviation that is not a number determines nothing."""
        if self.deviation < WELL_BELOW:
            return Verdict.GOOD
        return Verdict.WITH_CARE if self.deviation < WEAKLY_BELOW else Verdict.NO


def measure_sizes(values: np.ndarray, cross_share: float = 0.1) -> np.ndarray:
    """(B, S, 8) N/m and N s/m: what deviations of the coefficients ``values`` are compared with.

    A cross-coupled coefficient counts as ``cross_share`` of the geometric mean of its bearing's direct ones at least:
    one that is nearly zero is known well enough where nothing feels what is unknown of it. Known to 10 % of that (95
    %), it is known to 1 % of the direct ones; a cross stiffness of k sqrt(kxx kyy) moves a logarithmic decrement by
    about pi k, here 0.03, where API 617 asks for a decrement of 0.1.
    """
    sizes: np.ndarray = np.abs(values)
    for first in (0, 4):  # stiffness, damping: xx, xy, yx, yy
        direct = (np.sqrt(sizes[..., first]) * np.sqrt(sizes[..., first + 3]))[..., None]  # no overflow
        cross = slice(first + 1, first + 3)
        sizes[..., cross] = np.maximum(sizes[..., cross], cross_share * direct)
    return sizes


def relative_deviation(table: BearingTable) -> np.ndarray:
    """(B, S, 8) standard deviations of the coefficients over their sizes; infinite where that is zero."""
    sizes = measure_sizes(table.values)
    return np.asarray(np.divide(table.spread, sizes, out=np.full(sizes.shape, np.inf), where=sizes > 0))


def find_lost(table: BearingTable) -> np.ndarray:
    """(B, S, 8) bool: where a coefficient is not determined; nowhere of what has no deviation."""
    return np.asarray(np.isfinite(table.spread) & ~(relative_deviation(table) < WEAKLY_BELOW))


def judge_determined(table: BearingTable) -> tuple[Determined, ...]:
    """A verdict on each coefficient that is identified, bearing by bearing, at the speeds where it is a number."""
    relative, judged = relative_deviation(table)[:, table.bounded], []
    for b, c in np.argwhere(~np.isnan(table.spread).all(axis=1)):
        share = relative[b, :, c]
        lost = ~(share < WEAKLY_BELOW)
        where = write_where(table.speeds[table.bounded], lost)
        size, part = float(np.median(share)), float(np.mean(lost))
        judged.append(Determined(table.nodes[b], COEFFICIENTS[c], size, part, where))
    return tuple(judged)


def describe_determined(judged: Sequence[Determined], most_named: int = 8) -> str:
    """The verdicts in words: the best first, each with its worst coefficient, and nodes where there are several.

    More than ``most_named``, as many as a bearing has, are counted.
    """
    several, parts = len({judgement.node for judgement in judged}) > 1, []
    for verdict in Verdict:
        alike = [judgement for judgement in judged if judgement.verdict is verdict]
        if not alike:
            continue
        names = [f"{judgement.name} at node {judgement.node}" if several else judgement.name for judgement in alike]
        worst = rank_indices(judgement.deviation for judgement in alike)[0]
        size = write_percent(alike[worst].deviation, "+- ")
        which = f"{len(alike)} of {len(judged)}" if len(alike) > most_named else ", ".join(names)
        which = "all" if len(alike) == len(judged) > 1 else which
        parts.append(f"{which} {verdict.determined} ({f'{names[worst]} ' if len(alike) > 1 else ''}{size})")
    partly = [judgement for judgement in judged if judgement.lost and judgement.verdict is not Verdict.NO]
    if partly:
        coefficient = partly[rank_indices(judgement.lost for judgement in partly)[0]]
        where = f" at node {coefficient.node}" if several else ""
        parts.append(f"{coefficient.name}{where} not {coefficient.where}")
    return "; ".join(parts)


def summarize_determined(judged: Sequence[Determined]) -> dict[str, dict[str, dict[str, object]]]:
    """Node -> coefficient -> verdict and deviation in percent (null where there is no limit), for JSON."""
    result: dict[str, dict[str, dict[str, object]]] = {}
    for coefficient in judged:
        percent = float(100 * coefficient.deviation) if np.isfinite(coefficient.deviation) else None
        result.setdefault(str(coefficient.node), {})[coefficient.name] = {
            "verdict": coefficient.verdict.determined,
            "deviation_percent": percent,
            "not_determined_at_percent_of_speeds": 100 * coefficient.lost,
            "not_determined": coefficient.where,
        }
    return result


def read_determined(summary: Mapping[str, Mapping[str, Mapping[str, Any]]]) -> list[Determined]:
    """What :func:`summarize_determined` wrote."""
    return [
        Determined(
            int(node),
            name,
            np.inf if entry["deviation_percent"] is None else entry["deviation_percent"] / 100,
            entry["not_determined_at_percent_of_speeds"] / 100,
            entry["not_determined"],
        )
        for node, coefficients in summary.items()
        for name, entry in coefficients.items()
    ]
