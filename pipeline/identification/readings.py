"""What the sensors read, block by block, and its noise: one place where rows are whitened.

Legend: G data sets or starts, S speeds, P channels, R runs of a block, n columns.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from pipeline.problem.measurement import Measurement

if TYPE_CHECKING:
    import torch

_ROUNDING = 1e-13
_TINY = 1e-30


@dataclass(frozen=True, eq=False, kw_only=True)
class Readings:
    """The readings of a measurement, with the precisions that count at the moment."""

    measurement: Measurement
    runs: tuple[np.ndarray, ...]  # of each block
    measured: tuple[torch.Tensor, ...]  # (G or 1, S, P, R) m
    precision: tuple[torch.Tensor, ...]  # likewise, 1/m: root of 2 over the reading's own deviation: both parts count
    common: tuple[torch.Tensor, ...]  # likewise, a subtracted baseline's deviation over the own one; none without
    mixing: tuple[torch.Tensor, ...]  # (R, S P, S P) where noise ties probes and speeds together; none elsewhere

    @property
    def size(self) -> int:
        """Real numbers that were measured."""
        return 2 * self.measurement.dataset.n_readings

    def subtract_from(self, b: int, predicted: torch.Tensor) -> torch.Tensor:
        """(G, S, P, R) predicted less measured readings of block b, weighed by the noise of their own."""
        return (predicted - self.measured[b]) * self.precision[b]

    def whiten(self, b: int, rows: torch.Tensor) -> torch.Tensor:
        """Rows (G, S, P, R, n) of block b over each reading's own noise, without what runs share: with the deviations u
        of a subtracted baseline their covariance is 1 + u u', whose inverse root takes a part along u away.
        """
        if not self.common:
            return rows
        u = self.common[b][..., None]
        square = u.square().sum(3, keepdim=True)
        share = (1 - (1 + square).rsqrt()) / square.clamp(min=_TINY)
        return rows - share * u * (u * rows).sum(3, keepdim=True)

    def mix(self, b: int, rows: torch.Tensor) -> torch.Tensor:
        """Rows (G, S, P, R, n) that are :meth:`whiten`-ed, without what noise in levels shares over probes and speeds,
        see :meth:`pipeline.problem.condition_noise.ConditionNoise.mixing`.
        """
        import torch

        if not self.mixing:
            return rows
        mixed = torch.einsum("rij,gjrn->girn", self.mixing[b], rows.flatten(1, 2))
        return torch.unflatten(mixed, 1, rows.shape[1:3])

    def rounding(self) -> torch.Tensor:
        """(1,) the loss that the readings round to: their size over their noise, times their precision."""
        import torch

        pairs = zip(self.measured, self.precision, strict=True)
        squared = [(measured * precision).abs().square().sum((1, 2, 3)).max() for measured, precision in pairs]
        return _ROUNDING * (torch.stack(squared).sum() / self.size).sqrt()[None]

    # --- other precisions --------------------------------------------------------------------------

    def scaled(self, shares: torch.Tensor | float) -> Readings:
        """The same with precisions times ``shares``."""
        return replace(self, precision=tuple(precision * shares for precision in self.precision))

    def deviation(self, b: int, predicted: np.ndarray, factor: np.ndarray | None = None) -> np.ndarray:
        """(.., S, P, R) m of the ``predicted`` readings of block b; ``factor`` (P,) over the stated noise."""
        subtracted = self.measurement.dataset.subtracted
        taken = None if subtracted is None else subtracted[..., self.runs[b]]
        return self.measurement.deviation_of(predicted, taken, factor)

    def present(self, b: int) -> torch.Tensor:
        """(S, 1, R) one where a run of block b was measured, zero elsewhere."""
        return _weigh_present(self.measurement, self.runs[b])

    def follow(self, predicted: list[torch.Tensor], factor: np.ndarray, shares: list[torch.Tensor]) -> Readings:
        """The same with the noise of ``predicted`` readings, of which ``shares`` count, by block.

        The deviation of a reading follows from the predicted amplitude, not from the measured one, whose noise would
        bias a fit.
        """
        import torch

        noise = [
            split_noise(self.measurement, runs, expected.numpy(), factor)
            for runs, expected in zip(self.runs, predicted, strict=True)
        ]
        precision = [
            np.sqrt(2.0) / torch.as_tensor(alone) * share.sqrt() * self.present(b)
            for b, ((alone, _), share) in enumerate(zip(noise, shares, strict=True))
        ]
        common = tuple(torch.as_tensor(shared) for _, shared in noise if shared is not None)
        return replace(self, precision=tuple(precision), common=common)


def gather_readings(measurement: Measurement) -> Readings:
    """The readings of a measurement, with the stated noise of what was read."""
    import torch

    displacement = measurement.dataset.displacement
    every = tuple(np.asarray(block.runs) for block in measurement.response.blocks)
    noise = [split_noise(measurement, runs, displacement[None][..., runs]) for runs in every]
    mixing = () if measurement.drift is None else (torch.as_tensor(measurement.drift.mixing()),)
    return Readings(
        measurement=measurement,
        runs=every,
        measured=tuple(torch.as_tensor(displacement[None][..., runs]) for runs in every),
        precision=tuple(
            torch.as_tensor(np.sqrt(2.0) / alone) * _weigh_present(measurement, runs)
            for (alone, _), runs in zip(noise, every, strict=True)
        ),
        common=tuple(torch.as_tensor(shared) for _, shared in noise if shared is not None),
        mixing=tuple(levels[torch.as_tensor(runs)] for levels in mixing for runs in every),
    )


def _weigh_present(measurement: Measurement, runs: np.ndarray) -> torch.Tensor:
    import torch

    return torch.as_tensor(measurement.dataset.present[:, runs], dtype=torch.float64)[:, None]


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
    alone = measurement.deviation_of(displacement + taken, None, factor)
    return alone, np.where(taken != 0, measurement.deviation_of(taken, None, factor), 0.0) / alone
