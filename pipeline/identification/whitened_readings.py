"""The readings' whitened rows, and what they say of the weights that coefficients are linear in.

Legend: G data sets or starts, S speeds, P channels, R runs, A active unknowns, K features, N balance planes, T model
parameters, Th numbers of bearing laws, Z = A K + Th + 2 N + T weights.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

from pipeline.identification.sensor_deviations import SensorDeviations, SensorState

if TYPE_CHECKING:
    import torch


@dataclass(frozen=True, eq=False)
class WhitenedReadings:
    """Predicted minus measured readings over their noise, also where noise ties probes and speeds together."""

    sensors: SensorDeviations
    features: torch.Tensor  # (A, S, K) of each unknown, zero where not kept

    @property
    def tied(self) -> bool:
        """Whether noise ties the speeds together."""
        return self._mixing is not None

    @property
    def n_outer(self) -> int:
        """A K."""
        return self.features.shape[0] * self.features.shape[-1]

    def deviations(self, state: SensorState) -> list[torch.Tensor]:
        """(G, S, P, R) complex of every block, of unit variance in each part."""
        every = self.sensors.deviations(state)
        return [self._mix(b, one[..., None])[..., 0] for b, one in enumerate(every)]

    @cached_property
    def _mixing(self) -> torch.Tensor | None:
        """(R, S P, S P) see :meth:`pipeline.problem.condition_noise.ConditionNoise.mixing`; None without levels."""
        import torch

        drift = self.sensors.measurement.drift
        return None if drift is None else torch.as_tensor(drift.mixing())

    def _mix(self, b: int, rows: torch.Tensor) -> torch.Tensor:
        """Rows (G, S, P, R, n) of block b over their own deviations, without what probes and speeds share."""
        import torch

        if self._mixing is None:
            return rows
        own = self._mixing[torch.as_tensor(self.sensors.blocks[b].runs)]
        mixed: torch.Tensor = torch.einsum("rij,gjrn->girn", own, rows.flatten(1, 2)).unflatten(1, rows.shape[1:3])
        return mixed

    def rows(self, state: SensorState) -> torch.Tensor:
        """(G, rows) both parts of the deviations, one after the other."""
        import torch

        deviations = self.deviations(state)
        return torch.cat(
            [torch.view_as_real(deviation).reshape(len(deviation), -1) for deviation in deviations], dim=-1
        )

    def jacobian(self, state: SensorState) -> torch.Tensor:
        """(G, rows, Z) derivative of the rows by the weights."""
        import torch

        parts = []
        for b in range(len(self.sensors.blocks)):
            _, by_output, by_rest = self.sensors.derivatives(state, b)
            full = torch.cat([torch.einsum("gsda,ask->gsdak", by_output, self.features).flatten(-2), by_rest], dim=-1)
            real, imaginary = full.unflatten(2, (2, -1)).unbind(2)  # (G, S, P R, Z)
            rows = torch.complex(real, imaginary).unflatten(2, (self.sensors.measured[b].shape[-2], -1))
            both = torch.view_as_real(self._mix(b, rows)).movedim(-1, -2)  # (G, S, P, R, 2, Z), as the rows are
            parts.append(both.flatten(1, 4))
        return torch.cat(parts, dim=1)

    def normal(self, state: SensorState) -> tuple[torch.Tensor, torch.Tensor]:
        """Gradient J'r (G, Z) and J'J (G, Z, Z), summed speed by speed: only where noise does not tie them.

        The features are the same in all rows, so that no large derivative is made.
        """
        import torch

        own, outer, count = self.features, self.n_outer, self.features.shape[-1]
        size = outer + self.sensors.n_rest
        gradient = torch.zeros(len(state.outputs), size, dtype=state.outputs.dtype)
        matrix = torch.zeros(len(state.outputs), size, size, dtype=state.outputs.dtype)
        for b in range(len(self.sensors.blocks)):
            right, by_output, by_rest = self.sensors.derivatives(state, b)
            local = by_output.mT @ by_output  # (G, S, A, A)
            gradient[:, :outer] += torch.einsum("gsa,ask->gak", (by_output.mT @ right)[..., 0], own).flatten(1)
            for a in range(len(own)):
                weighted = own[a][None, :, :, None] * local[:, :, a, None, :]  # (G, S, K, A)
                rows = slice(a * count, (a + 1) * count)
                matrix[:, rows, :outer] += torch.einsum("gskc,csl->gkcl", weighted, own).flatten(2)
            if size > outer:
                mixed = torch.einsum("gsan,ask->gakn", by_output.mT @ by_rest, own).flatten(1, 2)
                matrix[:, :outer, outer:] += mixed
                matrix[:, outer:, :outer] += mixed.mT
                matrix[:, outer:, outer:] += (by_rest.mT @ by_rest).sum(1)
                gradient[:, outer:] += (by_rest.mT @ right).sum(1)[..., 0]
        return gradient, matrix
