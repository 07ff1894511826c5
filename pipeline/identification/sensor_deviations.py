"""What the sensors would read for given coefficients, against what they read, over their noise: values and derivatives.

Under noise of the sensors the minimum of its squares is the maximum-likelihood estimate, whatever functions of the
speed the coefficients are (:mod:`pipeline.identification.output_error`), or each speed by itself.

Legend: G data sets or starts, M members (bearings, or 1 where they share their coefficients), S speeds, P channels, R
runs, B bearings, U unknowns, A those of them that members have, N balance planes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from pipeline.identification.model import CoefficientModel
from pipeline.problem.measurement import Measurement
from pipeline.problem.response import BlockResponse, ResponseBlock, derive, impedance_change, respond

if TYPE_CHECKING:
    import torch

_ROUNDING = 1e-13


@dataclass(frozen=True, eq=False, kw_only=True)
class SensorDeviations:
    """The deviations of predicted from measured readings, at the speeds and runs of a measurement.

    They are whitened: with the right coefficients they have unit variance in each part.
    """

    measurement: Measurement
    model: CoefficientModel
    scale: torch.Tensor  # (M, 1, U)
    influence: torch.Tensor  # (8 B, A) which coefficients each active unknown moves
    known: torch.Tensor  # (S, 8 B) N/m and N s/m: the other coefficients, zero where identified
    plane_scale: float  # kg m that a weight of 1 stands for
    blocks: tuple[ResponseBlock, ...]  # of tensors
    measured: tuple[torch.Tensor, ...]  # (G or 1, S, P, R of the block) m
    precision: tuple[torch.Tensor, ...]  # likewise, 1/m: root of 2 over the deviation, so that both parts count

    @property
    def active(self) -> tuple[tuple[int, int], ...]:
        """A of (member, unknown)."""
        return self.measurement.unknowns.active

    @property
    def n_planes(self) -> int:
        """N."""
        return len(self.measurement.unknowns.planes)

    @property
    def n_rows(self) -> int:
        """Real numbers that were measured."""
        return 2 * sum(precision[0].numel() for precision in self.precision)

    def unknowns(self, outputs: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """(G, S, A) active unknowns in N/m and N s/m, and their derivative by the model's outputs (G, M, S, U)."""
        member, unknown = [m for m, _ in self.active], [u for _, u in self.active]
        both = (self.model.physical(outputs, self.scale), self.model.physical_slope(outputs, self.scale))
        values, slope = (of[:, member, :, unknown].movedim(0, -1) for of in both)
        return values, slope

    def _respond(
        self, unknowns: torch.Tensor, unbalance: torch.Tensor | None, block: ResponseBlock, derivative: bool
    ) -> BlockResponse:
        eight = (unknowns @ self.influence.T + self.known).unflatten(-1, (-1, 8))  # (G, S, B, 8)
        change = impedance_change(eight, block.frequencies, self.measurement.response.reference)
        return respond(block, change, unbalance, derivative)

    def predicted(self, outputs: torch.Tensor, unbalance: torch.Tensor | None) -> list[torch.Tensor]:
        """(G, S, P, R) m of every block; ``unbalance`` (G, N) complex, kg m."""
        unknowns, _ = self.unknowns(outputs)
        return [self._respond(unknowns, unbalance, block, derivative=False).sensors for block in self.blocks]

    def deviations(self, outputs: torch.Tensor, unbalance: torch.Tensor | None) -> list[torch.Tensor]:
        """(G, S, P, R) complex of every block: predicted minus measured, over the noise."""
        every = zip(self.predicted(outputs, unbalance), self.measured, self.precision, strict=True)
        return [(predicted - measured) * precision for predicted, measured, precision in every]

    def derivatives(
        self, outputs: torch.Tensor, unbalance: torch.Tensor | None, b: int
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Real rows of block b, (G, S, 2 P R, 1), and their derivatives by outputs (.., A) and planes (.., 2 N)."""
        import torch

        block, precision = self.blocks[b], self.precision[b]
        unknowns, slope = self.unknowns(outputs)
        found = self._respond(unknowns, unbalance, block, derivative=True)
        by_coefficient = derive(block, found).flatten(-2)  # (G, S, P, R, 8 B)
        derivative = (by_coefficient @ self.influence.to(by_coefficient.dtype)) * slope[:, :, None, None]
        derivative = (derivative * precision[..., None]).flatten(2, 3)
        deviation = ((found.sensors - self.measured[b]) * precision).flatten(2)
        by_planes = derivative[..., :0]
        if self.n_planes:
            own = torch.zeros(*found.sensors.shape, self.n_planes, dtype=found.sensors.dtype)
            if found.unit_sensors.shape[-1]:
                own = found.unit_sensors[:, :, :, None, :].expand(own.shape) * precision[..., None]
            own = self.plane_scale * own.flatten(2, 3)
            by_planes = torch.stack([own, 1j * own], dim=-1).flatten(-2)
        rows, by_outputs, planes = (
            torch.cat([part.real, part.imag], dim=2) for part in (deviation[..., None], derivative, by_planes)
        )
        return rows, by_outputs, planes

    def rounding(self) -> torch.Tensor:
        """(1,) the loss that the readings round to: their size over their noise, times their precision."""
        import torch

        pairs = zip(self.measured, self.precision, strict=True)
        squared = [(measured * precision).abs().square().sum((1, 2, 3)).max() for measured, precision in pairs]
        return _ROUNDING * (torch.stack(squared).sum() / self.n_rows).sqrt()[None]

    def to(self, device: str) -> SensorDeviations:
        """The same on another device, to be used under ``torch.device(device)``."""

        def move(tensor: torch.Tensor) -> torch.Tensor:
            return tensor.to(device)

        return replace(
            self,
            scale=move(self.scale),
            influence=move(self.influence),
            known=move(self.known),
            blocks=tuple(block.converted(move) for block in self.blocks),
            measured=tuple(map(move, self.measured)),
            precision=tuple(map(move, self.precision)),
        )

    def with_measured(self, measured: Sequence[torch.Tensor]) -> SensorDeviations:
        """The same for other readings (G, S, P, R) of each block."""
        return replace(self, measured=tuple(measured))


def sensor_deviations(measurement: Measurement, model: CoefficientModel, plane_scale: float) -> SensorDeviations:
    """The deviations at the speeds and runs of the measurement."""
    import torch

    unknowns, speeds = measurement.unknowns, measurement.dataset.speeds
    n_coefficients = unknowns.influence.shape[0] * unknowns.influence.shape[1]
    others = np.where(unknowns.identified[:, None], 0.0, measurement.known.values)  # (B, S, 8)
    blocks = tuple(block.converted(torch.as_tensor) for block in measurement.response.blocks)
    displacement, precision = measurement.dataset.displacement, np.sqrt(2.0) / measurement.deviation
    return SensorDeviations(
        measurement=measurement,
        model=model,
        scale=model.scale_tensor(),
        influence=torch.as_tensor(unknowns.influence.reshape(n_coefficients, -1)),
        known=torch.as_tensor(others.swapaxes(0, 1).reshape(len(speeds), -1)),
        plane_scale=plane_scale,
        blocks=blocks,
        measured=tuple(torch.as_tensor(displacement[None][..., block.runs]) for block in blocks),
        precision=tuple(torch.as_tensor(precision[None][..., block.runs]) for block in blocks),
    )
