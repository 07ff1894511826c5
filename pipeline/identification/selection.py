"""How many features each unknown gets: as many as the data determine.

A model with few features can't follow the coefficients, one with many follows the noise. The features are nested,
from smooth to wavy, and more of them must lower Akaike's criterion: chi-square falls by more than 2 for each further
weight (Akaike 1974). So less noise keeps more of them, and no truth is needed. A tie goes to fewer features: what a
criterion differs by from one processor to another decides nothing.

Legend: G starts, A unknowns, K features, Z weights.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from pipeline.config.identification import LevenbergMarquardtConfig
from pipeline.identification.optimizers import levenberg_marquardt, until_still
from pipeline.identification.output_error_start import OutputErrorStart, robust_start
from pipeline.identification.problem import OutputError

if TYPE_CHECKING:
    import torch

COLLAPSED = 0.02
"""Below this fraction of its initial guess a coefficient counts as collapsed."""
AKAIKE = 2.0
"""A weight must lower chi-square by this in his criterion; a superfluous one lowers it by 1 on average."""
TIE = 0.01
"""Criteria closer than this are equal: between processors they differ by 1e-7, between the best two choices by 0.3."""
_KEPT_STARTS, _SAME_VALLEY, _EQUAL = 3, 1e-2, 1e-6
_LOOK_AHEAD = 3
"""So many orders in a row without a better criterion end the growth."""
_NEARLY = 1e-5
"""Share of the loss below which a step ends the search of an order: the fit itself goes on from there."""


def drop_features(
    problem: OutputError, weights: torch.Tensor, covariance: np.ndarray
) -> tuple[OutputError, torch.Tensor]:
    """The problem with the features that Akaike's criterion keeps, and the weights (1, 1, Z) to go on from.

    ``weights`` (1, 1, Z) are the minimum with all features, ``covariance`` (Z, Z) that of it. Chi-square is taken as
    quadratic there: fixing weight i at zero adds z_i^2 / C_ii and moves the others.
    """
    import torch

    n_active, count = problem.kept.shape
    value, spread, criterion = weights[0, 0].numpy(), covariance, 0.0
    best = (criterion, count, value)
    for order in range(count - 1, problem.basis.n_trend - 1, -1):
        for i in np.arange(n_active) * count + order:
            criterion += value[i] ** 2 / spread[i, i] - AKAIKE
            gain = spread[:, i] / spread[i, i]
            value = value - gain * value[i]
            spread = spread - np.outer(gain, spread[i])
        if criterion < best[0] + TIE:
            best = (min(criterion, best[0]), order, value)
    kept = (torch.arange(count) < best[1]).repeat(n_active, 1)
    chosen = replace(problem, kept=kept)
    return chosen, torch.where(chosen.fitted(), torch.as_tensor(best[2]), 0.0)[None, None]


def add_features(start: OutputErrorStart, config: LevenbergMarquardtConfig) -> tuple[OutputError, torch.Tensor]:
    """The problem with as many features as count, and its best minimum (1, 1, Z), where there is no linear start.

    From several guesses constants are fitted first, then feature by feature is added: far from the answer, many at once
    would follow one speed here and another there. What a filter made of each speed is tried with every number of
    features. It ends when Akaike's criterion, of the minima themselves, has not fallen for some features. Where the
    likelihood says how large the features are, it ends at the trend, and keeps all.
    """
    import torch

    problem, starts = start.problem, start.weights
    count = problem.features.shape[-1]
    weights, before, best = problem.with_features(starts, 1), 1, (float("inf"), 1, starts[:1])
    last = problem.basis.n_trend if start.by_evidence else count
    for order in dict.fromkeys([1, *range(problem.basis.n_trend, last + 1)]):
        limited = problem.truncated(order)
        tried = problem.truncated(before).with_features(weights, order)
        tried = torch.cat([tried, *(revive(limited, start[None]) for start in tried)])
        if start.filtered is not None:
            tried = torch.cat([robust_start(limited, start.filtered), tried])
        tried = levenberg_marquardt(limited, tried, config, until_still(_NEARLY), by_diagonal=True)
        losses = limited.loss(tried)[:, 0].nan_to_num(float("inf"))
        weights, before = tried[_distinct(losses.tolist())], order
        criterion = float(losses.min()) ** 2 * limited.readings.size + AKAIKE * limited.n_fitted
        if criterion < best[0] - TIE:  # a tie stays with fewer
            best = (criterion, order, limited.with_features(weights[:1], count))
        elif order >= best[1] + _LOOK_AHEAD:
            break
    if start.by_evidence:
        return problem, best[2]
    kept = (torch.arange(count) < best[1]).repeat(len(problem.active), 1)
    return replace(problem, kept=kept), best[2]


def revive(problem: OutputError, weights: torch.Tensor) -> torch.Tensor:
    """(0 or 1, 1, Z) the weights (1, 1, Z) with collapsed unknowns put back to their guess; none is collapsed: 0.

    What must be positive is an exponential: once it has all but vanished, nothing draws it back.
    """
    import torch

    values, active = problem.unknowns(weights)[0][0].abs().median(dim=0).values, problem.active  # (A,)
    positive = torch.tensor([problem.model.positive[u] for _, u in active])
    gone = positive & (values < COLLAPSED * torch.stack([problem.scale[m, 0, u] for m, u in active]))
    if not gone.any():
        return weights[:0]
    revived, outer = weights.clone(), problem.places.coefficients
    revived[..., outer] = (weights[0, 0, outer].unflatten(-1, (len(active), -1)) * ~gone[:, None]).flatten()
    return revived


def _distinct(losses: list[float]) -> list[int]:
    """The best few that lie in valleys of their own, the best first; of equals the one that was given first."""
    kept: list[int] = []
    rest = sorted(range(len(losses)), key=lambda i: losses[i])
    while rest and len(kept) < _KEPT_STARTS:
        lowest = losses[rest[0]]
        kept.append(min(i for i in rest if losses[i] <= lowest * (1 + _EQUAL)))
        rest = [i for i in rest if losses[i] > lowest * (1 + _SAME_VALLEY)]
    return kept
