"""The output error of networks all of whose weights are trained: its rows and normal equations.

Legend: G networks, M members (bearings, or 1 where they share their coefficients), Q parameters of a member, S speeds,
A unknowns that members have, N balance planes, T model parameters, Y = M Q + 2 N + T numbers.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from pipeline.identification.sensor_deviations import SensorDeviations, SensorState

if TYPE_CHECKING:
    import torch


@dataclass(frozen=True, eq=False)
class TrainedNetworks:
    """Least squares of numbers (G, 1, Y): parameters of the members, residual unbalance, model parameters.

    Each of the G networks may weigh the readings by precisions of its own.
    """

    sensors: SensorDeviations
    inputs: torch.Tensor  # (S, 1), scaled
    prior: torch.Tensor  # (G, T) where the priors of the model parameters lie

    @property
    def n_outer(self) -> int:
        """M Q: how many numbers are the networks'; they come first."""
        return len(self.sensors.scale) * self.sensors.model.n_parameters

    def networks(self, numbers: torch.Tensor) -> torch.Tensor:
        """(G, M, Q) parameters of the coefficient model."""
        import torch

        return torch.unflatten(numbers[:, 0, : self.n_outer], -1, (len(self.sensors.scale), -1))

    def state(self, numbers: torch.Tensor) -> SensorState:
        """What the readings follow from."""
        import torch

        last = self.n_outer + 2 * self.sensors.n_planes
        pairs = numbers[:, 0, self.n_outer : last].unflatten(-1, (self.sensors.n_planes, 2))
        unbalance = self.sensors.plane_scale * torch.complex(pairs[..., 0], pairs[..., 1])
        outputs = self.sensors.model.raw(self.networks(numbers), self.inputs)
        return SensorState(outputs, unbalance, numbers[:, 0, last:])

    def rows(self, numbers: torch.Tensor) -> torch.Tensor:
        """(G, 1, rows + T), whitened; the priors come last."""
        import torch

        state = self.state(numbers)
        parts = [torch.view_as_real(d).reshape(len(numbers), -1) for d in self.sensors.deviations(state)]
        return torch.cat([*parts, state.parameters - self.prior], dim=-1)[:, None]

    def loss(self, numbers: torch.Tensor) -> torch.Tensor:
        """(G, 1) root mean square of the whitened deviations, over all readings."""
        return (self.rows(numbers).square().sum(-1) / self.sensors.n_rows).sqrt()

    def rounding(self) -> torch.Tensor:
        """(1,) the loss that the readings round to."""
        return self.sensors.rounding()

    def scatter(self) -> float:
        """None: the readings are weighed by their noise."""
        return 0.0

    def members(self) -> tuple[TrainedNetworks, ...]:
        """One: the readings follow from all bearings together."""
        return (self,)

    def normal(self, numbers: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Gradient J'r (G, 1, Y) and J'J (G, 1, Y, Y), summed speed by speed: no network sees another bearing's."""
        import torch

        state, networks = self.state(numbers), self.networks(numbers)
        parts = [self.sensors.derivatives(state, b) for b in range(len(self.sensors.blocks))]
        count = parts[0][1].shape[-1]
        # The rows of a speed by its outputs and by the rest: (G, S, A + 2 N + T + 1, the same), the deviations last.
        stacked = [torch.cat([by_output, by_rest, rows], dim=-1) for rows, by_output, by_rest in parts]
        local = torch.stack([one.mT @ one for one in stacked]).sum(0)
        jacobian = self.sensors.model.raw_jacobian(networks, self.inputs)  # (G, M, S, U, Q)
        members, size = networks.shape[1:]
        own = [[a for a, (m, _) in enumerate(self.sensors.active) if m == member] for member in range(members)]
        slopes = [
            jacobian[:, m][:, :, [self.sensors.active[a][1] for a in of]].flatten(1, 2) for m, of in enumerate(own)
        ]  # (G, S A of the member, Q)
        last = numbers.shape[-1]
        whole = torch.zeros(len(numbers), last + 1, last + 1, dtype=numbers.dtype)  # the gradient is its last column
        whole[:, self.n_outer :, self.n_outer :] = local[:, :, count:, count:].sum(1)
        for m, (rows, slope) in enumerate(zip(own, slopes, strict=True)):
            here = slice(m * size, (m + 1) * size)
            whole[:, here, self.n_outer :] = slope.mT @ local[:, :, rows, count:].flatten(1, 2)
            for other in range(m, members):
                there = slice(other * size, (other + 1) * size)
                across = local[:, :, rows][..., own[other]] @ slopes[other].unflatten(1, (-1, len(own[other])))
                whole[:, here, there] = slope.mT @ across.flatten(1, 2)
                whole[:, there, here] = whole[:, here, there].mT
        matrix, gradient = whole[:, :last, :last].clone(), whole[:, :last, last].clone()
        matrix[:, self.n_outer :, : self.n_outer] = matrix[:, : self.n_outer, self.n_outer :].mT
        priors = range(last - self.sensors.n_parameters, last)
        matrix[:, priors, priors] += 1.0
        gradient[:, priors] += state.parameters - self.prior
        return gradient[:, None], matrix[:, None]
