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

from pipeline.config.rotor import BaseConfig, SupportConfig
from pipeline.errors import ConfigError
from pipeline.rotor.model import DOF_PER_NODE, TRANSLATIONS, RotorModel, translation_dof

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
    wide = _widen(rotor, len(supports))
    for i, support in enumerate(supports):
        held = translation_dof(rotor.n_nodes + i, 0) + np.arange(TRANSLATIONS)
        for name in _UPRIGHT:
            wide[name][held, held] = support.matrices[name]
    return replace(rotor, **wide, casings=nodes)


def put_on_base(rotor: RotorModel, base: BaseConfig) -> RotorModel:
    """The rotor on a base whose modes are coordinates of unit mass, two a node of the ground.

    With participations ``u_r`` (2,) of a point it moves by ``sum u_r eta_r``, and a force f there drives each by
    ``u_r f``: what the base yields is ``sum u_r u_r' / (w_r^2 - w^2 + 2 j zeta_r w_r w)``, which pedestals share
    (Friswell, Penny, Garvey and Lees 2010, Dynamics of Rotating Machines). Raises ConfigError for a point that is at no
    bearing, and where bearings have supports of a rotor's file.
    """
    if not base.points:
        return rotor
    free = [node for node in rotor.bearing_nodes if node not in rotor.supported_nodes]
    if not set(base.points) <= set(free):
        raise ConfigError(
            f"machine.rotor.base.points must have bearing nodes without a support ({', '.join(map(str, free))}), but "
            f"has {', '.join(map(str, base.points))}: leave the others out, here or in the rotor file"
        )
    count = -(-len(base.modes) // TRANSLATIONS)
    wide, shapes = _widen(rotor, count), np.zeros((len(base.points), TRANSLATIONS, TRANSLATIONS * count))
    for r, mode in enumerate(base.modes):
        at, w = translation_dof(rotor.n_nodes + r // TRANSLATIONS, r % TRANSLATIONS), 2 * np.pi * mode.frequency
        shapes[..., r] = mode.participation
        for name, size in {"mass": 1.0, "damping": 2 * mode.damping_ratio * w, "stiffness": w**2}.items():
            wide[name][at, at] = size
    return replace(rotor, **wide, casings=base.points, participation=shapes)


def _widen(rotor: RotorModel, count: int) -> dict[str, Any]:
    """The rotor's matrices with ``count`` nodes of the ground, which do not move."""
    names = ("mass", "damping", "gyroscopic", "stiffness", "shaft_mass", "shaft_gyroscopic")
    wide: dict[str, Any] = {name: np.pad(getattr(rotor, name), (0, DOF_PER_NODE * count)) for name in names}
    upright = np.arange(rotor.n_dof, rotor.n_dof + DOF_PER_NODE * count)
    for name, size in _UPRIGHT.items():
        wide[name][upright, upright] = size
    return wide
