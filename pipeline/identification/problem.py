"""One least-squares problem: what the sensors would read for given unknowns, against what they read, over their noise.

Under noise of the sensors its minimum is the maximum-likelihood estimate; the residual instead multiplies the noise by
the shaft's dynamic stiffness. The rows are whitened: with the right unknowns they have unit variance.

The unknowns are a flat vector of blocks (:mod:`pipeline.identification.blocks`): weights of the functions that the
coefficients are made of, numbers of bearing laws that these correct, residual unbalance, uncertain numbers of the model
(:mod:`pipeline.parameters.model`). A block that is not there has no columns.

The hidden layer of a network stays as it was drawn (random features; Rahimi and Recht 2007): the output layer is
linear, the estimate is then close to normal, and its covariance is that of the whole parametrisation. Trained hidden
layers have directions that the data leave undetermined, along which no linearised covariance holds. The weights are
those of an orthonormal basis of the features over the training speeds, of which each unknown has as many as the data
determine (:mod:`pipeline.identification.selection`); the others stay zero.

Uncertain numbers have a prior of unit variance, which is one more row: what the data do not tell of it stays at its
prior and widens the deviations. So have the features beyond the trend, a wide one, once it is chosen how many there
are: where the readings say nothing, a coefficient must not run away.

Legend: G data sets or starts, M members (bearings, or 1 where they share their coefficients), S speeds, P channels, R
runs, B bearings, U unknowns, A those of them that members have, K features, Th numbers of bearing laws, N balance
planes, T model parameters, Z = A K + Th + 2 N + T weights.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import TYPE_CHECKING, ClassVar, Self

import numpy as np

from pipeline.data.sensors import NoiseModel
from pipeline.identification.blocks import (
    Basis,
    LawTerm,
    Places,
    Prior,
    law_term,
    select_active,
    slopes_by_weights,
)
from pipeline.identification.identified import IdentifiedModel
from pipeline.identification.optimizers import LeastSquares
from pipeline.identification.readings import Readings, SensorModel, gather_readings, sensor_model
from pipeline.problem.baseline import find_baseline
from pipeline.problem.measurement import Measurement
from pipeline.problem.response import join_runs
from pipeline.problem.slopes import deviate, invert

if TYPE_CHECKING:
    import torch


@dataclass(frozen=True, eq=False, kw_only=True)
class OutputError(LeastSquares):
    """Least squares of the weights z, (G, 1, Z), at the speeds and runs of a measurement."""

    sensors: SensorModel
    readings: Readings
    basis: Basis
    features: torch.Tensor  # (M, S, K) at the speeds of the measurement
    origin: torch.Tensor  # (M, S, U) outputs of the model where the weights are zero
    kept: torch.Tensor  # (A, K) bool: the features that an unknown has
    precision: torch.Tensor  # (K,) or (A, K) of a feature's weight before the data; 0 for none
    scale: torch.Tensor  # (M, 1, U) what outputs of 1 stand for, N/m and N s/m
    plane_scale: float  # kg m that a weight of 1 stands for
    law: LawTerm  # what the model's outputs correct
    functions: Prior  # of the coefficients' weights: as functions of the speed
    n_unspent: int = 0  # how many of the weights follow no noise
    exact: bool = False  # the rotor is solved for the weights of each start, not to first order about those of the last
    carried: ClassVar = ("ask", "ak")  # axes of the carrier, where an output has its own weights, and of the numbers

    @property
    def measurement(self) -> Measurement:
        """Where the readings are from."""
        return self.sensors.measurement

    @property
    def active(self) -> tuple[tuple[int, int], ...]:
        """A of (member, unknown)."""
        return self.measurement.unknowns.active

    @cached_property
    def places(self) -> Places:
        """Where each block lies among the weights."""
        n_planes, n_parameters = len(self.measurement.unknowns.planes), len(self.measurement.parameters)
        return Places(self.kept.numel(), self.law.n_numbers, n_planes, n_parameters)

    @property
    def n_fitted(self) -> int:
        """How many weights are fitted: Z less the features that are not kept, and less the unspent ones."""
        return int(self.fitted().sum()) - self.n_unspent

    def fitted(self) -> torch.Tensor:
        """(Z,) bool: which weights are fitted."""
        import torch

        return torch.cat([self.kept.flatten(), torch.ones(self.places.n_rest, dtype=torch.bool)])

    @cached_property
    def prior(self) -> Prior:
        """That of features, theta about its guess, residual unbalance, model parameters (of unit variance), and sizes
        of coefficients.

        With ``guess.within`` the mean of a coefficient's output over the speeds has a prior about its guess: of the
        logarithm of that factor for what must be positive, of that many guesses otherwise.
        """
        import torch

        guess, unknowns = self.measurement.guess, self.measurement.unknowns
        planes = torch.full((2 * self.places.n_planes,), (self.plane_scale / guess.unbalance) ** 2, dtype=torch.float64)
        rest = [self.law.prior_precision(), planes, torch.ones(self.places.n_parameters)]
        precision = torch.cat([(self.precision * self.kept).flatten(), *rest]).to(self.precision.dtype)
        functions = torch.nn.functional.pad(self.functions.rows, (0, self.places.n_rest))
        rows = [torch.diag(precision.sqrt()), functions] if len(functions) else [torch.diag(precision.sqrt())]
        aims = [torch.zeros_like(precision), self.functions.aims]
        if guess.within is not None:
            sizes = guess.sizes(unknowns)
            for a, (m, u) in enumerate(unknowns.active):
                positive, share = self.basis.model.positive[u], float(sizes[m, u] / self.scale[m, 0, u])
                deviation = np.log(guess.within) if positive else guess.within * share
                row = torch.zeros(len(self.active), self.features.shape[-1], dtype=precision.dtype)
                row[a] = self._carrier[a].mean(0) / deviation
                rows.append(torch.nn.functional.pad(row.flatten(), (0, self.places.n_rest))[None])
                aims.append(torch.tensor([np.log(share) / deviation if positive else 0.0], dtype=precision.dtype))
        return Prior(torch.cat(rows), torch.cat(aims))

    def carrier(self, weights: torch.Tensor) -> torch.Tensor:
        """Derivative of the active outputs by the coefficients' numbers, with the axes :attr:`carried`."""
        return self._carrier

    @cached_property
    def _carrier(self) -> torch.Tensor:
        """(A, S, K) features of each unknown, zero where not kept."""
        return self.features[[m for m, _ in self.active]] * self.kept[:, None]

    # --- from weights to the machine -----------------------------------------------------------------

    def outputs(self, weights: torch.Tensor) -> torch.Tensor:
        """(G, M, S, U) outputs of the model."""
        return self.origin + self.features @ self.coordinates(weights).mT

    def coordinates(self, weights: torch.Tensor) -> torch.Tensor:
        """(G, M, U, K) weights of every member; zero where a member does not have an unknown."""
        import torch

        alone = weights[:, 0, self.places.coefficients].unflatten(-1, (len(self.active), -1)) * self.kept  # (G, A, K)
        members, n_unknowns = len(self.scale), self.scale.shape[-1]
        full = torch.zeros(len(weights), members, n_unknowns, self.features.shape[-1], dtype=weights.dtype)
        full[:, [m for m, _ in self.active], [u for _, u in self.active]] = alone
        return full

    def parameters(self, weights: torch.Tensor) -> torch.Tensor:
        """(G, M, Q) parameters of the coefficient model."""
        return self.basis.parameters_of(self.coordinates(weights))

    def theta(self, weights: torch.Tensor) -> torch.Tensor:
        """(G, Th) theta of the bearing laws."""
        return weights[:, 0, self.places.numbers]

    def unbalance(self, weights: torch.Tensor) -> torch.Tensor:
        """(G, N) complex residual unbalance, kg m."""
        import torch

        pairs = weights[:, 0, self.places.planes].unflatten(-1, (self.places.n_planes, 2))
        return self.plane_scale * torch.complex(pairs[..., 0], pairs[..., 1])

    def model_parameters(self, weights: torch.Tensor) -> torch.Tensor:
        """(G, T) model parameters, in prior deviations."""
        return weights[:, 0, self.places.parameters]

    def unknowns(self, weights: torch.Tensor, slopes: bool = True) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """(G, S, A) active unknowns in N/m and N s/m, their derivatives (G, S, A, A) by the model's outputs, and
        (G, S, A, Th) those by theta; derivatives of nothing (S is 0) where they may be left out (no ``slopes``).
        """
        every = self.law.correct(self.basis.model, self.theta(weights), self.outputs(weights), self.scale, slopes)
        return select_active(self.active, *every)

    def weigh(self, count: int = 1, **blocks: torch.Tensor) -> torch.Tensor:
        """(G, 1, Z) weights of ``count`` starts, from ``blocks`` by their names in :class:`Places`; else zero."""
        import torch

        weights = torch.zeros(count, 1, self.places.size, dtype=torch.float64)
        for name, block in blocks.items():
            weights[:, 0, getattr(self.places, name)] = block
        return weights

    # --- from the machine to the sensors -------------------------------------------------------------

    def predicted(self, weights: torch.Tensor) -> list[torch.Tensor]:
        """(G, S, P, R) m of every block."""
        sensors, parameters = (self.update(weights) if self.exact else self).sensors, self.model_parameters(weights)
        return sensors.predict(self.unknowns(weights, slopes=False)[0], self.unbalance(weights), parameters)

    def displacement(self, weights: torch.Tensor) -> np.ndarray:
        """(S, P, R) m as the data set has them, of the weights (1, 1, Z)."""
        return join_runs(self.readings.runs, [predicted[0].numpy() for predicted in self.predicted(weights)])

    def deviations(self, weights: torch.Tensor) -> list[torch.Tensor]:
        """(G, S, P, R) complex of every block, whitened: predicted minus measured, of unit variance in each part."""
        readings, whitened = self.readings, []
        for b, predicted in enumerate(self.predicted(weights)):
            off = (predicted - readings.measured[b]) * readings.precision[b]
            whitened.append(readings.mix(b, readings.whiten(b, off[..., None]))[..., 0])
        return whitened

    def _local(self, weights: torch.Tensor) -> Iterator[torch.Tensor]:
        """(G, S, P, R, A + Th + 2 N + T + 1) complex rows of each block: derivatives of the readings over their own
        noise by outputs, theta, parts of the residual unbalance and model parameters, and last what they deviate by.
        """
        import torch

        values, *slopes = self.unknowns(weights)
        sensors = (self.update(weights) if self.exact else self).sensors
        unbalance, parameters = self.unbalance(weights), self.model_parameters(weights)
        for b, precision in enumerate(self.readings.precision):
            expected, by_numbers, by_planes, by_parameters = sensors.derive(
                b, values, unbalance, parameters, torch.cat(slopes, dim=-1)
            )
            by_pairs = self.plane_scale * torch.stack([by_planes, 1j * by_planes], dim=-1).flatten(-2)
            off = (expected - self.readings.measured[b])[..., None]
            rows = torch.cat([by_numbers, by_pairs, by_parameters, off], dim=-1)
            yield self.readings.whiten(b, rows.mul_(precision[..., None]))  # in place: they are large

    # --- what is minimised ----------------------------------------------------------------------------

    def at(self, starts: torch.Tensor) -> Self:
        """That of some starts, each of which may weigh the readings by precisions of its own."""
        alike = len(self.readings.precision[0]) in (1, len(starts))
        return self if alike else replace(self, readings=self.readings.at(starts))

    def rows(self, weights: torch.Tensor) -> torch.Tensor:
        """(G, 1, rows + N), whitened; the priors come last."""
        import torch

        if self.exact and len(weights) > 1:
            return torch.cat([self.rows(start) for start in weights.split(1)])
        both = [torch.view_as_real(off).reshape(len(off), -1) for off in self.deviations(weights)]
        return torch.cat([*both, self.prior.deviations(weights[:, 0])], dim=-1)[:, None]

    def level(self, squared: torch.Tensor) -> torch.Tensor:
        """(G, 1) root mean square of the whitened deviations: 1 where nothing but the stated noise is left."""
        return (squared / self.readings.size).sqrt()

    def rounding(self, precision: float = 1e-13) -> torch.Tensor:
        """(1,) the loss that the readings round to: their size over their noise, times their ``precision``."""
        import torch

        pairs = zip(self.readings.measured, self.readings.precision, strict=True)
        squared = [(measured * weight).abs().square().sum((1, 2, 3)).max() for measured, weight in pairs]
        return precision * (torch.stack(squared).sum() / self.readings.size).sqrt()[None]

    def normal(self, weights: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Gradient J'r (G, 1, Z) and J'J (G, 1, Z, Z).

        Weights that are not fitted have a gradient of 0 and 1 on the diagonal, so that a step leaves them.
        """
        import torch

        if self.exact and len(weights) > 1:
            gradients, matrices = zip(*map(self.normal, weights.split(1)), strict=True)
            return torch.cat(gradients), torch.cat(matrices)
        whole = self._gather(weights)
        gradient, matrix = whole[:, :-1, -1], whole[:, :-1, :-1]
        left = torch.diag((~self.fitted()).to(weights.dtype))
        gradient = gradient + self.prior.gradient(weights[:, 0])
        return gradient[:, None], (matrix + (self.prior.information + left))[:, None]

    def _gather(self, weights: torch.Tensor) -> torch.Tensor:
        """(G, Z + 1, Z + 1) products of all columns, the deviations' last: each speed's are small, and spread over the
        features afterwards, so that no large derivative is made, unless noise ties the speeds.
        """
        import torch

        readings = self.readings
        # Noise may tie more than neighbouring speeds at which every run was measured.
        if readings.mixing or (readings.correlation and not self.measurement.dataset.complete):
            columns = self.columns(weights)
            return columns.mT @ columns
        local = [rows.flatten(2, 3) for rows in self._local(weights)]
        parts = torch.cat([real for rows in local for real in (rows.real, rows.imag)], dim=2)
        alone, tie = parts.mT @ parts, readings.correlation
        if tie == 0:
            return self._spread(alone, weights)
        # The inverse of a correlation that falls with each step is tridiagonal.
        inner = alone[:, 1:-1] * (1 + tie**2)
        diagonal = torch.cat([alone[:, :1], inner, alone[:, -1:]], dim=1) / (1 - tie**2)
        beside = parts[:, 1:].mT @ parts[:, :-1]
        across = self._spread(-tie / (1 - tie**2) * beside, weights, 1)
        return self._spread(diagonal, weights) + across + across.mT

    def _spread(self, local: torch.Tensor, weights: torch.Tensor, after: int = 0) -> torch.Tensor:
        """(G, Z + 1, Z + 1) from products (G, S, A + .. + 1, A + .. + 1) of each speed, or of each with the one before
        (``after`` is 1).
        """
        import torch

        carrier, n_active, (place, number) = self.carrier(weights), len(self.active), self.carried
        later, before = carrier[:, after:], carrier[:, : carrier.shape[1] - after]
        right = torch.einsum(f"{place},gsan->g{number}n", later, local[:, :, :n_active, n_active:])
        left = torch.einsum(f"{place},gsna->gn{number}", before, local[:, :, n_active:, :n_active])
        within = self._spread_outputs(local[:, :, :n_active, :n_active], later, before)
        below = torch.cat([left.flatten(2), local[:, :, n_active:, n_active:].sum(1)], dim=-1)
        return torch.cat([torch.cat([within, right.flatten(1, 2)], dim=-1), below], dim=1)

    def _spread_outputs(self, local: torch.Tensor, later: torch.Tensor, before: torch.Tensor) -> torch.Tensor:
        """(G, A K, A K) of the coefficients' numbers, from products (G, S, A, A) of the outputs, and the carriers.

        All outputs of two members have the same products of features.
        """
        import torch

        member, kept = torch.tensor([m for m, _ in self.active]), self.kept.flatten()
        sizes, lines = [self.features.shape[-1]] * 2, []
        for m in range(len(self.features)):  # the active unknowns follow each other member by member
            line = []
            for n in range(len(self.features)):
                pairs = self.features[m, -later.shape[1] :, :, None] * self.features[n, : before.shape[1], None]
                between = local[:, :, member == m][..., member == n].movedim(1, -1)  # (G, a, b, S)
                products = between @ pairs.flatten(1)  # (G, a, b, K K): an einsum would take twice as long
                line.append(products.unflatten(-1, sizes).transpose(2, 3).flatten(3))
            lines.append(torch.cat(line, dim=3).flatten(1, 2))
        return torch.cat(lines, dim=1) * (kept[:, None] & kept)

    def columns(self, weights: torch.Tensor) -> torch.Tensor:
        """(G, rows, Z + 1) derivative of the readings' rows by the weights, and the rows themselves: large."""
        import torch

        # (G, S, P, R, 2, Z + 1): both parts of a reading, as in the rows
        every = [torch.view_as_real(block).movedim(-1, -2).flatten(1, 4) for block in self.columns_of_blocks(weights)]
        return torch.cat(every, dim=1)

    def columns_of_blocks(self, weights: torch.Tensor) -> list[torch.Tensor]:
        """(G, S, P, R, Z + 1) complex of every block, as :meth:`columns`."""
        import torch

        blocks, carrier, (place, number) = [], self.carrier(weights).to(torch.complex128), self.carried
        for b, local in enumerate(self._local(weights)):
            by_output, rest = local[..., : len(self.active)], local[..., len(self.active) :]
            by_number = torch.einsum(f"gspra,{place}->gspr{number}", by_output, carrier).flatten(-2)
            blocks.append(self.readings.mix(b, torch.cat([by_number, rest], dim=-1)))
        return blocks

    # --- what is known of the weights --------------------------------------------------------------------

    def covariance(self, weights: torch.Tensor) -> np.ndarray:
        """(G, Z, Z) inverse of the information at the weights (G, 1, Z); zero for those that are not fitted."""
        fitted = self.fitted().numpy()
        return np.asarray(invert(self.normal(weights)[1][:, 0]) * (fitted[:, None] & fitted))

    def identified(self, weights: torch.Tensor) -> IdentifiedModel:
        """The coefficients of ``weights`` (1, 1, Z) at any speed."""
        measurement, parameters, theta = self.measurement, self.parameters(weights)[0], self.theta(weights)[0]
        nodes = measurement.rotor.bearing_nodes
        return IdentifiedModel(self.basis.model, measurement.unknowns, nodes, parameters, measurement.laws, theta)

    def unknown_deviation(self, weights: torch.Tensor) -> np.ndarray:
        """(G, S, A) standard deviation of the active unknowns, N/m and N s/m, by :meth:`covariance`."""
        count = self.places.numbers.stop
        return deviate(self.unknown_slopes(weights), self.covariance(weights)[:, None, :count, :count])

    def unknown_slopes(self, weights: torch.Tensor) -> np.ndarray:
        """(G, S, A, A K + Th) derivative of the active unknowns by the weights of features and the numbers of laws."""
        return slopes_by_weights(*self.unknowns(weights)[1:], self._carrier)

    # --- fewer features ------------------------------------------------------------------------------

    def truncated(self, order: int) -> OutputError:
        """The same with the first ``order`` features alone, and weights that are as many fewer."""
        features, kept, precision = (every[..., :order] for every in (self.features, self.kept, self.precision))
        return replace(self, features=features, kept=kept, precision=precision)

    def with_features(self, weights: torch.Tensor, order: int) -> torch.Tensor:
        """The weights (G, 1, ..) of this problem as those of ``order`` features: cut, or filled up with zeros."""
        import torch

        alone = weights[..., self.places.coefficients].unflatten(-1, (len(self.active), -1))
        padded = torch.nn.functional.pad(alone, (0, order - alone.shape[-1])).flatten(-2)
        return torch.cat([padded, weights[..., self.places.n_coefficients :]], dim=-1)

    # --- other data ----------------------------------------------------------------------------------

    def scaled(self, share: torch.Tensor | float) -> OutputError:
        """The same with readings whose precision is this ``share`` of what it was."""
        return replace(self, readings=self.readings.scaled(share))

    def correlated(self, correlation: float) -> OutputError:
        """The same with noise that correlates like this from speed to speed."""
        return replace(self, readings=replace(self.readings, correlation=correlation))

    def with_noise(
        self, noise: NoiseModel, predicted: Sequence[torch.Tensor], factor: np.ndarray | float = 1.0
    ) -> Self:
        """The same with readings of another noise, of the size that ``predicted`` ones have."""
        measurement = replace(self.measurement, noise=noise)
        readings = replace(self.readings, measurement=measurement).follow(predicted, factor, self.readings.shares)
        return replace(self, sensors=replace(self.sensors, measurement=measurement), readings=readings)

    def with_baseline(self, weights: torch.Tensor) -> OutputError:
        """The same with the machine's unbalance as the weights (1, 1, Z) make it of the baseline that was taken off."""
        made = self.law.correct(self.basis.model, self.theta(weights), self.outputs(weights), self.scale)[0]
        measurement, values = self.measurement, self.model_parameters(weights)[0].numpy()
        found = find_baseline(measurement.update(values), measurement.table(made[0].numpy()))
        return replace(self, sensors=sensor_model(replace(measurement, as_found=found))) if found else self

    def update(self, weights: torch.Tensor) -> OutputError:
        """The same with the rotor solved anew at the model parameters of the weights (1, 1, Z), to first order until
        then.
        """
        if not self.places.n_parameters:
            return self
        return replace(self, sensors=_solve(self.measurement, tuple(self.model_parameters(weights)[0].tolist())))


@lru_cache(maxsize=8)
def _solve(measurement: Measurement, values: tuple[float, ...]) -> SensorModel:
    """At these model parameters; kept, since a step is judged and then begun there."""
    return sensor_model(measurement.update(values))


def output_error(measurement: Measurement, basis: Basis, plane_scale: float) -> OutputError:
    """The problem at the speeds and runs of the measurement; ``plane_scale`` kg m is a weight of 1."""
    import torch

    points = measurement.dataset.points
    return OutputError(
        sensors=sensor_model(measurement),
        readings=gather_readings(measurement),
        basis=basis,
        features=basis.at(points),
        origin=basis.origin(points),
        kept=torch.ones(len(measurement.unknowns.active), basis.n_features, dtype=torch.bool),
        precision=torch.zeros(basis.n_features, dtype=torch.float64),
        scale=basis.model.scale_tensor(),
        functions=Prior(torch.zeros(0, 0, dtype=torch.float64), torch.zeros(0, dtype=torch.float64)),
        plane_scale=plane_scale,
        law=law_term(measurement.laws, measurement.unknowns, points),
    )
