"""Weighted linear least squares of the residual, in a model's features: a start that needs no guess.

Legend: S speeds, M members, U unknowns, K features.
"""

from __future__ import annotations

import numpy as np

from pipeline.problem.expansion import expand
from pipeline.problem.measurement import Measurement
from pipeline.problem.noise import whiten
from pipeline.problem.residual import LinearResidual, linear_residual

_ROUNDS = 3
"""The noise of the residual depends on the coefficients: so often the weights are made again."""
_OUTLIER = 3.0
"""Rows beyond so many standard deviations count less."""


def linear_start(training: Measurement, features: np.ndarray, scale: np.ndarray) -> np.ndarray | None:
    """Unknowns (M, S, U) as combinations of the ``features`` (M, S, K); None for too few sensors.

    ``scale`` (M, U) are sizes of the unknowns, N/m and N s/m.
    """
    less = training.subtract_unbalance()
    expansion = expand(less.response, less.dataset.displacement, less.deviation)
    if expansion is None:
        return None
    residual = linear_residual(expansion.equations, less.unknowns, less.known)
    covariance, values = expansion.force_covariance, None
    for _ in range(_ROUNDS):
        values = _combine(whiten(residual, covariance), features, scale)
        covariance = expansion.residual_covariance(less.response, less.table(values))
    return values


def _combine(white: LinearResidual, features: np.ndarray, scale: np.ndarray) -> np.ndarray:
    """(M, S, U) least squares of ``A (Phi a) + y``, robust against single bad rows."""
    members, n_speeds, _, n_unknowns = white.matrix.shape
    values = np.zeros((members, n_speeds, n_unknowns))
    for m in range(members):
        present = white.unknowns.present[m]
        matrix = white.matrix[m][..., present] * scale[m, present]
        weight = np.ones(matrix.shape[:2])
        for _ in range(_ROUNDS):
            rows = np.einsum("sru,sk->sruk", matrix * weight[..., None], features[m])
            flat = rows.reshape(-1, rows.shape[2] * rows.shape[3])
            solution = np.linalg.lstsq(flat, -(white.offset[m] * weight).ravel(), rcond=_NEGLIGIBLE)[0]
            outputs = features[m] @ solution.reshape(rows.shape[2], rows.shape[3]).T
            rest = np.einsum("sru,su->sr", matrix, outputs) + white.offset[m]
            size = _OUTLIER * max(np.median(np.abs(rest)) / _MEDIAN_OF_NORMAL, _TINY)
            weight = np.sqrt(np.minimum(1.0, size / np.maximum(np.abs(rest), _TINY)))
        values[m][:, present] = outputs * scale[m, present]
    return values


_NEGLIGIBLE = 1e-10
_TINY = 1e-300
_MEDIAN_OF_NORMAL = 0.6745
