"""The output error: what the sensors measured against what the coefficients predict, over the sensors' noise.

Under noise of the sensors its minimum is the maximum-likelihood estimate; the residual instead multiplies the noise by
the shaft's dynamic stiffness. The rows are whitened: with the right coefficients they have unit variance.

The hidden layer of a network stays as it was drawn (random features; Rahimi and Recht 2007): the output layer is
linear, the estimate is then close to normal, and its covariance is that of the whole parametrisation. Trained hidden
layers have directions that the data leave undetermined, along which no linearised covariance holds. The weights z that
are fitted are the output weights in an orthonormal basis of the features over the training speeds, of which each
unknown has as many as the data determine (:mod:`pipeline.identification.selection`); the others stay zero.

Uncertain numbers of the model (:mod:`pipeline.problem.model_parameters`) are weights too. Each has a prior of unit
variance, which is one more row: what the data do not tell of it stays at its prior and widens the deviations. So have
the features beyond the trend, a wide one, once it is chosen how many there are: where the readings say nothing, a
coefficient must not run away.

Legend: G data sets or starts, M members (bearings, or 1 where they share their coefficients), S speeds, P channels, R
runs, B bearings, U unknowns, A those of them that members have, K features, N balance planes, T model parameters,
Z = A K + 2 N + T weights.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

from pipeline.identification.basis import Basis
from pipeline.identification.law_term import law_term
from pipeline.identification.sensor_deviations import SensorDeviations, SensorState, sensor_deviations
from pipeline.identification.weight_prior import WeightPrior, size_prior
from pipeline.identification.whitened_readings import WhitenedReadings
from pipeline.problem.measurement import Measurement

if TYPE_CHECKING:
    import torch

COLLAPSED = 0.02
"""Below this fraction of its initial guess a coefficient counts as collapsed."""


@dataclass(frozen=True, eq=False)
class OutputError:
    """Least squares of the weights z, (G, 1, Z), at the speeds and runs of a measurement."""

    sensors: SensorDeviations
    basis: Basis
    features: torch.Tensor  # (M, S, K) at the speeds of the measurement
    kept: torch.Tensor  # (A, K) bool: the features that an unknown has
    prior: torch.Tensor  # (K,) or (A, K) precision of a feature's weight before the data; 0 for none

    @property
    def measurement(self) -> Measurement:
        """Where the readings are from."""
        return self.sensors.measurement

    @property
    def active(self) -> tuple[tuple[int, int], ...]:
        """A of (member, unknown)."""
        return self.sensors.active

    @property
    def n_planes(self) -> int:
        """N."""
        return self.sensors.n_planes

    @property
    def n_parameters(self) -> int:
        """T."""
        return self.sensors.n_parameters

    @property
    def n_rest(self) -> int:
        """Th + 2 N + T: how many weights follow those of the coefficients."""
        return self.sensors.n_rest

    @property
    def n_numbers(self) -> int:
        """Th."""
        return self.sensors.n_numbers

    @property
    def n_rows(self) -> int:
        """Real numbers that were measured."""
        return self.sensors.n_rows

    @property
    def n_outer(self) -> int:
        """A K: how many weights are those of the coefficients; they come first."""
        return len(self.active) * int(self.features.shape[-1])

    @property
    def size(self) -> int:
        """Z."""
        return self.n_outer + self.n_rest

    @property
    def n_fitted(self) -> int:
        """How many weights are fitted: Z less the features that are not kept."""
        return int(self.kept.sum()) + self.n_rest

    def fitted(self) -> torch.Tensor:
        """(Z,) bool: which weights are fitted."""
        import torch

        return torch.cat([self.kept.flatten(), torch.ones(self.n_rest, dtype=torch.bool)])

    @cached_property
    def weight_prior(self) -> WeightPrior:
        """Of features, of theta about its guess, of unit variance of the model parameters; of coefficients' sizes."""
        import torch

        own = (self.prior * self.kept).flatten()
        law = self.sensors.law
        numbers = torch.zeros(0) if law is None else law.prior_precision()
        rest = [numbers, torch.zeros(2 * self.n_planes), torch.ones(self.n_parameters)]
        sizes = size_prior(self.measurement, self.basis.model, self.sensors.scale, self.readings.features)
        return WeightPrior(torch.cat([own, *rest]).to(self.prior.dtype), sizes)

    @cached_property
    def readings(self) -> WhitenedReadings:
        """The readings' rows, as functions of the weights."""
        members = [m for m, _ in self.active]
        return WhitenedReadings(self.sensors, self.features[members] * self.kept[:, None])

    # --- from weights to coefficients ---------------------------------------------------------------

    def unbalance(self, weights: torch.Tensor) -> torch.Tensor:
        """(G, N) complex residual unbalance, kg m."""
        import torch

        first = self.n_outer + self.n_numbers
        pairs = weights[:, 0, first : first + 2 * self.n_planes].unflatten(-1, (self.n_planes, 2))
        return self.sensors.plane_scale * torch.complex(pairs[..., 0], pairs[..., 1])

    def model_parameters(self, weights: torch.Tensor) -> torch.Tensor:
        """(G, T) model parameters, in prior deviations."""
        return weights[:, 0, self.size - self.n_parameters :]

    def state(self, weights: torch.Tensor) -> SensorState:
        """What the readings follow from."""
        parameters, numbers = self.model_parameters(weights), self.theta(weights) if self.n_numbers else None
        return SensorState(self.outputs(weights), self.unbalance(weights), parameters, numbers)

    def theta(self, weights: torch.Tensor) -> torch.Tensor:
        """(G, Th) theta of the bearing laws."""
        return weights[:, 0, self.n_outer : self.n_outer + self.n_numbers]

    def outputs(self, weights: torch.Tensor) -> torch.Tensor:
        """(G, M, S, U) outputs of the model."""
        return self.features @ self.coordinates(weights).mT

    def unknowns(self, weights: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """(G, S, A) active unknowns in N/m and N s/m, and their derivative by the model's outputs."""
        values, slope, _ = self.sensors.unknowns(self.state(weights))
        return values, slope

    def coordinates(self, weights: torch.Tensor) -> torch.Tensor:
        """(G, M, U, K) outputs of every member; zero where a member does not have an unknown."""
        import torch

        own = weights[:, 0, : self.n_outer].unflatten(-1, (len(self.active), -1)) * self.kept  # (G, A, K)
        members, n_unknowns = len(self.sensors.scale), self.sensors.scale.shape[-1]
        full = torch.zeros(len(weights), members, n_unknowns, self.features.shape[-1], dtype=weights.dtype)
        for a, (m, u) in enumerate(self.active):
            full[:, m, u] = own[:, a]
        return full

    def parameters(self, weights: torch.Tensor) -> torch.Tensor:
        """(G, M, Q) parameters of the coefficient model."""
        return self.basis.parameters_of(self.coordinates(weights))

    # --- from coefficients to the sensors -----------------------------------------------------------

    def predicted(self, weights: torch.Tensor) -> list[torch.Tensor]:
        """(G, S, P, R) m of every block."""
        return self.sensors.predicted(self.state(weights))

    def deviations(self, weights: torch.Tensor) -> list[torch.Tensor]:
        """(G, S, P, R) complex, whitened: predicted minus measured, of unit variance in each part."""
        return self.readings.deviations(self.state(weights))

    def rows(self, weights: torch.Tensor) -> torch.Tensor:
        """(G, 1, rows + Z + A), whitened; the priors come last, those of the coefficients' sizes at the very end."""
        import torch

        both = [self.readings.rows(self.state(weights)), self.weight_prior.rows(weights[:, 0])]
        return torch.cat(both, dim=-1)[:, None]

    def loss(self, weights: torch.Tensor) -> torch.Tensor:
        """(G, 1) root mean square of the whitened deviations: 1 where nothing but the stated noise is left."""
        return (self.rows(weights).square().sum(-1) / self.n_rows).sqrt()

    def rounding(self) -> torch.Tensor:
        """(1,) the loss that the readings round to."""
        return self.sensors.rounding()

    def jacobian(self, weights: torch.Tensor) -> torch.Tensor:
        """(G, 1, rows + Z + A, Z) derivative of :meth:`rows`, as it orders them: large; :meth:`normal` does without it
        where noise has no levels.
        """
        import torch

        priors = self.weight_prior.slopes().expand(len(weights), -1, -1)
        return torch.cat([self.readings.jacobian(self.state(weights)), priors], dim=1)[:, None]

    def normal(self, weights: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Gradient J'r (G, 1, Z) and J'J (G, 1, Z, Z).

        Weights that are not fitted have a gradient of 0 and 1 on the diagonal, so that a step leaves them.
        """
        import torch

        fitted = self.fitted()
        left = torch.diag((~fitted).to(weights.dtype))
        if self.readings.tied:
            slope = self.jacobian(weights)
            gradient = (slope.mT @ self.rows(weights)[..., None])[..., 0] * fitted
            return gradient, slope.mT @ slope * (fitted[:, None] & fitted) + left
        gradient, matrix = self.readings.normal(self.state(weights))
        gradient = gradient + self.weight_prior.gradient(weights[:, 0])
        return gradient[:, None], (matrix + self.weight_prior.matrix() + left)[:, None]

    def scatter(self) -> float:
        """None: the readings are weighed by their noise."""
        return 0.0

    def members(self) -> tuple[OutputError, ...]:
        """What is minimised by itself: all bearings together, since they speak through the same sensors."""
        return (self,)

    # --- fewer features ------------------------------------------------------------------------------

    def truncated(self, order: int) -> OutputError:
        """The same with the first ``order`` features alone, and weights that are as many fewer."""
        features, kept, prior = (one[..., :order] for one in (self.features, self.kept, self.prior))
        return replace(self, features=features, kept=kept, prior=prior)

    def with_features(self, weights: torch.Tensor, order: int) -> torch.Tensor:
        """The weights (G, 1, ..) of this problem as those of ``order`` features: cut, or filled up with zeros."""
        import torch

        own = weights[..., : self.n_outer].unflatten(-1, (len(self.active), -1))
        padded = torch.nn.functional.pad(own, (0, order - own.shape[-1])).flatten(-2)
        return torch.cat([padded, weights[..., self.n_outer :]], dim=-1)

    def revived(self, weights: torch.Tensor) -> torch.Tensor:
        """(0 or 1, 1, Z) the weights (1, 1, Z) with collapsed unknowns put back to their guess; none is collapsed: 0.

        What must be positive is an exponential: once it has all but vanished, nothing draws it back.
        """
        import torch

        values = self.unknowns(weights)[0][0].abs().median(dim=0).values  # (A,)
        positive = torch.tensor([self.basis.model.positive[u] for _, u in self.active])
        gone = positive & (values < COLLAPSED * torch.stack([self.sensors.scale[m, 0, u] for m, u in self.active]))
        if not gone.any():
            return weights[:0]
        own = weights[0, 0, : self.n_outer].unflatten(-1, (len(self.active), -1)) * ~gone[:, None]
        return torch.cat([own.flatten(), weights[0, 0, self.n_outer :]])[None, None]

    # --- other data ----------------------------------------------------------------------------------

    def with_prior(self, beyond_trend: float) -> OutputError:
        """The same with the prior of the basis, which is this wide."""
        return replace(self, prior=self.basis.prior_precision(self.features.shape[1], beyond_trend))

    def with_sensors(self, sensors: SensorDeviations) -> OutputError:
        """The same for other readings or precisions."""
        return replace(self, sensors=sensors)

    def update(self, weights: torch.Tensor) -> OutputError:
        """The same with the rotor solved anew at the model parameters of the weights (1, 1, Z), to first order until
        then.
        """
        if not self.n_parameters:
            return self
        measurement = self.measurement.update(self.model_parameters(weights)[0].numpy())
        made = sensor_deviations(measurement, self.basis.model, self.sensors.plane_scale, self.sensors.law)
        now = self.sensors
        return self.with_sensors(
            replace(made, scale=now.scale, precision=now.precision, common=now.common, measured=now.measured)
        )


def output_error(measurement: Measurement, basis: Basis, plane_scale: float) -> OutputError:
    """The problem at the speeds and runs of the measurement; ``plane_scale`` kg m is a weight of 1."""
    import torch

    laws, points, law = measurement.laws, measurement.dataset.points, None
    if laws is not None:
        law = law_term(laws, measurement.unknowns, points)
    sensors = sensor_deviations(measurement, basis.model, plane_scale, law)
    kept = torch.ones(len(sensors.active), basis.n_features, dtype=torch.bool)
    none = torch.zeros(basis.n_features, dtype=torch.float64)
    return OutputError(sensors, basis, basis.at(measurement.dataset.points), kept, none)
