"""The blocks of unknowns that are fitted together, one after the other in a flat vector, and their priors.

Legend: G data sets or starts, Z weights, N rows of priors.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import torch


@dataclass(frozen=True)
class Places:
    """Where each block lies among the weights; one that is not there has the size 0."""

    n_coefficients: int  # weights of the coefficients' functions, or of networks
    n_numbers: int = 0  # of bearing laws
    n_planes: int = 0  # of residual unbalance: two parts each
    n_parameters: int = 0  # uncertain numbers of rotor, weights and probes

    @property
    def coefficients(self) -> slice:
        """The weights of what coefficients are functions of."""
        return slice(0, self.n_coefficients)

    @property
    def numbers(self) -> slice:
        """Theta: numbers of bearing laws, as logarithms over their guesses."""
        return slice(self.n_coefficients, self.n_coefficients + self.n_numbers)

    @property
    def planes(self) -> slice:
        """Real and imaginary part of each plane's residual unbalance."""
        return slice(self.numbers.stop, self.numbers.stop + 2 * self.n_planes)

    @property
    def parameters(self) -> slice:
        """Model parameters, in prior deviations."""
        return slice(self.planes.stop, self.size)

    @property
    def n_rest(self) -> int:
        """How many follow the coefficients' weights."""
        return self.n_numbers + 2 * self.n_planes + self.n_parameters

    @property
    def size(self) -> int:
        """Z."""
        return self.n_coefficients + self.n_rest


@dataclass(frozen=True, eq=False)
class Prior:
    """What is known before the data, as whitened rows: ``rows z - aims`` has unit variance."""

    rows: torch.Tensor  # (N, Z)
    aims: torch.Tensor  # (N,) or (G, N)

    def deviations(self, weights: torch.Tensor) -> torch.Tensor:
        """(G, N) of the weights (G, Z)."""
        return weights @ self.rows.T - self.aims

    def gradient(self, weights: torch.Tensor) -> torch.Tensor:
        """(G, Z) half the derivative of the squares."""
        return self.deviations(weights) @ self.rows

    def information(self) -> torch.Tensor:
        """(Z, Z)."""
        return self.rows.T @ self.rows
