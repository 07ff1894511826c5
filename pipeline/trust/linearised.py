"""A fit by the output error, linear about its answer: what a run or a probe does to each coefficient.

With readings ``e`` over their noise that the fit leaves, and its derivative ``J`` by the weights z of the coefficients,
leaving a run out moves the weights by ``(N - N_r)^-1 (b - b_r)`` with ``N = 2 Re J^H J`` and ``b = 2 Re J^H e``.

Legend: S speeds, P channels, R runs, B bearings, Z weights, T parameters. SI units.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from pipeline.data.dataset import name_direction
from pipeline.identification.identified import IdentifiedModel
from pipeline.identification.uncertainty import Uncertainty
from pipeline.problem.measurement import Measurement
from pipeline.problem.response import derive_by_parameters, respond
from pipeline.rotor.bearing_table import BearingTable


@dataclass(frozen=True, eq=False)
class LinearisedFit:
    """What the fit left over, and how readings and coefficients move with its weights."""

    residual: np.ndarray  # e, (S, P, R) complex, measured less predicted over the noise
    by_weight: np.ndarray  # J, (S, P, R, Z) complex, of the predicted readings over the noise
    coefficients: np.ndarray  # (B, S, 8, Z) derivative of the coefficients by the weights
    prior: np.ndarray  # (Z,) precision that the fit has without any reading
    fitted: np.ndarray  # (S, P, R) mask of the readings that were fitted

    @cached_property
    def seen(self) -> np.ndarray:
        """(S, P, R, Z) rows of the fitted readings, zero for the others."""
        return np.asarray(self.fitted[..., None] * self.by_weight)

    @cached_property
    def normal(self) -> np.ndarray:
        """N, (Z, Z) of the fitted readings and the priors."""
        return _cross(self.seen, self.seen) + np.diag(self.prior)

    @cached_property
    def right(self) -> np.ndarray:
        """b, (Z,)."""
        return _right(self.seen, self.residual)

    def solve(self, right: np.ndarray, without: np.ndarray | None = None) -> np.ndarray:
        """``N^-1 right`` of all fitted readings, or of those ``without`` (S, P, R) mask."""
        return np.asarray(np.linalg.solve(self._information(without), right))

    def leave_out(self, mask: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(B, S, 8) how the coefficients move without the readings of ``mask``, and the deviation that noise explains.

        The variance of that move is what the variance grows by (Hausman 1978).
        """
        step = self._without(mask) - self.solve(self.right)
        spread = np.linalg.inv(self._information(mask)) - np.linalg.inv(self._information(None))
        variance = np.einsum("bscz,zy,bscy->bsc", self.coefficients, spread, self.coefficients, optimize=True)
        return self.coefficients @ step, np.sqrt(np.maximum(variance, 0.0))

    def predict_without(self, mask: np.ndarray) -> float:
        """Mean square error of the readings of ``mask``, predicted from the others, over what noise explains."""
        step = self._without(mask)
        chosen = self.by_weight[mask]
        left = self.residual[mask] - chosen @ step
        spread = np.linalg.inv(self._information(mask))
        expected = 1.0 + np.einsum("nz,zy,ny->n", chosen.conj(), spread, chosen, optimize=True).real
        return float(np.mean(np.abs(left) ** 2 / expected))

    def _without(self, mask: np.ndarray) -> np.ndarray:
        """(Z,) the weights' step of a fit without the readings of ``mask``."""
        left_out = mask[..., None] * self.seen
        return self.solve(self.right - _right(left_out, self.residual), mask)

    def _information(self, without: np.ndarray | None) -> np.ndarray:
        if without is None:
            return self.normal
        left_out = without[..., None] * self.seen
        return self.normal - _cross(left_out, left_out)


def _cross(rows: np.ndarray, others: np.ndarray) -> np.ndarray:
    """``2 Re A^H B`` of (S, P, R, ..)."""
    return np.asarray(2.0 * np.einsum("sprz,sprt->zt", rows.conj(), others, optimize=True).real)


def _right(rows: np.ndarray, residual: np.ndarray) -> np.ndarray:
    return np.asarray(2.0 * np.einsum("sprz,spr->z", rows.conj(), residual, optimize=True).real)


