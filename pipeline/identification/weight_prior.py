"""What is known of the weights of :mod:`pipeline.identification.output_error` before the data, as whitened rows.

Each weight has a prior about zero of its own precision. With ``guess.within`` each coefficient's mean over the speeds
has one more about its guess.

Legend: G data sets or starts, M members, A active unknowns, K features, U unknowns, Z weights, of which the A K of the
coefficients come first.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from pipeline.identification.model import CoefficientModel
from pipeline.problem.measurement import Measurement

if TYPE_CHECKING:
    import torch


@dataclass(frozen=True, eq=False)
class SizePrior:
    """A row a coefficient: its mean output over the speeds, over the prior deviation of it."""

    rows: torch.Tensor  # (A, K)
    aims: torch.Tensor  # (A,) the guess, over the same

    def deviations(self, weights: torch.Tensor) -> torch.Tensor:
        """(G, A) whitened, of the weights (G, Z)."""
        own: torch.Tensor = (weights[:, : self.rows.numel()].unflatten(-1, self.rows.shape) * self.rows).sum(-1)
        return own - self.aims

    def gradient(self, weights: torch.Tensor) -> torch.Tensor:
        """(G, A K) half the derivative of the squares."""
        return (self.deviations(weights)[..., None] * self.rows).flatten(1)

    def slopes(self) -> torch.Tensor:
        """(A, A K) derivative of the deviations."""
        import torch

        slopes: torch.Tensor = torch.block_diag(*self.rows)
        return slopes


def size_prior(
    measurement: Measurement, model: CoefficientModel, scale: torch.Tensor, features: torch.Tensor
) -> SizePrior | None:
    """The prior of the coefficients' sizes; None without ``guess.within``.

    Its deviation is the logarithm of ``guess.within`` for what must be positive, and that many guesses otherwise.
    ``scale`` (M, 1, U) is what outputs are multiplied by, ``features`` (A, S, K) zero where one is not kept.
    """
    import torch

    guess, unknowns, rows, aims = measurement.guess, measurement.unknowns, [], []
    if guess.within is None:
        return None
    sizes = guess.sizes(unknowns)
    for feature, (m, u) in zip(features, unknowns.active, strict=True):
        positive = model.positive[u]
        share = float(sizes[m, u] / scale[m, 0, u])
        deviation = np.log(guess.within) if positive else guess.within * share
        rows.append(feature.mean(0) / deviation)
        aims.append(np.log(share) / deviation if positive else 0.0)
    return SizePrior(torch.stack(rows), torch.tensor(aims, dtype=rows[0].dtype))


@dataclass(frozen=True, eq=False)
class WeightPrior:
    """The priors of all weights."""

    precision: torch.Tensor  # (Z,) of each weight by itself; 0 for none
    sizes: SizePrior | None

    def rows(self, weights: torch.Tensor) -> torch.Tensor:
        """(G, Z + A or Z) whitened deviations of the weights (G, Z), those of the coefficients' sizes at the end."""
        import torch

        own = self.precision.sqrt() * weights
        return own if self.sizes is None else torch.cat([own, self.sizes.deviations(weights)], dim=-1)

    def slopes(self) -> torch.Tensor:
        """(Z + A or Z, Z) derivative of the rows."""
        import torch

        own = torch.diag(self.precision.sqrt())
        if self.sizes is None:
            return own
        of_sizes = self.sizes.slopes()
        beside = len(own) - of_sizes.shape[-1]
        return torch.cat([own, torch.nn.functional.pad(of_sizes, (0, beside))])

    def gradient(self, weights: torch.Tensor) -> torch.Tensor:
        """(G, Z) half the derivative of the squared rows."""
        gradient = self.precision * weights
        if self.sizes is not None:
            gradient[:, : self.sizes.rows.numel()] += self.sizes.gradient(weights)
        return gradient

    def matrix(self) -> torch.Tensor:
        """(Z, Z) information of all priors together."""
        import torch

        matrix = torch.diag(self.precision)
        if self.sizes is not None:
            slopes, count = self.sizes.slopes(), self.sizes.rows.numel()
            matrix[:count, :count] += slopes.T @ slopes
        return matrix
