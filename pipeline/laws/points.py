"""Operating points as the laws see them, and the turn of a bearing's axes.

Legend: G members, S operating points, Th unknown numbers. SI units.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    import torch

LOAD = "load"
OIL_TEMPERATURE = "oil_temperature"


@dataclass(frozen=True, eq=False)
class Points:
    """Speeds, operating conditions, and the oil's viscosity there (of laws without oil: zeros)."""

    speeds: torch.Tensor  # (S,) rad/s
    operating: Mapping[str, torch.Tensor]  # name -> (S,) SI, temperatures in K
    log_viscosity: torch.Tensor  # (G, S) of Pa s
    viscosity_slopes: torch.Tensor  # (G, S, Th)


def turn_axes(angle: float) -> np.ndarray:
    """(8, 8) that makes coefficients in x and y of those whose first axis points ``angle`` rad from x towards y."""
    cos, sin = np.cos(angle), np.sin(angle)
    turn = np.array([[cos, -sin], [sin, cos]])
    return np.kron(np.eye(2), np.kron(turn, turn))
