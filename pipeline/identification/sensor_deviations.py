"""What the sensors would read for given coefficients, against what they read, over their noise: values and derivatives.

Under noise of the sensors the minimum of its squares is the maximum-likelihood estimate, whatever functions of the
speed the coefficients are (:mod:`pipeline.identification.output_error`), or each speed by itself.

Legend: G data sets or starts, M members (bearings, or 1 where they share their coefficients), S speeds, P channels, R
runs, B bearings, U unknowns, A those of them that members have, Th numbers of bearing laws, N balance planes, T model
parameters.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from pipeline.identification.law_term import LawTerm
from pipeline.identification.model import CoefficientModel
from pipeline.problem.measurement import Measurement
from pipeline.problem.response import (
    BlockResponse,
    ResponseBlock,
    derive,
    derive_by_parameters,
    impedance_change,
    respond,
)

if TYPE_CHECKING:
    import torch

_ROUNDING = 1e-13
_TINY = 1e-30


class SensorState(NamedTuple):
    """What the readings follow from."""

    outputs: torch.Tensor  # (G, M, S, U) of the coefficient model
    unbalance: torch.Tensor  # (G, N) complex residual unbalance, kg m
    parameters: torch.Tensor  # (G, T) model parameters, in prior deviations
    numbers: torch.Tensor | None = None  # (G, Th) theta of the bearing laws; None without them


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
    variations: tuple[ResponseBlock, ...]  # their derivatives by the model parameters; none where there are none
    known_variation: torch.Tensor  # (S, 8 B, T) derivative of ``known``
    values: torch.Tensor  # (T,) the parameters at which both are
    measured: tuple[torch.Tensor, ...]  # (G or 1, S, P, R of the block) m
    precision: tuple[torch.Tensor, ...]  # likewise, 1/m: root of 2 over the reading's own deviation: both parts count
    common: tuple[torch.Tensor, ...]  # likewise, a subtracted baseline's deviation over the own one; none without
    law: LawTerm | None  # what the model's outputs correct; None for the scale

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
        return 2 * self.measurement.dataset.n_readings

    @property
    def n_numbers(self) -> int:
        """Th."""
        return 0 if self.law is None else self.law.n_numbers

    def unknowns(self, state: SensorState) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """(G, S, A) active unknowns in N/m and N s/m, their derivative by the model's outputs, and (G, S, A, Th) that
        by theta.
        """
        import torch

        member, unknown = [m for m, _ in self.active], [u for _, u in self.active]
        outputs, scale = state.outputs, self.scale
        if self.law is not None and state.numbers is not None:
            values, slope, by_numbers = self.law.correct(self.model, state.numbers, outputs, scale)
        else:
            values, slope = self.model.physical(outputs, scale), self.model.physical_slope(outputs, scale)
            by_numbers = torch.zeros(*outputs.shape, 0, dtype=outputs.dtype)
        values, slope = (of[:, member, :, unknown].movedim(0, -1) for of in (values, slope))
        return values, slope, by_numbers[:, member, :, unknown].movedim(0, -2)

    @property
    def n_parameters(self) -> int:
        """T."""
        return len(self.values)

    @property
    def n_rest(self) -> int:
        """Th + 2 N + T: how many weights follow those of the coefficients."""
        return self.n_numbers + 2 * self.n_planes + self.n_parameters

    def _bearings(self, state: SensorState, block: ResponseBlock) -> torch.Tensor:
        """dH, (G, S, 2 B, 2 B) N/m."""
        known = self.known
        if self.n_parameters:
            known = known + (self.known_variation @ (state.parameters - self.values)[:, None, :, None])[..., 0]
        unknowns, _, _ = self.unknowns(state)
        eight = (unknowns @ self.influence.T + known).unflatten(-1, (-1, 8))  # (G, S, B, 8)
        change: torch.Tensor = impedance_change(eight, block.frequencies, self.measurement.response.reference)
        return change

    def _block(self, state: SensorState, b: int) -> ResponseBlock:
        """Block b at the state's model parameters."""
        if not self.n_parameters:
            return self.blocks[b]
        return self.blocks[b].vary(self.variations[b], state.parameters - self.values)

    def predicted(self, state: SensorState) -> list[torch.Tensor]:
        """(G, S, P, R) m of every block."""
        blocks = [self._block(state, b) for b in range(len(self.blocks))]
        return [respond(block, self._bearings(state, block), state.unbalance, False).sensors for block in blocks]

    def deviations(self, state: SensorState) -> list[torch.Tensor]:
        """(G, S, P, R) complex of every block: predicted minus measured, over the noise."""
        every = zip(self.predicted(state), self.measured, self.precision, strict=True)
        weighed = [((predicted - measured) * precision)[..., None] for predicted, measured, precision in every]
        return [self._whiten(b, rows)[..., 0] for b, rows in enumerate(weighed)]

    def _whiten(self, b: int, rows: torch.Tensor) -> torch.Tensor:
        """Rows (G, S, P, R, n) of block b over each reading's own noise, without what runs share: with the deviations u
        of a subtracted baseline their covariance is 1 + u u', whose inverse root takes a part along u away.
        """
        if not self.common:
            return rows
        u = self.common[b][..., None]
        square = u.square().sum(3, keepdim=True)
        part = (1 - (1 + square).rsqrt()) / square.clamp(min=_TINY)
        return rows - part * u * (u * rows).sum(3, keepdim=True)

    def derivatives(self, state: SensorState, b: int) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Real rows of block b, (G, S, 2 P R, 1), and their derivatives by outputs (.., A) and by the rest (..,
        Th + 2 N + T): theta, parts of the residual unbalance, and model parameters.
        """
        import torch

        block, precision = self._block(state, b), self.precision[b]
        change = self._bearings(state, block)
        response = respond(block, change, state.unbalance)
        by_coefficient = derive(block, response).flatten(-2)  # (G, S, P, R, 8 B)
        _, slope, by_numbers = self.unknowns(state)
        by_unknowns = by_coefficient @ self.influence.to(by_coefficient.dtype)  # (G, S, P, R, A)
        by_outputs = by_unknowns * slope[:, :, None, None]
        by_theta = by_unknowns @ by_numbers.to(by_unknowns.dtype)[:, :, None]
        rest = [by_theta * precision[..., None], self._by_planes(response, precision)]
        if self.n_parameters:
            known = self.known_variation.to(by_coefficient.dtype)[:, None]
            by_model = derive_by_parameters(self.variations[b], response, change, state.unbalance)
            rest.append((by_model + by_coefficient @ known) * precision[..., None])
        rows = [
            ((response.sensors - self.measured[b]) * precision)[..., None],
            by_outputs * precision[..., None],
            torch.cat(rest, dim=-1),
        ]
        flat = [self._whiten(b, row).flatten(2, 3) for row in rows]
        by_parts = [torch.cat([part.real, part.imag], dim=2) for part in flat]
        return by_parts[0], by_parts[1], by_parts[2]

    def _by_planes(self, response: BlockResponse, precision: torch.Tensor) -> torch.Tensor:
        """(G, S, P, R, 2 N) derivative by the weights of the residual unbalance, over the noise."""
        import torch

        own = torch.zeros(*response.sensors.shape, self.n_planes, dtype=response.sensors.dtype)
        if response.unit_sensors.shape[-1]:
            own = response.unit_sensors[:, :, :, None, :].expand(own.shape) * precision[..., None]
        own = self.plane_scale * own
        return torch.stack([own, 1j * own], dim=-1).flatten(-2)

    def rounding(self) -> torch.Tensor:
        """(1,) the loss that the readings round to: their size over their noise, times their precision."""
        import torch

        pairs = zip(self.measured, self.precision, strict=True)
        squared = [(measured * precision).abs().square().sum((1, 2, 3)).max() for measured, precision in pairs]
        return _ROUNDING * (torch.stack(squared).sum() / self.n_rows).sqrt()[None]


def sensor_deviations(
    measurement: Measurement, model: CoefficientModel, plane_scale: float, law: LawTerm | None = None
) -> SensorDeviations:
    """The deviations at the points and runs of the measurement."""
    import torch

    unknowns, n_speeds = measurement.unknowns, len(measurement.dataset.speeds)
    n_coefficients = unknowns.influence.shape[0] * unknowns.influence.shape[1]
    others = np.where(unknowns.identified[:, None], 0.0, measurement.updated_known.values)  # (B, S, 8)
    blocks = tuple(block.converted(torch.as_tensor) for block in measurement.response.blocks)
    displacement = measurement.dataset.displacement
    noise = [split_noise(measurement, block.runs, displacement[None][..., block.runs]) for block in blocks]
    return SensorDeviations(
        measurement=measurement,
        model=model,
        scale=model.scale_tensor(),
        influence=torch.as_tensor(unknowns.influence.reshape(n_coefficients, -1)),
        known=torch.as_tensor(others.swapaxes(0, 1).reshape(n_speeds, -1)),
        plane_scale=plane_scale,
        blocks=blocks,
        variations=tuple(block.converted(torch.as_tensor) for block in measurement.variations),
        known_variation=torch.as_tensor(
            measurement.known_variation.reshape(n_speeds, n_coefficients, len(measurement.parameters))
        ),
        values=torch.as_tensor(measurement.parameter_values),
        measured=tuple(torch.as_tensor(displacement[None][..., block.runs]) for block in blocks),
        precision=tuple(
            torch.as_tensor(np.sqrt(2.0) / own) * weigh_present(measurement, block.runs)
            for (own, _), block in zip(noise, blocks, strict=True)
        ),
        common=tuple(torch.as_tensor(shared) for _, shared in noise if shared is not None),
        law=law,
    )


def weigh_present(measurement: Measurement, runs: np.ndarray) -> torch.Tensor:
    """(S or 1, 1, R) one where a run was measured, zero elsewhere."""
    import torch

    present = measurement.dataset.present
    if present is None:
        return torch.ones(1, 1, 1, dtype=torch.float64)
    return torch.as_tensor(present[:, np.asarray(runs)], dtype=torch.float64)[:, None]


def split_noise(
    measurement: Measurement, runs: np.ndarray, displacement: np.ndarray, factor: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray | None]:
    """Each reading's own deviation (.., S, P, R), m, and that of the baseline over it; None where none was subtracted.

    The ``runs`` that the same baseline was taken off share its noise. ``displacement`` (.., S, P, R) m is what is left,
    ``factor`` (P,) a channel's deviation over the stated one.
    """
    subtracted = measurement.dataset.subtracted
    if subtracted is None:
        return measurement.deviation_of(displacement, None, factor), None
    taken = subtracted[..., np.asarray(runs)]
    own = measurement.deviation_of(displacement + taken, None, factor)
    return own, np.where(taken != 0, measurement.deviation_of(taken, None, factor), 0.0) / own
