"""How large a network's correction of bearing laws is: as large as the data say, for each coefficient by itself.

The correction is a sum of features whose weights are normal about zero: a Gaussian process of variance sigma^2 over the
data (each feature has its share of it: the wavy ones little). sigma is that of the greatest likelihood (empirical
Bayes; by MacKay's fixed point, 1992). Where the law is right it goes to zero and nothing is corrected; its size is the
evidence against the law. Where nobody measured, the correction is zero, and uncertain by sigma.

Legend: M members, S operating points, A active unknowns, K features, Z weights.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from pipeline.identification.basis import Basis
from pipeline.identification.information import invert
from pipeline.identification.output_error import OutputError

if TYPE_CHECKING:
    import torch

_FIRST = 0.1
"""sigma of the start: an output of 0.1 changes a coefficient by ten percent."""
_SMALLEST = 1e-4
"""A correction of a hundredth of a percent is none."""
_ROUNDS, _STILL = 60, 1e-2


def add_beyond(basis: Basis) -> Basis:
    """The basis with one more function: what nobody measured, which is zero at the data and one far from them."""
    import torch

    beyond = torch.zeros_like(basis.weights[..., :1])
    beyond[:, -2] = 1.0  # the output layer's own input for it, before the bias
    return replace(basis, weights=torch.cat([basis.weights, beyond], dim=-1), n_trend=0)


def unit_precision(problem: OutputError) -> torch.Tensor:
    """(A, K) precisions of the weights for a sigma of one."""
    import torch

    own = problem.basis.weights[[m for m, _ in problem.active]]  # (A, F, K)
    share = own.square().sum(1).reciprocal()  # squared size of a feature over the data, for weights of equal variance
    share[:, -1] = 0.0
    variance = share / share.sum(1, keepdim=True) * problem.features.shape[1]
    variance[:, -1] = 1.0
    return variance.clamp(min=torch.finfo(own.dtype).tiny).reciprocal()


def with_sigma(problem: OutputError, sigma: np.ndarray | None = None) -> OutputError:
    """The problem with a correction of ``sigma`` (A,), outputs; that of the start where none is given."""
    import torch

    every = torch.full((len(problem.active),), _FIRST) if sigma is None else torch.as_tensor(sigma)
    return replace(problem, prior=unit_precision(problem) / every.to(torch.float64)[:, None] ** 2)


def likely_sigma(problem: OutputError, weights: torch.Tensor) -> np.ndarray:
    """(A,) sigma of the greatest likelihood, the readings being linear in the weights (1, 1, Z) about their minimum."""
    import torch

    unit = unit_precision(problem).numpy()
    outer = problem.n_outer
    gradient, matrix = (one[0, 0].numpy() for one in problem.normal(weights))
    before = problem.weight_prior.precision.numpy()
    at = weights[0, 0].numpy()
    data = matrix - np.diag(before)  # the readings' own information, and the priors' of all that is not the correction
    right = matrix @ at - gradient  # of the minimum: ``matrix z = right``, whatever the precisions of the correction
    rest = np.concatenate([np.zeros(outer), before[outer:]])
    sigma = np.sqrt((unit / before[:outer].reshape(unit.shape))[:, 0])
    for _ in range(_ROUNDS):
        precision = (unit / sigma[:, None] ** 2).ravel()
        spread = invert(torch.as_tensor(data + np.diag(rest + np.pad(precision, (0, len(rest) - outer)))))
        mean = spread @ right
        # How many of an unknown's weights the readings determine.
        told = (1.0 - precision * np.diag(spread)[:outer]).reshape(unit.shape).sum(axis=1)
        squares = (mean[:outer] ** 2 * unit.ravel()).reshape(unit.shape).sum(axis=1)
        found = np.sqrt(np.maximum(squares / np.maximum(told, 1e-12), _SMALLEST**2))
        still = bool((np.abs(np.log(found / sigma)) < _STILL).all())
        sigma = np.maximum(found, _SMALLEST)
        if still:
            break
    return sigma
