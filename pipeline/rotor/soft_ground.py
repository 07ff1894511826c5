"""A rotor whose casings move: each is a node of its own between film and support.

A bearing pushes the shaft by ``-H d`` and its casing by ``+H d``, with ``d`` the shaft's motion less the casing's.
Where a support ``S = K_s + j w C_s - w^2 M_s`` holds the casing, the shaft feels both in series,

    Z = (H^-1 + S^-1)^-1,    q_casing = S^-1 Z q_shaft

Here the casing's displacement stays among the unknown ones, so that modes and motions in time have it, too. SI units.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from pipeline.config.rotor import SupportConfig
from pipeline.errors import ConfigError
from pipeline.rotor.model import DOF_PER_NODE, TRANSLATIONS, RotorModel

_UPRIGHT = {"mass": 1.0, "damping": 3e4, "stiffness": 1e8}
"""kg m^2, N m s, N m: a casing does not tilt, and its rotations, which nothing feels, are overdamped."""


def put_on_supports(rotor: RotorModel, supports: Sequence[SupportConfig]) -> RotorModel:
    """The rotor with a casing for each of the ``supports``, in their order.

    Raises ConfigError for one where no bearing is, for the second of a bearing, and for one beside a rotor file's.
    """
    free = [node for node in rotor.bearing_nodes if node not in rotor.supported_nodes]
    nodes = tuple(support.node for support in supports)
    if not set(nodes) <= set(free) or len(set(nodes)) < len(nodes):
        raise ConfigError(
            f"machine.rotor.supports must have bearing nodes without a support ({', '.join(map(str, free))}), each "
            f"once, but has {', '.join(map(str, nodes))}: leave the others out, here or in the rotor file"
        )
    wide: dict[str, Any] = {
        name: np.pad(getattr(rotor, name), (0, DOF_PER_NODE * len(supports)))
        for name in ("mass", "damping", "gyroscopic", "stiffness", "shaft_mass", "shaft_gyroscopic")
    }
    for i, support in enumerate(supports):
        first = rotor.n_dof + DOF_PER_NODE * i
        held, upright = np.split(first + np.arange(DOF_PER_NODE), [TRANSLATIONS])
        for name, size in _UPRIGHT.items():
            wide[name][upright, upright] = size
            wide[name][held, held] = support.matrices[name]
    return replace(rotor, **wide, casings=nodes)
