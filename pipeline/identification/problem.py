"""The least-squares problem that training minimises: rows and Jacobian as functions of the parameters.

The residual of each bearing and speed is linear in its U unknown coefficients, ``A p + y``. A QR
factorisation of A, done once, leaves U rows a speed with the same norm up to a constant, so a training step
costs the same for any number of nodes and of runs; where the coefficients are the same at every
speed, all speeds together leave U rows.

Legend: G guesses or seeds, M members trained independently (the bearings, or 1 where they are tied), B
bearings, N speeds, U unknowns, P parameters.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np

from pipeline.equations.bearing_equations import BearingEquations, UnknownSystem
from pipeline.identification.coefficient_model import CoefficientModel

if TYPE_CHECKING:
    import torch


@dataclass(frozen=True, eq=False)
class ResidualProblem:
    """``rows = R p(parameters) + y`` with ``loss^2 = |rows|^2 + rest``."""

    model: CoefficientModel
    inputs: torch.Tensor  # (N, 1)
    matrix: torch.Tensor  # R, (B, N, U, U)
    offset: torch.Tensor  # y, (B, N, U)
    rest: torch.Tensor  # (B,) the part of the squared loss that no coefficient can change
    scale: torch.Tensor  # (M, 1, U)

    def rows(self, parameters: torch.Tensor) -> torch.Tensor:
        """(G, M, rows) from parameters (G, M, P)."""
        coefficients = self.model.physical(self.model.raw(parameters, self.inputs), self.scale)
        residual = (self.matrix @ coefficients[..., None])[..., 0] + self.offset  # (G, B, N, U); tied members broadcast
        return residual.reshape(len(parameters), len(self.scale), -1)

    def jacobian(self, parameters: torch.Tensor) -> torch.Tensor:
        """(G, M, rows, P) derivative of :meth:`rows`."""
        raw = self.model.raw(parameters, self.inputs)
        slope = self.model.physical_slope(raw, self.scale)[..., None]  # (G, M, N, U, 1)
        derivative = self.model.raw_jacobian(parameters, self.inputs) * slope
        return (self.matrix @ derivative).reshape(len(parameters), len(self.scale), -1, parameters.shape[-1])

    def loss(self, parameters: torch.Tensor) -> torch.Tensor:
        """(G, M) root mean square of the residual over speeds, runs and directions.

        The paper's ``|r|_2`` divided by the root of the number of its elements.
        """
        return (self.rows(parameters).square().sum(-1) + self._member_rest()).sqrt()

    def _member_rest(self) -> torch.Tensor:
        return self.rest if len(self.scale) == len(self.rest) else self.rest.sum()[None]

    def member(self, m: int) -> ResidualProblem:
        """The problem of one member by itself."""
        own = slice(m, m + 1) if len(self.scale) == len(self.rest) else slice(None)
        return ResidualProblem(
            self.model, self.inputs, self.matrix[own], self.offset[own], self.rest[own], self.scale[m : m + 1]
        )


def residual_problem(
    model: CoefficientModel,
    equations: BearingEquations,
    system: UnknownSystem,
    keep: np.ndarray,
    scaling: np.ndarray,
) -> ResidualProblem:
    """The problem at the speeds ``keep`` (mask), each speed's rows multiplied by ``scaling`` (B, S)."""
    import torch

    weight = scaling[:, keep, None]
    matrix, offset = system.matrix[:, keep] * weight[..., None], system.offset[:, keep] * weight
    members = len(model.scale)
    n_rows = offset[0].size if members == len(offset) else offset.size
    matrix, offset = matrix / np.sqrt(n_rows), offset / np.sqrt(n_rows)
    speeds = equations.speeds[keep]
    if model.hidden is None:
        n_bearings, n_unknowns = len(offset), len(system.unknowns)
        matrix, offset = matrix.reshape(n_bearings, 1, -1, n_unknowns), offset.reshape(n_bearings, 1, -1)
        speeds = speeds[:1]
    orthogonal, triangular = np.linalg.qr(matrix)
    reduced = np.einsum("bsru,bsr->bsu", orthogonal, offset)
    unreachable = offset - np.einsum("bsru,bsu->bsr", orthogonal, reduced)
    return ResidualProblem(
        model,
        model.scaled_inputs(speeds),
        torch.as_tensor(triangular),
        torch.as_tensor(reduced),
        torch.as_tensor((unreachable**2).sum(axis=(1, 2))),
        model.scale_tensor(),
    )


def speed_scaling(scaling: Literal["per_speed", "none"], equations: BearingEquations) -> np.ndarray:
    """(B, S) factors of the residual in 1/N: one over the size of the bearing force at each speed, or one.

    Unbalance grows with the square of the speed; unscaled, the fastest speeds outweigh the slowest by
    orders of magnitude.
    """
    size = np.sqrt((np.abs(equations.free_residual) ** 2).mean(axis=(2, 3)))
    return np.ones_like(size) if scaling == "none" else 1.0 / size


def data_scale(system: UnknownSystem, members: int) -> np.ndarray:
    """(M, U) a size for every coefficient, from the data: bearing force over what a unit coefficient gives."""
    force = np.linalg.norm(system.offset, axis=2)[..., None]  # (B, S, 1)
    unit = np.linalg.norm(system.matrix, axis=2)  # (B, S, U)
    size = np.median(force / unit, axis=1)
    return size if members == len(size) else size.mean(axis=0, keepdims=True)