def linearise(
    measurement: Measurement,
    identified: IdentifiedModel,
    uncertainty: Uncertainty,
    fitted: np.ndarray,
    factor: np.ndarray | None = None,
) -> LinearisedFit:
    """The fit of ``measurement``, at its fitted model parameters.

    Args:
        fitted: (S, P, R) mask of the readings that were fitted, not held out.
        factor: (P,) noise of each channel over the stated one; None for the stated one.
    """
    unbalance = uncertainty.residual_unbalance
    answer = identified.table(measurement.updated_known)
    predicted = measurement.response.predict(answer, unbalance)
    noise = measurement.deviation_of(predicted, measurement.dataset.subtracted, factor)
    residual = (measurement.dataset.displacement - predicted) / noise
    by_coefficient = measurement.response.sensitivity(answer, unbalance) / noise[..., None, None]
    by_number = uncertainty.sensitivity(identified, answer.speeds, answer.operating)  # (B, S, 8, A (K + L) + Th)
    kept = _mask_fitted(identified, uncertainty)
    by_number = by_number[..., kept]
    parts = [np.einsum("sprbc,bscz->sprz", by_coefficient, by_number, optimize=True)]
    seen = fitted[..., None] * parts[0]
    priors = [_weigh_before(identified, uncertainty, kept, _cross(seen, seen), len(answer.speeds))]
    if unbalance.size:
        by_plane = measurement.response.derive_by_unbalance(answer) * uncertainty.plane_scale / noise[..., None]
        parts += [by_plane, 1j * by_plane]
        priors.append(np.full(2 * unbalance.size, _NO_PRIOR))
    names = [parameter.kind for parameter in measurement.parameters]
    if names:
        parts.append(_by_parameters(measurement, answer, by_coefficient, noise))
        priors.append(np.ones(len(names)))
    joined = np.concatenate(parts, axis=-1)
    by_weight = np.zeros((*by_number.shape[:3], joined.shape[-1]))
    by_weight[..., : by_number.shape[-1]] = by_number
    return LinearisedFit(
        residual,
        joined,
        by_weight,
        np.concatenate(priors),
        fitted,
    )


_NO_PRIOR = 1e-12


def _mask_fitted(identified: IdentifiedModel, uncertainty: Uncertainty) -> np.ndarray:
    """(A (K + L) + Th,) mask of the weights that the fit had: not what it dropped, nor the local functions."""
    count = len(uncertainty.active) * (uncertainty.weights.shape[-1] + uncertainty.n_local)
    each = count // max(len(uncertainty.active), 1)
    local = np.tile(np.arange(each) >= each - uncertainty.n_local, len(uncertainty.active))
    numbers = 0 if identified.theta is None else len(identified.theta)
    kept = np.diag(uncertainty.covariance)[: count + numbers] > 0
    kept[:count] &= ~local
    return np.asarray(kept)


def _weigh_before(
    identified: IdentifiedModel, uncertainty: Uncertainty, kept: np.ndarray, told: np.ndarray, n_speeds: int
) -> np.ndarray:
    """(Z,) precision that the ``kept`` weights and numbers have without the readings, of information ``told`` (Z, Z).

    Features are orthonormal over the speeds: an output of 1 at every speed is a weight of their root. A correction of
    laws has the precision that its fit found: what its covariance knows beyond the readings.
    """
    if identified.laws is None:
        return np.full(int(kept.sum()), 1.0 / n_speeds)
    whole = np.linalg.inv(uncertainty.covariance[: len(kept), : len(kept)][np.ix_(kept, kept)])
    before = np.maximum(np.diag(whole) - np.diag(told), _NO_PRIOR)
    numbers = [1.0 / parameter.deviation**2 for parameter in identified.laws.parameters]
    before[len(before) - len(numbers) :] = numbers
    return np.asarray(before)


def _by_parameters(
    measurement: Measurement, answer: BearingTable, by_coefficient: np.ndarray, noise: np.ndarray
) -> np.ndarray:
    """(S, P, R, T) derivative of the readings over the noise by the measurement's parameters."""
    slopes = np.einsum("sprbc,sbct->sprt", by_coefficient, measurement.known_variation).astype(complex)
    for block, variation in zip(measurement.response.blocks, measurement.variations, strict=True):
        change = measurement.response.change(answer, block)
        block_slopes = derive_by_parameters(variation, respond(block, change), change[None], None)[0]
        slopes[:, :, block.runs] += block_slopes / noise[:, :, block.runs, None]
    return slopes


def name_channels(measurement: Measurement) -> list[str]:
    """What each channel is called."""
    return [f"node {node} {name_direction(angle)}" for node, angle in measurement.dataset.channels]
