"""Chebyshev series of the speed, fitted by linear least squares: what a smooth function can reach, without training."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from pipeline.identification.identified import IdentifiedModel
from pipeline.identification.residual_loss import ResidualProblem, ResidualTraining, prepare_residual
from pipeline.identification.training import FitSetup, held_out_speeds
from pipeline.problem.measurement import Measurement
from pipeline.rotor.bearing_table import BearingTable

if TYPE_CHECKING:
    import torch

_DEGREES = tuple(range(2, 41, 2))


@dataclass(frozen=True, eq=False)
class ChebyshevFit:
    """The series of the degree with the lowest held-out loss."""

    degree: int
    held_out_loss: float
    identified: IdentifiedModel

    def table(self, known: BearingTable) -> BearingTable:
        """All eight coefficients: the identified ones, and the known ones from ``known``."""
        return self.identified.table(known)


def fit_chebyshev(measurement: Measurement, setup: FitSetup) -> ChebyshevFit | None:
    """The Chebyshev series in the scaled speed, of an even degree up to 40, that the held-out speeds like best.

    The coefficients enter the residual linearly, so each degree has one least-squares answer: no start, no
    optimiser, no luck. None for constants, and where no speed is held out.
    """
    if setup.constant or not setup.training.holdout_every:
        return None
    n_speeds = len(measurement.dataset.speeds)
    n_training = n_speeds - int(held_out_speeds(n_speeds, setup.training.holdout_every).sum())
    best: ChebyshevFit | None = None
    for degree in _DEGREES:
        if degree + 1 > n_training:
            break
        training = prepare_residual(measurement, replace(setup, model=setup.model.as_chebyshev(degree), force=True))
        parameters = _solve(training)
        assert training.held_out is not None
        loss = float(training.per_speed_held_out_loss(parameters)[0])
        if best is None or loss < best.held_out_loss:
            best = ChebyshevFit(degree, loss, training.identified(parameters[0]))
    return best


def _solve(training: ResidualTraining) -> torch.Tensor:
    """(1, M, Q) the least squares of each member's rows, which are linear in the parameters."""
    import torch

    return torch.stack([_solve_member(member) for member in training.problem.members()])[None]


def _solve_member(problem: ResidualProblem) -> torch.Tensor:
    """(Q,)."""
    import torch

    zero = torch.zeros(1, 1, problem.model.n_parameters, dtype=torch.float64)
    jacobian, rows = problem.jacobian(zero)[0, 0].numpy(), problem.rows(zero)[0, 0].numpy()
    return torch.as_tensor(np.linalg.lstsq(jacobian, -rows, rcond=1e-15)[0])
