"""Many fits of one machine under other noise, in one batch.

They start at the fit of the data at hand, keep its weights and its choice of features, and differ in the noise alone:
their spread is that of the parametrisation, to be held against its Cramer-Rao bound.

Legend: G data sets, S speeds, P channels, R runs, A unknowns, Z free numbers.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from pipeline.config.identification import LevenbergMarquardtConfig
from pipeline.errors import ConfigError
from pipeline.identification.optimizers import levenberg_marquardt, until_still
from pipeline.identification.response_fit import ResponseFit, unknown_deviation
from pipeline.identification.response_problem import ResponseProblem

if TYPE_CHECKING:
    import torch

_CHUNK = 25
"""Data sets in one batch: more do not fit the processor's cache."""


@dataclass(frozen=True, eq=False)
class MonteCarlo:
    """The fits of all data sets."""

    problem: ResponseProblem
    free: torch.Tensor  # (G, 1, Z)

    def unknowns(self) -> np.ndarray:
        """(G, S, A) N/m and N s/m."""
        return np.asarray(self.problem.unknowns(self.free)[0].numpy())

    def deviations(self) -> np.ndarray:
        """(G, S, A) the standard deviations that each fit states."""
        return np.concatenate([unknown_deviation(self.problem, part) for part in self.free.split(_CHUNK)])


def monte_carlo(
    fit: ResponseFit,
    clean: np.ndarray,
    count: int,
    generator: np.random.Generator,
    config: LevenbergMarquardtConfig,
    device: str = "cpu",
) -> MonteCarlo:
    """Fit ``count`` data sets: the ``clean`` readings (S, P, R), m, each with noise of its own.

    Raises ConfigError for a ``device`` that torch does not find.
    """
    import torch

    if device != "cpu" and not torch.cuda.is_available():
        raise ConfigError(f"device must be one that torch finds, but it finds no '{device}' here: use device=cpu")
    problem, start_free = fit.problem.to(device), fit.free.to(device)
    kept = clean[fit.prepared.keep]
    deviation = fit.prepared.data.deviation_of(kept, None, fit.factor)
    answers = []
    for start in range(0, count, _CHUNK):
        n = min(_CHUNK, count - start)
        parts = generator.standard_normal((2, n, *kept.shape)) / np.sqrt(2.0)
        noisy = kept + deviation * (parts[0] + 1j * parts[1])
        with torch.device(device):
            own = problem.with_measured(
                [torch.as_tensor(noisy[..., block.runs]).to(device) for block in problem.blocks]
            )
            found = levenberg_marquardt(own, start_free.repeat(n, 1, 1), config, until_still())
        answers.append(found.cpu())
    return MonteCarlo(fit.problem, torch.cat(answers))
