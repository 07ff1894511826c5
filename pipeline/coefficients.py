"""The eight linearised bearing coefficients, their order and their place in the 2x2 blocks.

``H(w) = K + j w C`` acts on the displacements (x, y) of the bearing's node (paper, eqs. 2 and 4):
``kxy`` is the force in x for a displacement in y, and so on.
"""

from __future__ import annotations

from typing import Literal, get_args

CoefficientName = Literal["kxx", "kxy", "kyx", "kyy", "cxx", "cxy", "cyx", "cyy"]
COEFFICIENTS: tuple[str, ...] = get_args(CoefficientName)


def is_stiffness(name: str) -> bool:
    """True for k.., false for c..."""
    return name[0] == "k"


def is_direct(name: str) -> bool:
    """True for kxx, kyy, cxx and cyy, false for the cross-coupled coefficients."""
    return name[1] == name[2]


def row(name: str) -> int:
    """Direction of the force: 0 for x, 1 for y."""
    return "xy".index(name[1])


def column(name: str) -> int:
    """Direction of the displacement: 0 for x, 1 for y."""
    return "xy".index(name[2])


def unit(name: str) -> str:
    """N/m or N s/m."""
    return "N/m" if is_stiffness(name) else "N s/m"
