"""Weighted linear least squares of the residual, in a model's features: a start that needs no guess.

And the weights of a problem that come nearest to coefficients that are known roughly.

Legend: S speeds, M members, U unknowns, A those of them that members have, K features, Z weights.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from pipeline.identification.problem import OutputError
from pipeline.impedance import list_places, to_coordinates
from pipeline.problem.expansion import expand
from pipeline.problem.measurement import Measurement
from pipeline.problem.noise import whiten
from pipeline.problem.residual import LinearResidual, linear_residual

if TYPE_CHECKING:
    import torch


def linear_start(training: Measurement, features: np.ndarray, scale: np.ndarray, rounds: int = 3) -> np.ndarray | None:
    """Unknowns (M, S, U) as combinations of the ``features`` (M, S, K); None for too few sensors.

    ``scale`` (M, U) are sizes of the unknowns, N/m and N s/m. The noise of the residual depends on the coefficients: in
    so many ``rounds`` the weights are made again.
    """
    less = training.subtract_unbalance()
    expansion = expand(less.response, less.dataset.displacement, less.deviation)
    if expansion is None:
        return None
    residual = linear_residual(expansion.equations, less.unknowns, less.known)
    covariance, values = expansion.force_covariance, None
    for _ in range(rounds):
        values = _combine(whiten(residual, covariance), features, scale)
        covariance = expansion.residual_covariance(less.response, less.table(values))
    return values


def _combine(
    white: LinearResidual,
    features: np.ndarray,
    scale: np.ndarray,
    rounds: int = 3,
    outlier: float = 3.0,
    tiny: float = 1e-300,
) -> np.ndarray:
    """(M, S, U) least squares of ``A (Phi a) + y``, robust: rows beyond ``outlier`` standard deviations count less."""
    members, n_speeds, _, n_unknowns = white.matrix.shape
    values = np.zeros((members, n_speeds, n_unknowns))
    for m in range(members):
        present = white.unknowns.present[m]
        matrix = white.matrix[m][..., present] * scale[m, present]
        weight = np.ones(matrix.shape[:2])
        for _ in range(rounds):
            rows = np.einsum("sru,sk->sruk", matrix * weight[..., None], features[m])
            flat = rows.reshape(-1, rows.shape[2] * rows.shape[3])
            solution = np.linalg.lstsq(flat, -(white.offset[m] * weight).ravel(), rcond=1e-10)[0]
            outputs = features[m] @ solution.reshape(rows.shape[2], rows.shape[3]).T
            rest = np.einsum("sru,su->sr", matrix, outputs) + white.offset[m]
            # A normal value's median modulus is 0.6745 of its deviation.
            size = outlier * max(np.median(np.abs(rest)) / 0.6745, tiny)
            weight = np.sqrt(np.minimum(1.0, size / np.maximum(np.abs(rest), tiny)))
        values[m][:, present] = outputs * scale[m, present]
    return values


# --- weights near given coefficients -------------------------------------------------------------------


def start_at(problem: OutputError, values: np.ndarray) -> torch.Tensor:
    """(1, 1, Z) the weights that come nearest to unknowns (M, S, U), without residual unbalance, of the stated model.

    ``problem`` is that of the training speeds, where the features are orthonormal: their coordinates are projections.
    """
    import torch

    raw = _outputs(problem, values)
    coordinates = torch.stack([problem.features[m].T @ raw[m, :, u] for m, u in problem.active])  # (A, K)
    kept = (coordinates * problem.kept).flatten()
    return problem.weigh(coefficients=kept, parameters=problem.sensors.solved_at)


def robust_start(problem: OutputError, values: np.ndarray, rounds: int = 20, smallest: float = 1e-12) -> torch.Tensor:
    """As :func:`start_at`, of rough unknowns (M, S, U): single speeds that are far off count less (Huber 1964)."""
    import torch

    raw = _outputs(problem, values)
    rows: list[torch.Tensor] = []
    for m, u in problem.active:
        features, target = problem.features[m], raw[m, :, u]
        weight, solution = torch.ones_like(target), torch.zeros(features.shape[-1], dtype=target.dtype)
        for _ in range(rounds):
            weighted = features * weight[:, None]
            ridge = smallest * torch.eye(len(solution), dtype=target.dtype)
            solution = torch.linalg.solve(features.T @ weighted + ridge, weighted.T @ target)
            off = (target - features @ solution).abs()
            weight = 1 / (off / off.median().clamp(min=smallest)).clamp(min=1.0)
        rows.append(solution * problem.kept[len(rows)])
    return problem.weigh(coefficients=torch.stack(rows).flatten())


def _outputs(problem: OutputError, values: np.ndarray) -> torch.Tensor:
    """(M, S, U) outputs of the model that give unknowns (M, S, U)."""
    import torch

    model = problem.basis.model
    if model.parametrisation != "impedance":
        return model.raw_from(torch.tensor(values), problem.scale)
    eight = problem.measurement.table(values).values
    outputs = to_coordinates(eight, problem.measurement.dataset.speeds)[..., list_places(model.unknowns)]
    return torch.as_tensor(outputs[: len(values)])
