"""The physical model as a predictor of vibration from weights: a rotor on identified bearings.

The vector of a condition follows from its weights U and from the numbers z that were fitted (coefficients, residual
unbalance, model parameters): y = y(U, z). The covariance of z is carried along by the derivatives.

Legend: C conditions, S speeds, P channels, N planes, D = S P (index s * P + p), Z fitted numbers.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from pipeline.data.conditions import Conditions
from pipeline.errors import DataError
from pipeline.identification.answer import restore
from pipeline.identification.identified import IdentifiedModel
from pipeline.identification.output_error_fit import OutputErrorFit, fit_output_error
from pipeline.identification.problem import OutputError, output_error
from pipeline.identification.quality import output_error_quality
from pipeline.identification.training import FitSetup
from pipeline.identification.uncertainty import Uncertainty, measure_uncertainty
from pipeline.problem.condition_noise import (
    NO_LEVELS,
    condition_noise,
    follow_residuals,
    spread_conditions,
    suffices,
    to_dataset,
)
from pipeline.problem.force_parameters import PARTS
from pipeline.problem.measurement import Measurement
from pipeline.problem.noise_levels import NoiseLevels, spread_blocks
from pipeline.rotor.bearing_table import BearingTable

if TYPE_CHECKING:
    import torch

_TRIAL = 1e-5
"""kg m of a weight by which the response to weights is worked out; it is linear but for their law."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Physical:
    """A fitted physical model; a :class:`pipeline.balance.linear_vibration.LinearVibration`."""

    measurement: Measurement  # at the fitted model parameters
    problem: OutputError  # of the fit
    weights: torch.Tensor  # (1, 1, Z)
    covariance: np.ndarray  # (Z, Z)
    speeds: np.ndarray  # (S,) rad/s
    channels: tuple[tuple[int, float], ...]  # P
    planes: tuple[int, ...]  # N
    noise: NoiseLevels

    def predict(self, unbalance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Mean (C, D) m and its covariance (C, D, D) m^2 for weights (C, N) kg m."""
        weights = np.atleast_2d(unbalance)
        rows, slopes = self._parts
        acting = np.concatenate([np.ones((len(weights), 1)), self._act(weights)], axis=1)  # (C, 1 + N)
        by_number = np.tensordot(acting, slopes, 1)  # (C, D, Z)
        for z, change in self._law_changes(weights):
            by_number[..., z] += change @ rows[1:]
        covariance = by_number @ self.covariance @ by_number.conj().swapaxes(1, 2)
        return acting @ rows, covariance

    def influence_at(self, unbalance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Derivative (D, N) m/(kg m) by the weights at ``unbalance`` (N,), and the baseline (D,) m.

        The part that turns with the weights, as :meth:`pipeline.balance.influence.Influence.influence_at` has it.
        """
        rows, _ = self._parts
        return rows[1:].T * (1 + 1.5 * self._law * np.abs(np.asarray(unbalance))), rows[0]

    @property
    def _law(self) -> complex:
        """a of the weights' law U (1 + a |U|), 1/(kg m)."""
        values = self.measurement.parameter_values
        every = zip(self.measurement.parameters, values, strict=True)
        return sum((v * p.deviation * PARTS[p.detail] for p, v in every if p.kind == "weight_law"), 0j)

    def _act(self, weights: np.ndarray) -> np.ndarray:
        return np.asarray(weights * (1 + self._law * np.abs(weights)))

    def _law_changes(self, weights: np.ndarray) -> Iterator[tuple[int, np.ndarray]]:
        """The numbers z that are parts of the law, and what they change of the acting weights (C, N)."""
        first = self.covariance.shape[0] - len(self.measurement.parameters)
        for t, parameter in enumerate(self.measurement.parameters):
            if parameter.kind == "weight_law":
                yield first + t, parameter.deviation * PARTS[parameter.detail] * weights * np.abs(weights)

    @cached_property
    def _parts(self) -> tuple[np.ndarray, np.ndarray]:
        """(1 + N, D) what shows without weights, and of 1 kg m on each plane; their derivatives (1 + N, D, Z)."""
        trial = np.concatenate([np.zeros((1, len(self.planes))), _TRIAL * np.eye(len(self.planes))])
        problem = self._problem(trial)
        (mean,) = problem.predicted(self.weights)
        n_runs = mean.shape[-1]
        (columns,) = problem.columns_of_blocks(self.weights)
        slope = columns[0, ..., :-1].numpy()
        slopes = slope.transpose(2, 0, 1, 3).reshape(n_runs, -1, slope.shape[-1])
        rows = mean[0].numpy().reshape(-1, n_runs).T.copy()
        acting = np.diag(self._act(trial[1:]))
        rows[1:] = (rows[1:] - rows[0]) / acting[:, None]
        slopes[1:] -= slopes[0]
        for z, change in self._law_changes(trial[1:]):
            slopes[1:, :, z] -= change @ rows[1:]
        slopes[1:] /= acting[:, None, None]
        return rows, slopes

    def at(self, speeds: np.ndarray) -> Physical:
        """The same at other ``speeds`` (S,) rad/s.

        The noise there is that of the nearest fitted speed, as much larger as the machine is more lively. Raises
        DataError for known coefficients that depend on the speed.
        """
        values = self.measurement.known.values
        if np.ptp(values, axis=1).any():
            raise DataError(
                "the physical model must have known coefficients that do not depend on the speed to predict at other "
                "speeds, but they do: give them as values"
            )
        table = BearingTable(self.measurement.known.nodes, speeds, np.repeat(values[:, :1], len(speeds), axis=1))
        interpolated = replace(self, speeds=speeds, measurement=replace(self.measurement, known=table))
        here, asked = (np.abs(model.influence_at(np.zeros(len(self.planes)))[0]) for model in (self, interpolated))
        return replace(interpolated, noise=_carry(self.noise, self.speeds, speeds, here, asked))

    def _problem(self, unbalance: np.ndarray) -> OutputError:
        """The problem of conditions with these weights (C, N), with rows in m."""
        import torch

        dataset = to_dataset(spread_conditions(unbalance, self.planes, self.speeds, self.channels))
        measurement = replace(self.measurement, dataset=dataset, drift=NO_LEVELS)
        made = output_error(measurement, self.problem.basis, self.problem.plane_scale)
        plain = replace(made.readings, precision=tuple(map(torch.ones_like, made.readings.precision)), common=())
        return replace(self.problem, sensors=made.sensors, readings=plain, features=made.features)


def _carry(
    noise: NoiseLevels, fitted: np.ndarray, speeds: np.ndarray, here: np.ndarray, asked: np.ndarray
) -> NoiseLevels:
    """The noise at ``speeds``, of that at the ``fitted`` ones; ``here`` and ``there`` (D, N) are the influences."""
    nearest = np.abs(speeds[:, None] - fitted).argmin(axis=1)
    n_channels = noise.record.shape[1]
    power = [(influence.reshape(len(s), -1) ** 2).sum(1) for influence, s in ((here, fitted), (asked, speeds))]
    blocks = [noise.condition[s * n_channels :, s * n_channels :][:n_channels, :n_channels] for s in nearest]
    ratio = power[1] / power[0][nearest]
    condition = spread_blocks(np.stack([r * block for r, block in zip(ratio, blocks, strict=True)]))
    return replace(noise, record=noise.record[nearest] * ratio[:, None, None], condition=condition)


def fit_physical(template: Measurement, setup: FitSetup, conditions: Conditions) -> Physical:
    """Fit the rotor of the ``template`` to conditions, at their speeds.

    With too few conditions to estimate the levels of their noise, the noise is as it was stated. Raises as
    :func:`pipeline.identification.output_error_fit.fit_output_error`.
    """
    known = template.known.at(np.abs(template.known.speeds[:, None] - conditions.speeds).argmin(axis=0))
    enough = suffices(conditions)
    measurement = replace(
        template,
        noise=template.noise if enough else template.noise.with_drift(),
        dataset=to_dataset(conditions),
        known=replace(known, speeds=conditions.speeds),
        drift=condition_noise(conditions, template.noise) if enough else NO_LEVELS,
    )
    return physical_of(fit_output_error(measurement, setup), conditions)


def restore_physical(
    measurement: Measurement, identified: IdentifiedModel, uncertainty: Uncertainty, planes: Conditions
) -> Physical:
    """The predictor of a fit that was stored, with constant coefficients; ``planes`` are the conditions it was of.

    Raises as :func:`fit_physical`.
    """
    problem, weights = restore(measurement.update(uncertainty.parameters), identified, uncertainty)
    return _physical(problem, weights, uncertainty.covariance, planes)


def physical_of(fit: OutputErrorFit, conditions: Conditions) -> Physical:
    """The predictor of a fit to these conditions."""
    return _physical(
        fit.problem, fit.weights, measure_uncertainty(fit, output_error_quality(fit)).covariance, conditions
    )


def _physical(
    problem: OutputError,
    weights: torch.Tensor,
    covariance: np.ndarray,
    conditions: Conditions,
) -> Physical:
    """With the noise that the residuals show, or with the stated one where there are no levels."""
    measurement = problem.measurement
    if measurement.drift:
        (predicted,), (measured,) = problem.predicted(weights), problem.readings.measured
        rest = (predicted - measured)[0].flatten(0, 1).T.numpy()
        noise = follow_residuals(measurement.drift, rest, problem.n_fitted).levels
    else:
        variance = (measurement.deviation**2).mean(axis=2)  # (S, P)
        level = spread_blocks(np.stack([np.diag(speed_variance).astype(complex) for speed_variance in variance]))
        noise = NoiseLevels(conditions.record_covariance, level, np.inf)
    return Physical(
        measurement=measurement,
        problem=problem,
        weights=weights,
        covariance=covariance,
        speeds=conditions.speeds,
        channels=conditions.channels,
        planes=conditions.planes,
        noise=noise,
    )
