"""The output error of networks all of whose weights are trained: the same problem, with other columns.

Legend: G networks, M members (bearings, or 1 where they share their coefficients), Q parameters of a member, S speeds,
A unknowns that members have, N balance planes, T model parameters, Y = M Q + 2 N + T numbers.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from pipeline.identification.blocks import Prior
from pipeline.identification.model import CoefficientModel
from pipeline.identification.problem import OutputError

if TYPE_CHECKING:
    import torch


def start_networks(
    model: CoefficientModel,
    guess: np.ndarray,
    generator: torch.Generator,
    inputs: torch.Tensor,
    values: torch.Tensor,
    rest: torch.Tensor,
) -> torch.Tensor:
    """(G, 1, Y) networks of new hidden units, near the coefficients ``values`` (G, M, S, U) at scaled ``inputs``
    (S, 1), and the ``rest`` (G, 1, Y - M Q) of the numbers.

    Hidden units are drawn by the ``generator``, for networks that start at the ``guess`` (M, U).
    """
    import torch

    networks = [
        model.with_output_at(model.spread_parameters(guess, generator), inputs, value).flatten() for value in values
    ]
    return torch.cat([torch.stack(networks)[:, None], rest], dim=-1)


@dataclass(frozen=True, eq=False, kw_only=True)
class TrainedNetworks(OutputError):
    """Least squares of numbers (G, 1, Y): parameters of the members, residual unbalance, model parameters.

    Each of the G networks may weigh the readings by precisions of its own.
    """

    inputs: torch.Tensor  # (S, 1), scaled
    known: Prior  # of the numbers
    nodes: torch.Tensor  # (K, 1) scaled inputs at which the prior of functions holds, if there is one

    def _n_coefficients(self) -> int:
        return len(self.scale) * self.model.n_parameters

    def fitted(self) -> torch.Tensor:
        """(Y,) bool: all of them."""
        import torch

        return torch.ones(self.size, dtype=torch.bool)

    @cached_property
    def prior(self) -> Prior:
        """What is known of the numbers; what is known of the functions is not linear in them."""
        return self.known

    def rows(self, weights: torch.Tensor) -> torch.Tensor:
        """(G, 1, rows + N), those of the prior of functions last."""
        import torch

        return torch.cat([super().rows(weights), self.deviate(weights)[:, None]], dim=-1)

    def normal(self, weights: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Gradient (G, 1, Y) and information (G, 1, Y, Y)."""
        import torch

        (gradient, matrix), slopes = super().normal(weights), self._slopes(weights, self.nodes)
        by_networks = self.functions.rows @ slopes.movedim(1, 2).flatten(1, 2)
        slope = torch.nn.functional.pad(by_networks, (0, self.places.n_rest))
        more = self.deviate(weights)[:, None] @ slope
        return gradient + more, matrix + (slope.mT @ slope)[:, None]

    def _slopes(self, weights: torch.Tensor, inputs: torch.Tensor) -> torch.Tensor:
        """(G, S, A, M Q) derivative of the active outputs by the networks' parameters: zero but for their own."""
        jacobian = self.model.raw_jacobian(self.networks(weights), inputs)  # (G, M, S, U, Q)
        shape = (len(weights), len(inputs), len(self.active), jacobian.shape[1], jacobian.shape[-1])
        slopes = jacobian.new_zeros(shape)
        for a, (m, u) in enumerate(self.active):
            slopes[:, :, a, m] = jacobian[:, m, :, u]
        return slopes.flatten(-2)

    def deviate(self, weights: torch.Tensor) -> torch.Tensor:
        """(G, N) of the networks' values at the nodes from the prior of functions."""
        import torch

        values = self.model.raw(self.networks(weights), self.nodes)  # (G, M, K, U)
        every = torch.stack([values[:, m, :, u] for m, u in self.active], dim=1).flatten(1)
        return self.functions.deviations(every)

    def networks(self, numbers: torch.Tensor) -> torch.Tensor:
        """(G, M, Q) parameters of the coefficient model."""
        import torch

        return torch.unflatten(numbers[:, 0, self.places.coefficients], -1, (len(self.scale), -1))

    def outputs(self, weights: torch.Tensor) -> torch.Tensor:
        """(G, M, S, U) outputs of the networks."""
        return self.model.raw(self.networks(weights), self.inputs)

    def _spread(self, local: torch.Tensor, weights: torch.Tensor) -> torch.Tensor:
        """Of networks a speed has many columns, so they are summed up at once."""
        import torch

        slopes, n_active, outer = self._slopes(weights, self.inputs), len(self.active), self.places.n_coefficients
        whole = torch.zeros(len(local), self.size + 1, self.size + 1, dtype=local.dtype)
        by_slopes = slopes.flatten(1, 2).mT @ torch.cat(
            [local[:, :, :n_active, :n_active] @ slopes, local[:, :, :n_active, n_active:]], dim=-1
        ).flatten(1, 2)
        whole[:, :outer], whole[:, outer:, :outer] = by_slopes, by_slopes[..., outer:].mT
        whole[:, outer:, outer:] = local[:, :, n_active:, n_active:].sum(1)
        return whole
