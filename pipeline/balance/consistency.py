"""Conditions that contradict their labels, found from the vibration alone at a stated rate of false alarms.

The squared distance T^2 of each condition from the model of the others is held against a scaled F distribution whose
tail the others show (Hotelling's for Gaussian conditions). The farthest is left out and the rest is fitted again, so
that one gross case does not mask others: what was left out up to the last significant step is named (Rosner 1983). A
chance is that of the farthest of all conditions (Bonferroni).

Legend: C conditions, N planes, D = S P (speeds times channels).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.balance.influence import Influence, distances, fit_influence
from pipeline.balance.inverse import Unbalance, estimate_unbalance
from pipeline.data.conditions import Conditions
from pipeline.errors import IdentifiabilityError
from pipeline.problem.noise_levels import fit_tail

MOST = 0.2
"""Share of the conditions that may be named: a model can't say which half is right."""
_EXPLAINED = 0.01
"""Chance above which an explanation leaves nothing that calls for another."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Contradiction:
    """A condition that contradicts its label, and what would explain it."""

    name: str
    chance: float  # that consistent conditions have one as far off, in all of them together
    label: np.ndarray  # (N,) complex, kg m
    reading: Unbalance  # what the vibration would mean
    missing: tuple[int, ...]  # planes (nodes) whose weight seems to be missing
    shifted: tuple[int, float] | None  # the channel whose baseline has shifted (most), where no weights explain it
    explained: bool  # whether that shift alone, or the weights, leave nothing that is out of the ordinary
    seen: np.ndarray  # (S, P) bool: where it lies outside its interval


def find_contradictions(
    conditions: Conditions, rate: float = 0.01, law: bool | None = None
) -> tuple[list[Contradiction], Influence]:
    """The conditions that contradict their labels, gross ones first, and the model of the others.

    ``rate`` is the chance to name any where none contradicts. Raises IdentifiabilityError where the conditions are too
    few to judge one by the others.
    """
    from scipy import stats

    size, n = conditions.vectors.shape[1], len(conditions.names)
    columns = 1 + len(conditions.planes)
    steps = int(MOST * n)
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
    while len(removed) < steps and len(left) - columns - 2 >= size + 2:
        far, among = int(np.argmax(squared)), len(left)
        gross = float(squared[far])
        removed.append(left.pop(far))
        others = conditions.of(left)
        squared = distances(others, fit_influence(others, law=law, robust=False, growth=growth))
        tail, stretch = fit_tail(squared, size, float(len(left) - columns - 1), max(gross, float(squared.max())))
        chances.append(float(min(1.0, among * stats.f.sf(gross / (stretch * size), 2 * size, 2 * tail))))
        if chances[-1] < rate:
            named = len(removed)
    kept = [c for c in range(n) if c not in removed[:named]]
    model = fit_influence(conditions.of(kept), law=law)
    contradictions = [_explain(conditions.of([c]), model, min(chances[k:named])) for k, c in enumerate(removed[:named])]
    return contradictions, model


def _explain(conditions: Conditions, model: Influence, chance: float) -> Contradiction:
    """What the model of the others makes of a condition."""
    label, vector, count = conditions.unbalance[0], conditions.vectors[0], int(conditions.counts[0])
    mean, noise = model.predict(label[None])
    total = noise[0] + model.noise.covariance(np.array([count]))[0]
    residual = vector - mean[0]
    reading = estimate_unbalance(model, vector, count)
    n_speeds, n_channels = conditions.displacement.shape[1:]
    free = {}
    for p in range(n_channels):
        rest = np.setdiff1d(np.arange(len(vector)), np.arange(n_speeds) * n_channels + p)
        free[p] = _squared(residual[rest], total[np.ix_(rest, rest)])
    best = min(free, key=lambda p: free[p])
    by_shift = _chance(free[best], len(vector) - n_speeds, model)
    by_weights = _chance(reading.unexplained, len(vector) - len(label), model)
    explained = max(by_shift, by_weights) > _EXPLAINED
    if not explained:
        best = int(np.argmax((abs(residual.reshape(n_speeds, n_channels)) ** 2).sum(0)))
    shift = not explained or by_shift > by_weights
    without = [np.where(np.arange(len(label)) == n, 0, label) for n in np.flatnonzero(label)]
    missing = [
        conditions.planes[n] for n, u in zip(np.flatnonzero(label), without, strict=True) if _fits(conditions, model, u)
    ]
    width = model.noise.half_width(np.diag(total).real)
    outside = (abs(residual.real) > width) | (abs(residual.imag) > width)
    return Contradiction(
        name=conditions.names[0],
        chance=chance,
        label=label,
        reading=reading,
        missing=tuple(missing),
        shifted=conditions.channels[best] if shift else None,
        explained=explained,
        seen=outside.reshape(n_speeds, n_channels),
    )


def _fits(conditions: Conditions, model: Influence, unbalance: np.ndarray) -> bool:
    """Whether a condition reads like these weights."""
    mean, noise = model.predict(unbalance[None])
    total = noise[0] + model.noise.covariance(conditions.counts)[0]
    return _chance(_squared(conditions.vectors[0] - mean[0], total), len(total), model) > _EXPLAINED


def _squared(residual: np.ndarray, covariance: np.ndarray) -> float:
    return float((residual.conj() @ np.linalg.solve(covariance, residual)).real)


def _chance(squared: float, size: int, model: Influence) -> float:
    """That a consistent condition leaves as much in ``size`` entries."""
    from scipy import stats

    noise = model.noise
    tail = noise.tail or max(noise.freedom - size + 1, 1.0)
    return float(stats.f.sf(squared / (noise.stretch * size), 2 * size, 2 * tail))
