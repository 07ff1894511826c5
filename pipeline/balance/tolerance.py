"""What may remain of a rotor's unbalance by ISO 21940-11, at its two bearings.

The permissible residual unbalance of the whole rotor is shared by its bearings as the centre of mass lies between them,
at least 30 and at most 70 % each. What remains in the planes acts on the bearings by the lever. The standard is for
rotors that stay stiff up to the service speed. The formulas are written from knowledge of it, no edition was at hand.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pipeline.errors import ConfigError
from pipeline.rotor.model import DOF_PER_NODE, RotorModel


@dataclass(frozen=True, eq=False, kw_only=True)
class Tolerance:
    """At each of the two bearings: what may remain, and by how much each plane acts there."""

    nodes: tuple[int, int]
    permissible: np.ndarray  # (2,) kg m
    levers: np.ndarray  # (2, N)

    def remaining(self, unbalance: np.ndarray) -> np.ndarray:
        """(2,) complex kg m at the bearings, of (N,) in the planes."""
        return self.levers @ unbalance

    def circle(self, covariance: np.ndarray, circle: np.ndarray) -> np.ndarray:
        """(2,) kg m, 95 % circles at the bearings, of ``covariance`` (N, N) and ``circle`` (N,) kg m in the planes."""
        variance = np.einsum("bn,nm,bm->b", self.levers, covariance, self.levers).real
        return np.sqrt(variance * circle[0] ** 2 / covariance[0, 0].real)


def share_tolerance(
    rotor: RotorModel, planes: Sequence[int], permissible: float, least: float = 0.3, most: float = 0.7
) -> Tolerance:
    """``permissible`` (kg m) of the whole rotor at its bearings, to each a share from ``least`` to ``most``.

    Raises ConfigError where there are not two of them.
    """
    if len(rotor.bearing_nodes) != 2:
        raise ConfigError(
            "machine.balance.tolerance must be that of a rotor on two bearings (ISO 21940-11 shares it between them), "
            f"but this one has {len(rotor.bearing_nodes)}: leave tolerance out"
        )
    first, second = sorted(rotor.bearing_nodes, key=lambda node: rotor.positions[node])
    begin, span = rotor.positions[first], rotor.positions[second] - rotor.positions[first]
    beyond = (rotor.positions[list(planes)] - begin) / span  # 0 at the first bearing, 1 at the second
    share = float(np.clip((find_centre(rotor) - begin) / span, least, most))
    return Tolerance(
        nodes=(first, second),
        permissible=permissible * np.array([1 - share, share]),
        levers=np.array([1 - beyond, beyond]),
    )


def find_centre(rotor: RotorModel) -> float:
    """m along the shaft, the centre of mass: the first moment that the mass matrix has of a rigid tilt."""
    shifted, tilted = np.zeros(rotor.n_dof), np.zeros(rotor.n_dof)
    shifted[::DOF_PER_NODE] = 1.0
    tilted[::DOF_PER_NODE] = rotor.positions
    tilted[3::DOF_PER_NODE] = 1.0  # beta = dx/dz
    return float(shifted @ rotor.mass @ tilted / (shifted @ rotor.mass @ shifted))
