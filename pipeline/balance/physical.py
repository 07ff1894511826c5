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

from pipeline.balance.influence import bend, design_of, differentiate
from pipeline.balance.linear_vibration import LinearVibration
from pipeline.data.conditions import Conditions
from pipeline.identification.answer import restore
from pipeline.identification.problem import OutputError, output_error
from pipeline.identification.uncertainty import Uncertainty
from pipeline.parameters.weights import bend_law
from pipeline.problem.condition_noise import NO_LEVELS, follow_residuals, spread_conditions, to_dataset
from pipeline.problem.measurement import Measurement
from pipeline.problem.noise_levels import NoiseLevels

if TYPE_CHECKING:
    import torch


@dataclass(frozen=True, eq=False, kw_only=True)
class Physical(LinearVibration):
    """A fitted physical model."""

    measurement: Measurement  # at the fitted model parameters
    problem: OutputError  # of the fit
    weights: torch.Tensor  # (1, 1, Z)
    covariance: np.ndarray  # (Z, Z)
    trial: float = 1e-5  # kg m of a weight by which the response to weights is worked out; linear but for their law

    def predict(self, unbalance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Mean (C, D) m and its covariance (C, D, D) m^2 for weights (C, N) kg m."""
        weights = np.atleast_2d(unbalance)
        rows, slopes = self._parts
        acting = design_of(weights, self._law)  # (C, 1 + N)
        by_number = np.tensordot(acting, slopes, 1)  # (C, D, Z)
        for z, change in self._law_changes(weights):
            by_number[..., z] += change @ rows[1:]
        return acting @ rows, by_number @ self.covariance @ by_number.conj().swapaxes(1, 2)

    def influence_at(self, unbalance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Derivative (D, N) m/(kg m) by the weights at ``unbalance`` (N,), and the baseline (D,) m."""
        return differentiate(self._parts[0], self._law, unbalance)

    @property
    def _law(self) -> complex:
        """a of the weights' law U (1 + a |U|), 1/(kg m)."""
        return sum((p.value * bend_law(p) for p in self.measurement.parameters), 0j)

    def _law_changes(self, weights: np.ndarray) -> Iterator[tuple[int, np.ndarray]]:
        """The numbers z that are parts of the law, and what they change of the acting weights (C, N)."""
        first = self.covariance.shape[0] - len(self.measurement.parameters)
        for t, parameter in enumerate(self.measurement.parameters):
            if law := bend_law(parameter):
                yield first + t, law * bend(weights)

    @cached_property
    def _parts(self) -> tuple[np.ndarray, np.ndarray]:
        """(1 + N, D) what shows without weights, and of 1 kg m on each plane; their derivatives (1 + N, D, Z)."""
        trial = np.concatenate([np.zeros((1, len(self.planes))), self.trial * np.eye(len(self.planes))])
        problem = self._problem(trial)
        (mean,) = problem.predicted(self.weights)
        n_runs = mean.shape[-1]
        (columns,) = problem.columns_of_blocks(self.weights)
        slope = columns[0, ..., :-1].numpy()
        slopes = slope.transpose(2, 0, 1, 3).reshape(n_runs, -1, slope.shape[-1])
        rows = mean[0].numpy().reshape(-1, n_runs).T.copy()
        acting = np.diag(design_of(trial[1:], self._law)[:, 1:])
        rows[1:] = (rows[1:] - rows[0]) / acting[:, None]
        slopes[1:] -= slopes[0]
        for z, change in self._law_changes(trial[1:]):
            slopes[1:, :, z] -= change @ rows[1:]
        slopes[1:] /= acting[:, None, None]
        return rows, slopes

    def _problem(self, unbalance: np.ndarray) -> OutputError:
        """The problem of conditions with these weights (C, N), with rows in m."""
        import torch

        dataset = to_dataset(spread_conditions(unbalance, self.planes, self.speeds, self.channels))
        measurement = replace(self.measurement, dataset=dataset, drift=NO_LEVELS)
        made = output_error(measurement, self.problem.basis, self.problem.plane_scale)
        alike = tuple(map(torch.ones_like, made.readings.precision))
        plain = replace(made.readings, precision=alike, common=(), records=())
        return replace(self.problem, sensors=made.sensors, readings=plain, features=made.features, origin=made.origin)


def restore_physical(measurement: Measurement, uncertainty: Uncertainty, conditions: Conditions) -> Physical:
    """The predictor of a fit that was stored, with constant coefficients, to ``conditions`` whose noise has levels."""
    problem, weights = restore(measurement.update(uncertainty.parameters), uncertainty)
    return Physical(
        speeds=conditions.speeds,
        channels=conditions.channels,
        planes=conditions.planes,
        noise=read_levels(problem, weights),
        measurement=problem.measurement,
        problem=problem,
        weights=weights,
        covariance=uncertainty.covariance,
    )


def read_levels(problem: OutputError, weights: torch.Tensor) -> NoiseLevels:
    """The noise that the residuals of a fit show, to conditions whose noise has levels."""
    (predicted,), (measured,) = problem.predicted(weights), problem.readings.measured
    rest = (predicted - measured)[0].flatten(0, 1).T.numpy()
    assert problem.measurement.drift
    return follow_residuals(problem.measurement.drift, rest, problem.n_fitted)
