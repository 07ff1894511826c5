"""An orthonormal basis of what the output layer of a coefficient model is linear in, the smoothest first.

Legend: M members, S speeds, F features (hidden units or fixed functions, trend and 1), K functions of the basis, U
unknowns, Q parameters.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from pipeline.identification.model import CoefficientModel

if TYPE_CHECKING:
    import torch

BEYOND_CONSTANT = 1.0
"""Standard deviation of a coefficient from a constant, of outputs, where there is no trend."""


@dataclass(frozen=True, eq=False)
class Basis:
    """Output weights ``W = weights z`` for which the features at the training speeds are orthonormal."""

    model: CoefficientModel
    parameters: torch.Tensor  # (M, Q) of the model, whose hidden layers are kept
    weights: torch.Tensor  # (M, F, K)
    n_trend: int  # the first so many are the constant and the trend

    @property
    def n_features(self) -> int:
        """K."""
        return self.weights.shape[-1]

    def at(self, points: Mapping[str, np.ndarray]) -> torch.Tensor:
        """(M, S, K) the basis at ``points``: name -> (S,), the speed in rad/s."""
        return self.model.features(self.parameters, self.model.scaled_inputs(points)) @ self.weights

    def prior_precision(self, n_speeds: int, beyond_trend: float) -> torch.Tensor:
        """(K,) of the weights: a coefficient deviates from its trend by ``beyond_trend``, as normal with mean zero.

        Features are orthonormal over ``n_speeds``: weights of variance v make outputs of variance v K / S.
        """
        import torch

        spread = beyond_trend if self.model.trend else BEYOND_CONSTANT
        count = self.n_features - self.n_trend
        precision = torch.zeros(self.n_features, dtype=torch.float64)
        precision[self.n_trend :] = count / (n_speeds * spread**2)
        return precision

    def parameters_of(self, coordinates: torch.Tensor) -> torch.Tensor:
        """(G, M, Q) all parameters of the model, from ``coordinates`` (G, M, U, K)."""
        import torch

        output = (self.weights @ coordinates.mT).flatten(-2)  # (G, M, F U)
        hidden = self.parameters[:, : self.parameters.shape[1] - output.shape[-1]]
        return torch.cat([hidden.expand(len(output), *hidden.shape), output], dim=-1)


def orthonormal_basis(model: CoefficientModel, parameters: torch.Tensor, points: Mapping[str, np.ndarray]) -> Basis:
    """The basis for training at ``points``: name -> (S,), the speed in rad/s.

    First the constant and the trend, then the combinations of hidden units that vary most beside them: broad units
    overlap, so these are the smooth ones. Combinations that hardly vary are left out.
    """
    import torch

    features = model.features(parameters, model.scaled_inputs(points))
    count = 1 + model.n_trend
    hidden, trend = features[..., :-count], features[..., -count:]
    first, from_trend = _orthonormal(trend)
    projection = first.mT @ hidden
    _, from_hidden = _orthonormal(hidden - first @ projection)
    weights = torch.cat(
        [
            torch.cat([torch.zeros(*hidden.shape[::2], first.shape[-1], dtype=hidden.dtype), from_hidden], dim=-1),
            torch.cat([from_trend, -from_trend @ projection @ from_hidden], dim=-1),
        ],
        dim=1,
    )
    return Basis(model, parameters, weights, first.shape[-1])


def _orthonormal(columns: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """(M, S, K) orthonormal combinations of ``columns`` (M, S, F), the largest first, and the weights (M, F, K)."""
    import torch

    left, singular, right = torch.linalg.svd(columns, full_matrices=False)
    count = int((singular > _NEGLIGIBLE * singular[:, :1]).all(dim=0).sum())
    return left[..., :count], (right.mT / singular[:, None])[..., :count]


_NEGLIGIBLE = 1e-6
"""Combinations smaller than this share of the largest need output weights that cancel to so many digits."""
