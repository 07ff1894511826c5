"""Chebyshev series of the speed, fitted by linear least squares: what a smooth function can reach, without training."""

from __future__ import annotations

import warnings
from dataclasses import dataclass

import numpy as np

from pipeline.identification.problem import ResidualProblem
from pipeline.identification.training import PreparedTraining
from pipeline.rotor.bearing_table import BearingTable

_DEGREES = tuple(range(2, 41, 2))


@dataclass(frozen=True, eq=False)
class SeriesFit:
    """The series of the degree with the lowest held-out loss."""

    degree: int
    held_out_loss: float
    series: tuple[np.ndarray, ...]  # per member (U, degree + 1), N/m and N s/m
    prepared: PreparedTraining

    def table(self, known: BearingTable) -> BearingTable:
        """All eight coefficients: the identified ones, and the known ones from ``known``."""
        basis = _basis(self.prepared.model.scaled_inputs(known.speeds).numpy(), self.degree)
        values = np.array([basis @ series.T for series in self.series])  # (M, S, U)
        return known.with_unknowns(self.prepared.unknowns, values)


def best_series(prepared: PreparedTraining) -> SeriesFit | None:
    """The Chebyshev series in the scaled speed, of any even degree up to 40, that the held-out speeds like best.

    The coefficients enter the residual linearly, so each degree has one least-squares answer: no start, no
    optimiser, no luck. None for constants, and where no speed is held out.
    """
    if prepared.model.hidden is None or prepared.held_out_per_speed is None:
        return None
    held_out, train = prepared.held_out_per_speed, prepared.train
    assert isinstance(train, ResidualProblem), "the response is not linear in the coefficients"
    members = [(train.member(m), held_out.member(m)) for m in range(len(train.scale))]
    best: SeriesFit | None = None
    for degree in _DEGREES:
        if (degree + 1) > train.matrix.shape[1]:
            break
        fits = [_fit(one, degree) for one, _ in members]
        losses = [_loss(one, fit, degree) for fit, (_, one) in zip(fits, members, strict=True)]
        loss = float(np.sqrt(np.mean(np.square(losses))))
        if best is None or loss < best.held_out_loss:
            best = SeriesFit(degree, loss, tuple(fits), prepared)
    return best


def _basis(inputs: np.ndarray, degree: int) -> np.ndarray:
    return np.polynomial.chebyshev.chebvander(inputs[:, 0], degree)


def _fit(problem: ResidualProblem, degree: int) -> np.ndarray:
    """(U, degree + 1) in N/m and N s/m."""
    scale = problem.scale[0, 0].numpy()
    basis = _basis(problem.inputs.numpy(), degree)
    n_unknowns = len(scale)
    columns = np.einsum("bsru,u,sd->bsrud", problem.matrix.numpy(), scale, basis)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        answer = np.linalg.lstsq(
            columns.reshape(-1, n_unknowns * (degree + 1)), -problem.offset.numpy().ravel(), rcond=1e-15
        )[0]
    return answer.reshape(n_unknowns, degree + 1) * scale[:, None]


def _loss(problem: ResidualProblem, series: np.ndarray, degree: int) -> float:
    values = _basis(problem.inputs.numpy(), degree) @ series.T  # (N, U)
    rows = np.einsum("bsru,su->bsr", problem.matrix.numpy(), values) + problem.offset.numpy()
    return float(np.sqrt((rows**2).sum() + problem.rest.numpy().sum()))
