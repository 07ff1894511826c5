"""Conditions that contradict their labels, found from the vibration alone at a stated rate of false alarms.

The squared distance T^2 of each condition from the model of the others is held against a scaled F distribution whose
tail the others show (Hotelling's for Gaussian conditions). The farthest is left out and the rest is fitted again, so
that one gross case does not mask others: what was left out up to the last significant step is named (Rosner 1983). A
chance is that of the farthest of all conditions (Bonferroni).

Legend: C conditions, N planes, D = S P (speeds times channels).
"""

from __future__ import annotations

import numpy as np

from pipeline.balance.influence import Influence, distances, fit_influence
from pipeline.data.conditions import Conditions
from pipeline.errors import IdentifiabilityError
from pipeline.problem.noise_levels import fit_tail


def find_contradictions(
    conditions: Conditions, rate: float = 0.01, law: bool | None = None, most: float = 0.2
) -> tuple[dict[str, float], Influence]:
    """The conditions that contradict their labels, gross ones first, and the model of the others.

    With each name comes the chance that consistent conditions have one as far off, in all of them together. ``rate`` is
    the chance to name any where none contradicts, ``most`` the share that may be named: a model can't say which half is
    right. Raises IdentifiabilityError where the conditions are too few to judge one by the others.
    """
    from scipy import stats

    size, n = conditions.vectors.shape[1], len(conditions.names)
    columns = 1 + len(conditions.planes)
    if n - columns - 1 < size + 2:
        raise IdentifiabilityError(
            f"a condition can be judged by more than {size + columns + 2} others (the entries of a vector, and the "
            f"columns of the model), but there are {n}: measure more conditions, or use fewer probes or speeds"
        )
    left, named = list(range(n)), 0
    removed: list[int] = []
    chances: list[float] = []
    growth = fit_influence(conditions, law=law).growth  # robust: gross conditions are not taken for growth
    squared = distances(conditions, fit_influence(conditions, law=law, robust=False, growth=growth))
    while len(removed) < int(most * n) and len(left) - columns - 2 >= size + 2:
        far, among = int(np.argmax(squared)), len(left)
        gross = float(squared[far])
        removed.append(left.pop(far))
        others = conditions.of(left)
        squared = distances(others, fit_influence(others, law=law, robust=False, growth=growth))
        tail, stretch = fit_tail(squared, size, float(len(left) - columns - 1), max(gross, float(squared.max())))
        chances.append(float(min(1.0, among * stats.f.sf(gross / (stretch * size), 2 * size, 2 * tail))))
        if chances[-1] < rate:
            named = len(removed)
    contradictions = {conditions.names[c]: min(chances[k:named]) for k, c in enumerate(removed[:named])}
    return contradictions, fit_influence(conditions.without(contradictions), law=law)
