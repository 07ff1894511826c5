"""Many fits of one machine under other noise, in one batch.

They start at the fit of the data at hand, keep its weights and its choice of features, and differ in the noise alone:
their spread is that of the parametrisation, to be held against its Cramer-Rao bound.

Legend: G data sets, S speeds, P channels, R runs, A unknowns, Z weights.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from pipeline.config.identification import LevenbergMarquardtConfig
from pipeline.errors import ConfigError
from pipeline.identification.optimizers import levenberg_marquardt, until_still
from pipeline.identification.output_error import OutputError
from pipeline.identification.output_error_fit import OutputErrorFit, unknown_deviation

if TYPE_CHECKING:
    import torch

_CHUNK = 25
"""Data sets in one batch: more do not fit the processor's cache."""


@dataclass(frozen=True, eq=False)
class MonteCarlo:
    """The fits of all data sets."""

    problem: OutputError
    weights: torch.Tensor  # (G, 1, Z)

    def unknowns(self) -> np.ndarray:
        """(G, S, A) N/m and N s/m."""
        return np.asarray(self.problem.unknowns(self.weights)[0].numpy())

    def deviations(self) -> np.ndarray:
        """(G, S, A) the standard deviations that each fit states."""
        return np.concatenate([unknown_deviation(self.problem, part) for part in self.weights.split(_CHUNK)])


def monte_carlo(
    fit: OutputErrorFit,
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
    problem, start = fit.problem.to(device), fit.weights.to(device)
    kept = clean[fit.start.keep]
    deviation = fit.start.measurement.deviation_of(kept, None, fit.factor)
    answers = []
    for first in range(0, count, _CHUNK):
        n = min(_CHUNK, count - first)
        parts = generator.standard_normal((2, n, *kept.shape)) / np.sqrt(2.0)
        noisy = kept + deviation * (parts[0] + 1j * parts[1])
        with torch.device(device):
            readings = [torch.as_tensor(noisy[..., block.runs]).to(device) for block in problem.sensors.blocks]
            own = problem.with_sensors(problem.sensors.with_measured(readings))
            found = levenberg_marquardt(own, start.repeat(n, 1, 1), config, until_still())
        answers.append(found.cpu())
    return MonteCarlo(fit.problem, torch.cat(answers))
