"""A fit by the output error, linear about its answer: what a run or a probe does to each coefficient.

With readings ``e`` over their noise that the fit leaves, and its derivative ``J`` by the weights z of the coefficients,
leaving a run out moves the weights by ``(N - N_r)^-1 (b - b_r)`` with ``N = 2 Re J^H J`` and ``b = 2 Re J^H e``.

Legend: S speeds, P channels, R runs, B bearings, Z weights, T parameters. SI units.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from pipeline.data.dataset import EVERYWHERE, Excitation
from pipeline.identification.answer import restore
from pipeline.identification.uncertainty import Uncertainty
from pipeline.problem.condition_noise import NO_LEVELS
from pipeline.problem.measurement import Measurement
from pipeline.problem.slopes import deviate


@dataclass(frozen=True, eq=False)
class LinearisedFit:
    """What the fit left over, and how readings and coefficients move with its weights."""

    residual: np.ndarray  # e, (S, P, R) complex, measured less predicted over the noise
    by_weight: np.ndarray  # J, (S, P, R, Z) complex, of the predicted readings over the noise
    coefficients: np.ndarray  # (B, S, 8, Z) derivative of the coefficients by the weights
    prior: np.ndarray  # (Z, Z) information that the fit has without any reading
    fitted: np.ndarray  # (S, P, R) mask of the readings that were fitted

    @cached_property
    def seen(self) -> np.ndarray:
        """(S, P, R, Z) rows of the fitted readings, zero for the others."""
        return np.asarray(self.fitted[..., None] * self.by_weight)

    @cached_property
    def normal(self) -> np.ndarray:
        """N, (Z, Z) of the fitted readings and the priors."""
        return cross(self.seen, self.seen) + self.prior

    @cached_property
    def right(self) -> np.ndarray:
        """b, (Z,)."""
        return cross(self.seen, self.residual[..., None])[:, 0]

    def leave_out(self, mask: np.ndarray, least: float = 1e-12) -> tuple[np.ndarray, np.ndarray, float] | None:
        """What the readings of ``mask`` (S, P, R) do to the fit: (B, S, 8) how the coefficients move without them, and
        the deviation that noise explains; their mean square error, predicted from the others, over what noise explains.

        The variance of that move is what the variance grows by (Hausman 1978). None where the other readings and the
        priors do not determine every weight: a combination of weights, each over what all readings tell of it, is
        below ``least``, the rounding of a normal matrix; or where no weight is left, of readings that no bearing fits.
        """
        left_out, size = mask[..., None] * self.seen, np.sqrt(np.diag(self.normal))
        information = self.normal - cross(left_out, left_out)
        if not size.size or np.linalg.eigvalsh(information / np.outer(size, size))[0] <= least:
            return None
        right = self.right - cross(left_out, self.residual[..., None])[:, 0]
        weights, covariance = np.linalg.solve(information, right), np.linalg.inv(information)
        moves = self.coefficients @ (weights - np.linalg.solve(self.normal, self.right))
        chosen = self.by_weight[mask]
        left = self.residual[mask] - chosen @ weights
        expected = 1.0 + np.einsum("nz,zy,ny->n", chosen.conj(), covariance, chosen, optimize=True).real
        spread = self.deviate(covariance - np.linalg.inv(self.normal))
        return moves, spread, float(np.mean(np.abs(left) ** 2 / expected))

    def deviate(self, covariance: np.ndarray) -> np.ndarray:
        """(B, S, 8) standard deviations of the coefficients, from a ``covariance`` (Z, Z) of the weights."""
        return deviate(self.coefficients, covariance)


def cross(rows: np.ndarray, others: np.ndarray) -> np.ndarray:
    """``2 Re A^H B`` of (S, P, R, ..)."""
    return np.asarray(2.0 * np.einsum("sprz,sprt->zt", rows.conj(), others, optimize=True).real)


def linearise(
    measurement: Measurement,
    uncertainty: Uncertainty,
    fitted: np.ndarray,
    factor: np.ndarray | float = 1.0,
    correlation: float = 0.0,
) -> LinearisedFit:
    """The fit of ``measurement``, at its fitted model parameters.

    Args:
        fitted: (S, P, R) mask of the readings that were fitted, not held out.
        factor: (P,) noise of each channel over the stated one.
        correlation: of the noise from speed to speed.
    """
    import torch

    problem, weights = restore(measurement, uncertainty)
    data = measurement.dataset
    # What one run does is asked of each reading by itself: noise that they share would tie runs together.
    readings = problem.readings
    noise = [readings.deviation(b, block.numpy(), factor) for b, block in enumerate(problem.predicted(weights))]
    alone = tuple(torch.as_tensor(np.sqrt(2.0) / block) for block in noise)
    problem = replace(
        problem, readings=replace(readings, precision=alone, common=(), mixing=(), correlation=correlation)
    )
    kept = problem.fitted().numpy()
    columns = np.zeros((*data.displacement.shape, int(kept.sum()) + 1), dtype=complex)
    for runs, block in zip(problem.readings.runs, problem.columns_of_blocks(weights), strict=True):
        columns[:, :, runs] = block[0].numpy()[..., np.append(kept, True)] / np.sqrt(2.0)
    by_number = measurement.unknowns.expand_slopes(problem.unknown_slopes(weights)[0])  # (B, S, 8, A K + Th)
    coefficients = np.zeros((*by_number.shape[:3], len(kept)))
    coefficients[..., : problem.places.numbers.stop] = by_number
    prior = problem.prior.information.numpy()[np.ix_(kept, kept)]
    return LinearisedFit(-columns[..., -1], columns[..., :-1], coefficients[..., kept], prior, fitted)


# --- which run would help a coefficient most ---------------------------------------------------------


Run = tuple[Excitation, ...]
Gains = Sequence[tuple[Run, np.ndarray]]
"""Candidate runs, and by how many times deviations (B, 8) fall with each."""


def weigh_candidates(
    measurement: Measurement,
    uncertainty: Uncertainty,
    linear: LinearisedFit,
    candidates: Sequence[Run],
) -> Gains:
    """By how many times each candidate run, beside the runs that there are, lowers the deviations of the coefficients:
    linear theory, medians over the speed.

    ``measurement`` is at the fitted model parameters.
    """
    nodes = measurement.rotor.n_nodes
    able = tuple(acting for acting in candidates if all(weight.node < nodes for weight in acting))
    if not able:
        return []
    before, data, gains = linear.deviate(np.linalg.inv(linear.normal)), measurement.dataset, []
    excitations = tuple(replace(weight, run=f"candidate {i}") for i, acting in enumerate(able) for weight in acting)
    shape = (*data.displacement.shape[:2], len(able))
    plan = replace(
        data,
        runs=tuple(f"candidate {i}" for i in range(len(able))),
        displacement=np.zeros(shape, dtype=complex),
        excitations=excitations,
        own_frequencies=None,
        subtracted=None,
        present=EVERYWHERE,
    )
    planned = replace(measurement, dataset=plan, drift=NO_LEVELS)  # its runs are conditions of their own
    seen = linearise(planned, uncertainty, np.ones(shape, dtype=bool)).by_weight
    for i, acting in enumerate(able):
        after = linear.deviate(np.linalg.inv(linear.normal + cross(seen[:, :, [i]], seen[:, :, [i]])))
        with np.errstate(divide="ignore", invalid="ignore"):
            gains.append((acting, np.median(before / after, axis=1)))
    return gains
