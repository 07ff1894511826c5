"""What the sensors read for given coefficients, residual unbalance and model parameters: values and derivatives.

Legend: G data sets or starts, S speeds, P channels, R runs of a block, B bearings, A active unknowns, N balance planes,
T model parameters.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from pipeline.problem.measurement import Measurement
from pipeline.problem.response import (
    ResponseBlock,
    derive,
    derive_by_parameters,
    impedance_change,
    respond,
)

if TYPE_CHECKING:
    import torch


class Derivatives(NamedTuple):
    """Readings of a block, m, and their derivatives."""

    readings: torch.Tensor  # (G, S, P, R)
    by_unknowns: torch.Tensor  # (G, S, P, R, A)
    by_planes: torch.Tensor  # (G, S, P, R, N) by 1 kg m
    by_parameters: torch.Tensor  # (G, S, P, R, T)


@dataclass(frozen=True, eq=False)
class SensorModel:
    """The response of a measurement's rotor, of first order in the model parameters about those it was solved at."""

    measurement: Measurement
    blocks: tuple[ResponseBlock, ...]  # of tensors

    @cached_property
    def solved_at(self) -> torch.Tensor:
        """(T,) model parameters."""
        import torch

        return torch.as_tensor(self.measurement.parameter_values)

    @cached_property
    def _influence(self) -> torch.Tensor:
        """(8 B, A) which coefficients each active unknown moves."""
        import torch

        influence = self.measurement.unknowns.influence
        return torch.as_tensor(influence.reshape(influence.shape[0] * influence.shape[1], -1))

    @cached_property
    def _known(self) -> tuple[torch.Tensor, torch.Tensor]:
        """(S, 8 B) N/m and N s/m, the other coefficients, zero where identified; (S, 8 B, T) their derivative."""
        import torch

        measurement, n_speeds = self.measurement, len(self.measurement.dataset.speeds)
        others = np.where(measurement.unknowns.identified[:, None], 0.0, measurement.updated_known.values)  # (B, S, 8)
        slopes = measurement.known_variation.reshape(n_speeds, len(self._influence), len(self.solved_at))
        return torch.as_tensor(others.swapaxes(0, 1).reshape(n_speeds, -1)), torch.as_tensor(slopes)

    @cached_property
    def _variations(self) -> tuple[ResponseBlock, ...]:
        """The blocks' derivatives by the model parameters; none where there are none."""
        import torch

        return tuple(block.converted(torch.as_tensor) for block in self.measurement.variations)

    def _bearings(self, values: torch.Tensor, shift: torch.Tensor, block: ResponseBlock) -> torch.Tensor:
        """dH, (G, S, 2 B, 2 B) N/m."""
        known, by_parameters = self._known
        known = known + (by_parameters @ shift[:, None, :, None])[..., 0]
        eight = (values @ self._influence.T + known).unflatten(-1, (-1, 8))  # (G, S, B, 8)
        change: torch.Tensor = impedance_change(eight, block.frequencies, self.measurement.response.reference)
        return change

    def _block(self, b: int, shift: torch.Tensor) -> ResponseBlock:
        """Block b at parameters that lie (G, T) from where it was solved."""
        return self.blocks[b].vary(self._variations[b], shift) if self._variations else self.blocks[b]

    def predict(self, values: torch.Tensor, unbalance: torch.Tensor, parameters: torch.Tensor) -> list[torch.Tensor]:
        """(G, S, P, R) m of every block.

        Args:
            values: (G, S, A) active unknowns, N/m and N s/m.
            unbalance: (G, N) complex, kg m.
            parameters: (G, T) in prior deviations.
        """
        shift, readings = parameters - self.solved_at, []
        for b in range(len(self.blocks)):
            block = self._block(b, shift)
            readings.append(respond(block, self._bearings(values, shift, block), unbalance, False).sensors)
        return readings

    def derive(self, b: int, values: torch.Tensor, unbalance: torch.Tensor, parameters: torch.Tensor) -> Derivatives:
        """Readings of block b, and their derivatives, by what :meth:`predict` takes."""
        import torch

        shift = parameters - self.solved_at
        block = self._block(b, shift)
        change = self._bearings(values, shift, block)
        response = respond(block, change, unbalance)
        by_coefficient = derive(block, response).flatten(-2)  # (G, S, P, R, 8 B)
        shape, kind = response.sensors.shape, by_coefficient.dtype
        by_planes = torch.zeros(*shape, unbalance.shape[-1], dtype=kind)
        if response.unit_sensors.shape[-1]:
            by_planes = response.unit_sensors[:, :, :, None, :].expand(by_planes.shape)
        by_parameters = torch.zeros(*shape, len(self.solved_at), dtype=kind)
        if self._variations:
            by_model = derive_by_parameters(self._variations[b], response, change, unbalance)
            by_parameters = by_model + by_coefficient @ self._known[1].to(kind)[:, None]
        return Derivatives(response.sensors, by_coefficient @ self._influence.to(kind), by_planes, by_parameters)


def sensor_model(measurement: Measurement) -> SensorModel:
    """That of a measurement, at the values of its model parameters."""
    import torch

    return SensorModel(measurement, tuple(block.converted(torch.as_tensor) for block in measurement.response.blocks))
