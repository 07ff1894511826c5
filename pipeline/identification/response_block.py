"""Runs that share their frequencies, as tensors: the response on the reference bearings, and what was measured.

Legend: G data sets, S speeds, P channels, R runs, B bearings, N balance planes.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING

import numpy as np

from pipeline.equations.response import ResponseBlock

if TYPE_CHECKING:
    import torch


@dataclass(frozen=True, eq=False)
class Readings:
    """What was measured, (S, P, R) each, m."""

    displacement: np.ndarray
    deviation: np.ndarray  # root mean square of the noise
    subtracted: np.ndarray | None  # the baseline that was taken off


@dataclass(frozen=True, eq=False)
class Block:
    """A :class:`~pipeline.equations.response.ResponseBlock` as tensors, and the readings of its runs."""

    runs: np.ndarray  # (R,) indices among the runs of the data
    subtracted: np.ndarray | None  # (S, P, R) m, the baseline that was taken off
    frequencies: torch.Tensor
    forced_sensors: torch.Tensor
    forced_bearings: torch.Tensor
    receptance_sensors: torch.Tensor
    receptance_bearings: torch.Tensor
    unit_sensors: torch.Tensor
    unit_bearings: torch.Tensor
    measured: torch.Tensor  # (G or 1, S, P, R)
    weight: torch.Tensor  # (G or 1, S, P, R), 1/m: root of 2 over the deviation, so that real and imaginary part count

    def to(self, device: str) -> Block:
        """The same on another device."""
        tensors = [f.name for f in fields(self) if f.name not in ("runs", "subtracted")]
        return replace(self, **{name: getattr(self, name).to(device) for name in tensors})


def block_of(block: ResponseBlock, readings: Readings, keep: np.ndarray) -> Block:
    """The ``block``, which is of the speeds ``keep`` (mask) already, with its readings."""
    import torch

    parts = [
        block.frequencies,
        block.forced_sensors,
        block.forced_bearings,
        block.receptance_sensors,
        block.receptance_bearings,
        block.unit_sensors,
        block.unit_bearings,
        readings.displacement[None, keep][..., block.runs],
        np.sqrt(2.0) / readings.deviation[None, keep][..., block.runs],
    ]
    subtracted = None if readings.subtracted is None else readings.subtracted[keep][..., block.runs]
    return Block(block.runs, subtracted, *[torch.as_tensor(part) for part in parts])
