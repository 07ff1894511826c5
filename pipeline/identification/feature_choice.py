"""How many features each unknown gets: as many as the data determine.

A network with few features can't follow the coefficients, one with many follows the noise. The features are nested,
from smooth to wavy, and the last of an unknown are dropped as long as that lowers Akaike's criterion: chi-square grows
by less than 2 for each number less (Akaike 1974). So less noise keeps more of them, and no truth is needed. A tie
goes to fewer features: what a criterion differs by from one processor to another decides nothing.

Legend: A unknowns, K features, Z free numbers.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from pipeline.identification.response_problem import ResponseProblem

if TYPE_CHECKING:
    import torch

AKAIKE = 2.0
"""A number must lower chi-square by this in his criterion; a superfluous one lowers it by 1 on average."""
TIE = 0.01
"""Criteria closer than this are equal: between processors they differ by 1e-7, between the best two choices by 0.3."""


def features_that_count(
    problem: ResponseProblem, free: torch.Tensor, covariance: np.ndarray
) -> tuple[ResponseProblem, torch.Tensor]:
    """The problem with the features that Akaike's criterion keeps, and the free vector (1, 1, Z) to go on from.

    ``free`` (1, 1, Z) is the minimum with all features, ``covariance`` (Z, Z) that of it. Chi-square is taken as
    quadratic there: fixing number i at zero adds z_i^2 / C_ii and moves the others.
    """
    import torch

    n_active, count = problem.kept.shape
    value, spread, criterion = free[0, 0].numpy(), covariance, 0.0
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
