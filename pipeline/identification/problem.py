"""The least-squares problem that training minimises: rows and Jacobian as functions of the parameters.

The residual of each bearing and speed is linear in its U unknowns, ``A p + y``. A QR
factorisation of A, done once, leaves U rows a speed with the same norm up to a constant, so a training step
costs the same for any number of nodes and of runs; where the coefficients are the same at every
speed, all speeds together leave U rows.

The preconditioned loss multiplies each speed's rows by the regularised pseudo-inverse of A: they are then the distance
of the unknowns, each relative to its scale, from what that speed by itself says of them. Directions that the orbits
hardly tell apart weigh as much as the others, which the residual all but ignores.

Legend: G guesses or seeds, M members trained independently (the bearings, or 1 where they are tied), B
bearings, N speeds, U unknowns, P parameters.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal, Protocol

import numpy as np

from pipeline.equations.bearing_equations import BearingEquations
from pipeline.equations.unknown_system import UnknownSystem
from pipeline.identification.coefficient_model import CoefficientModel

if TYPE_CHECKING:
    import torch


class LeastSquares(Protocol):
    """What optimisers minimise: the squares of rows of numbers (G, M, P)."""

    def rows(self, parameters: torch.Tensor, /) -> torch.Tensor:
        """(G, M, rows)."""
        ...

    def normal(self, parameters: torch.Tensor, /) -> tuple[torch.Tensor, torch.Tensor]:
        """Gradient J'r (G, M, P) and J'J (G, M, P, P)."""
        ...

    def loss(self, parameters: torch.Tensor, /) -> torch.Tensor:
        """(G, M) a root mean square that falls with the squared rows."""
        ...

    def rounding(self) -> torch.Tensor:
        """(M,) what the rounding of the data may make of a loss of zero: losses below it are equal."""
        ...

    def network(self, parameters: torch.Tensor, /) -> torch.Tensor:
        """(G, M, Q) parameters of the coefficient model."""
        ...

    def member(self, m: int, /) -> LeastSquares:
        """The problem of one member by itself."""
        ...


@dataclass(frozen=True, eq=False)
class ResidualProblem:
    """``rows = R p(parameters) + y`` with ``loss^2 = |rows|^2 + rest``."""

    model: CoefficientModel
    inputs: torch.Tensor  # (N, 1)
    matrix: torch.Tensor  # R, (M, N, U, U)
    offset: torch.Tensor  # y, (M, N, U)
    rest: torch.Tensor  # (M,) the part of the squared loss that no coefficient can change
    scale: torch.Tensor  # (M, 1, U)

    def rows(self, parameters: torch.Tensor) -> torch.Tensor:
        """(G, M, rows) from parameters (G, M, P)."""
        coefficients = self.model.physical(self.model.raw(parameters, self.inputs), self.scale)
        residual = (self.matrix @ coefficients[..., None])[..., 0] + self.offset  # (G, M, N, U)
        return residual.reshape(len(parameters), len(self.scale), -1)

    def jacobian(self, parameters: torch.Tensor) -> torch.Tensor:
        """(G, M, rows, P) derivative of :meth:`rows`."""
        raw = self.model.raw(parameters, self.inputs)
        slope = self.model.physical_slope(raw, self.scale)[..., None]  # (G, M, N, U, 1)
        derivative = self.model.raw_jacobian(parameters, self.inputs) * slope
        return (self.matrix @ derivative).reshape(len(parameters), len(self.scale), -1, parameters.shape[-1])

    def normal(self, parameters: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Gradient J'r (G, M, P) and J'J (G, M, P, P) of the rows."""
        jacobian = self.jacobian(parameters)
        return (jacobian.mT @ self.rows(parameters)[..., None])[..., 0], jacobian.mT @ jacobian

    def network(self, parameters: torch.Tensor) -> torch.Tensor:
        """(G, M, P) parameters of the coefficient model: they are what is trained."""
        return parameters

    def loss(self, parameters: torch.Tensor) -> torch.Tensor:
        """(G, M) root mean square of the residual over speeds, runs and directions.

        The paper's ``|r|_2`` divided by the root of the number of its elements.
        """
        return (self.rows(parameters).square().sum(-1) + self.rest).sqrt()

    def rounding(self) -> torch.Tensor:
        """(M,) the loss that the data round to: that of no bearing force at all, times their precision."""
        return _ROUNDING * (self.offset.square().sum((-2, -1)) + self.rest).sqrt()

    def member(self, m: int) -> ResidualProblem:
        """The problem of one member by itself."""
        own = slice(m, m + 1)
        return ResidualProblem(
            self.model, self.inputs, self.matrix[own], self.offset[own], self.rest[own], self.scale[own]
        )

    def per_speed(self, regularisation: float) -> tuple[np.ndarray, np.ndarray]:
        """The regularised pseudo-inverse of A (M, N, U, U) and the answer of each speed (M, N, U), in scales.

        ``regularisation`` is relative to the largest singular value; what lies below the rounding of the data is left
        out in any case.
        """
        scaled = (self.matrix * self.scale[:, :, None]).numpy()
        left, singular, right = np.linalg.svd(scaled, full_matrices=False)
        largest = singular[..., :1]
        kept = singular > _ROUNDING * largest
        factor = np.where(kept, singular, 0.0) / np.maximum(singular**2 + (regularisation * largest) ** 2, _TINY)
        inverse = np.einsum("mnvu,mnv,mnwv->mnuw", right, factor, left)
        return inverse, -(inverse @ self.offset.numpy()[..., None])[..., 0]

    def preconditioned(self, regularisation: float) -> ResidualProblem:
        """The same unknowns with rows ``A^+ (A p + y)``, a root mean square over speeds and unknowns."""
        import torch

        inverse, answer = self.per_speed(regularisation)
        size = np.sqrt(answer.shape[1] * answer.shape[2])
        return ResidualProblem(
            self.model,
            self.inputs,
            torch.as_tensor(inverse @ self.matrix.numpy() / size),
            torch.as_tensor(-answer / size),
            torch.zeros(len(answer), dtype=torch.float64),
            self.scale,
        )


_ROUNDING = 1e-13
_TINY = np.finfo(float).tiny


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
    weighted = UnknownSystem(
        system.unknowns, system.matrix[:, keep] * weight[..., None], system.offset[:, keep] * weight
    )
    if len(model.scale) < len(weight):
        weighted = weighted.alike()
    n_rows = weighted.offset[0].size
    matrix, offset = weighted.matrix / np.sqrt(n_rows), weighted.offset / np.sqrt(n_rows)
    speeds = equations.speeds[keep]
    if model.hidden is None:
        matrix, offset = matrix.reshape(len(matrix), 1, -1, matrix.shape[-1]), offset.reshape(len(offset), 1, -1)
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
    there = unit > 0  # a bearing may lack an unknown
    size = np.median(np.where(there, force / np.where(there, unit, 1.0), 1.0), axis=1)
    return size if members == len(size) else size.mean(axis=0, keepdims=True)
