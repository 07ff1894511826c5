"""What tolerances that are not fitted do to the answer: the mean square of what they move the weights by.

Readings that a tolerance would change as no weight can leave it less room. It is as if all tolerances u (of unit
variance) were fitted with the weights z: with the information ``H`` of both, u has the covariance
``(1 + H_uu - H_uz H_zz^-1 H_zu)^-1`` and a mean, and z moves by ``-H_zz^-1 H_zu u``.

Legend: Z weights, L local functions, T tolerances, kinds of which are named in :data:`USUAL`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from pipeline.identification.information import invert_information
from pipeline.identification.problem import OutputError
from pipeline.identification.sensor_model import sensor_model
from pipeline.problem.model_parameters import USUAL

if TYPE_CHECKING:
    import torch


@dataclass(frozen=True, eq=False)
class Unfitted:
    """What is known of the tolerances after the fit, and how the weights follow them."""

    kinds: np.ndarray  # (T,) places of the kinds in USUAL
    moves: np.ndarray  # (Z + A L, T) of the weights by one deviation of each
    second: np.ndarray  # (T, T) mean square of the tolerances, in their deviations

    def covariance(self) -> np.ndarray:
        """(Z + A L, Z + A L) mean square of what they move."""
        return np.asarray(self.moves @ self.second @ self.moves.T)

    def select(self, name: str) -> Unfitted:
        """Those of one kind."""
        chosen = self.kinds == list(USUAL).index(name)
        return Unfitted(self.kinds[chosen], self.moves[:, chosen], self.second[np.ix_(chosen, chosen)])

    @property
    def names(self) -> list[str]:
        """Their kinds, each once."""
        return [name for k, name in enumerate(USUAL) if (self.kinds == k).any()]


def widen(problem: OutputError, weights: torch.Tensor) -> tuple[OutputError, torch.Tensor]:
    """The problem with the tolerances among the model parameters, and its weights (1, 1, Z + T)."""
    import torch

    count = len(problem.measurement.tolerances)
    if not count:
        return problem, weights
    wider = replace(problem, sensors=sensor_model(problem.measurement.with_tolerances()))
    return wider, torch.nn.functional.pad(weights, (0, count))


def measure_tolerances(problem: OutputError, weights: torch.Tensor, places: np.ndarray, size: int) -> Unfitted:
    """What the tolerances of the measurement do at the minimum ``weights`` (1, 1, Z).

    Args:
        places: (Z,) where the weights lie among the ``size`` ones of the answer.
    """
    tolerances, count = problem.measurement.tolerances, problem.size
    kinds = np.array([list(USUAL).index(tolerance.kind) for tolerance in tolerances], dtype=np.int64)
    moves = np.zeros((size, len(tolerances)))
    if not tolerances:
        return Unfitted(kinds, moves, np.zeros((0, 0)))
    wider, padded = widen(problem, weights)
    gradient, matrix = (array[0, 0].numpy() for array in wider.normal(padded))
    identity = np.eye(len(tolerances))
    by_fit = invert_information(problem, weights)[0] @ matrix[:count, count:]
    room = matrix[count:, count:] - identity - matrix[count:, :count] @ by_fit  # the prior is in the matrix
    score = by_fit.T @ gradient[:count] - gradient[count:]
    spread = np.linalg.inv(identity + room)
    mean = spread @ score
    moves[places] = -by_fit
    return Unfitted(kinds, moves, spread + np.outer(mean, mean))
