"""A fit by the output error, linear about its answer: what a run, a probe or a tolerance does to each coefficient.

With readings ``e`` over their noise that the fit leaves, and its derivative ``J`` by the weights z of the coefficients,
leaving a run out moves the weights by ``(N - N_r)^-1 (b - b_r)`` with ``N = 2 Re J^H J`` and ``b = 2 Re J^H e``, and a
machine that is one tolerance off, so that readings differ by ``V``, moves them by ``N^-1 2 Re J^H V``.

Legend: S speeds, P channels, R runs, B bearings, Z weights, T parameters. SI units.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from pipeline.data.dataset import name_direction
from pipeline.errors import ConfigError
from pipeline.identification.identified import IdentifiedModel
from pipeline.identification.uncertainty import Uncertainty
from pipeline.problem.measurement import Measurement
from pipeline.problem.model_parameters import model_parameters
from pipeline.problem.response import derive_by_parameters, respond
from pipeline.rotor.bearing_table import BearingTable

TOLERANCES = {
    "youngs_modulus": 0.01,
    "density": 0.005,
    "unbalance_magnitude": 0.02,
    "unbalance_phase": float(np.radians(2.0)),
    "probe_gain": 0.02,
    "probe_angle": float(np.radians(1.0)),
}
"""Standard deviations of what is never known exactly, where the configuration states none: steel varies by 1 %, a trial
weight and its place are off by 2 % and 2 degrees (docs/model_error.md), the scale of a proximity probe by 5 % at most
(API 670)."""


@dataclass(frozen=True, eq=False)
class LinearisedFit:
    """What the fit left over, and how readings and coefficients move with its weights."""

    residual: np.ndarray  # e, (S, P, R) complex, measured less predicted over the noise
    by_weight: np.ndarray  # J, (S, P, R, Z) complex, of the predicted readings over the noise
    by_tolerance: dict[str, np.ndarray]  # V by kind, (S, P, R, T) complex, of one tolerance each
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

    def tolerances(self, misfit: float) -> tuple[np.ndarray, dict[str, np.ndarray]]:
        """(B, S, 8) by how much the tolerances move the coefficients, and the same of each kind by itself.

        Readings that a tolerance would change as no coefficient can leave it less room. It is as if all of them were
        fitted, with the posterior ``(1 + V'PV)^-1`` and its mean, where P takes away what the weights can follow.
        ``misfit`` is the mean square of the residuals, which the readings' precision is divided by.
        """
        if not self.by_tolerance:
            return np.zeros(self.coefficients.shape[:3]), {}
        change = np.concatenate(list(self.by_tolerance.values()), axis=-1) * self.fitted[..., None]
        seen = _cross(self.seen, change)
        moves = -self.coefficients @ self.solve(seen)  # (B, S, 8, T) of readings that the model lacks
        room = _cross(change, change) - seen.T @ self.solve(seen)
        asked = _right(change, self.residual) - seen.T @ self.solve(self.right)
        spread = np.linalg.inv(np.eye(len(room)) + room / misfit)
        mean = spread @ asked / misfit
        second = spread + np.outer(mean, mean)
        by_kind, start = {}, 0
        for kind, columns in self.by_tolerance.items():
            places = slice(start, start := start + columns.shape[-1])
            by_kind[kind] = _quadratic(moves[..., places], second[places, places])
        return _quadratic(moves, second), by_kind

    def _without(self, mask: np.ndarray) -> np.ndarray:
        """(Z,) the weights' step of a fit without the readings of ``mask``."""
        left_out = mask[..., None] * self.seen
        return self.solve(self.right - _right(left_out, self.residual), mask)

    def _information(self, without: np.ndarray | None) -> np.ndarray:
        if without is None:
            return self.normal
        left_out = without[..., None] * self.seen
        return self.normal - _cross(left_out, left_out)


def _quadratic(slopes: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """(B, S, 8) root of ``m' C m``."""
    variance = np.einsum("bsct,tu,bscu->bsc", slopes, covariance, slopes, optimize=True)
    return np.asarray(np.sqrt(np.maximum(variance, 0.0)))


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
    tolerances: bool = True,
) -> LinearisedFit:
    """The fit of ``measurement``, at its fitted model parameters.

    Args:
        fitted: (S, P, R) mask of the readings that were fitted, not held out.
        factor: (P,) noise of each channel over the stated one; None for the stated one.
        tolerances: whether to work out what unfitted tolerances do.
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
        _by_tolerances(measurement, answer, by_coefficient, noise) if tolerances else {},
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


def _by_tolerances(
    measurement: Measurement, answer: BearingTable, by_coefficient: np.ndarray, noise: np.ndarray
) -> dict[str, np.ndarray]:
    """The tolerances that the fit does not have among its parameters, by kind."""
    stated, by_kind = {parameter.kind for parameter in measurement.parameters}, {}
    for kind, size in TOLERANCES.items():
        if kind in stated:
            continue
        try:
            parameters = model_parameters(
                {kind: size}, measurement.rotor, measurement.dataset, measurement.known, measurement.unknowns
            )
        except ConfigError:  # the machine has none of this kind
            continue
        data = replace(measurement, parameters=parameters, values=(), rotor=measurement.updated_rotor)
        by_kind[kind] = _by_parameters(data, answer, by_coefficient, noise)
    return by_kind


def name_channels(measurement: Measurement) -> list[str]:
    """What each channel is called."""
    return [f"node {node} {name_direction(angle)}" for node, angle in measurement.dataset.channels]
