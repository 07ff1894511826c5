"""The inverse of the information: the covariance of weights, and of what follows from them.

Legend: G fits, S points, A active unknowns, Z weights.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from pipeline.identification.problem import OutputError

if TYPE_CHECKING:
    import torch


def invert_information(problem: OutputError, weights: torch.Tensor) -> np.ndarray:
    """(G, Z, Z) inverse of the information at the weights (G, 1, Z); zero for those that are not fitted."""
    fitted = problem.fitted().numpy()
    return np.asarray(invert(problem.normal(weights)[1][:, 0]) * (fitted[:, None] & fitted))


def invert(information: torch.Tensor) -> np.ndarray:
    """(.., Z, Z) inverse of (.., Z, Z), whatever the sizes of the weights; large where nothing is known."""
    import torch

    size = information.diagonal(dim1=-2, dim2=-1).clamp(min=1e-300).sqrt()
    scaled = information / size[..., :, None] / size[..., None, :]
    values, vectors = torch.linalg.eigh(scaled)
    values = values.clamp(min=float(np.finfo(float).eps) * 10)
    inverse = (vectors / values[..., None, :]) @ vectors.mT
    return np.asarray((inverse / size[..., :, None] / size[..., None, :]).numpy())


def unknown_deviation(problem: OutputError, weights: torch.Tensor) -> np.ndarray:
    """(G, S, A) standard deviation of the active unknowns, N/m and N s/m, see :func:`invert_information`."""
    spread, count = invert_information(problem, weights), problem.features.shape[-1]
    _, slope, by_numbers = (array.numpy() for array in problem.unknowns(weights))
    places, parts = problem.places, []
    numbers = np.arange(places.numbers.start, places.numbers.stop)
    for a, (m, _) in enumerate(problem.active):
        by_features = problem.features[m].numpy() * slope[..., a, None]  # (G, S, K)
        slopes = np.concatenate([by_features, by_numbers[:, :, a]], axis=-1)
        columns = np.concatenate([np.arange(a * count, (a + 1) * count), numbers])
        parts.append(np.einsum("gsk,gkl,gsl->gs", slopes, spread[:, columns[:, None], columns], slopes, optimize=True))
    return np.asarray(np.sqrt(np.stack(parts, axis=-1)))
