"""Uncertain numbers of shaft, discs and coupling.

SI units and radians.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from pipeline.config.quantities import Mass, Stiffness
from pipeline.errors import ConfigError
from pipeline.parameters.kind import Kind, Machine, ModelParameter, Place, PositiveShare, everywhere
from pipeline.rotor.model import DOF_PER_NODE, TRANSLATIONS, RotorModel, translation_dof


def _change_disc(parameter: ModelParameter, rotor: RotorModel, first: int, last: int) -> Mapping[str, np.ndarray]:
    """What the disc adds to its node's DOF from ``first`` on, up to ``last``."""
    start, kept = translation_dof(parameter.place, 0), np.zeros_like(rotor.mass)
    dof = slice(start + first, start + last)
    kept[dof, dof] = parameter.deviation
    return {
        "mass": kept * (rotor.mass - rotor.shaft_mass),
        "gyroscopic": kept * (rotor.gyroscopic - rotor.shaft_gyroscopic),
    }


def _couple(parameter: ModelParameter, rotor: RotorModel, matrix: str) -> Mapping[str, np.ndarray]:
    first, added = translation_dof(parameter.place, 0), np.zeros_like(rotor.mass)
    added[[first, first + 1], [first, first + 1]] = parameter.deviation
    return {matrix: added}


def _find_coupling(machine: Machine) -> list[Place]:
    """Where the configuration says, or the ends of the shaft without disc and bearing. Raises ConfigError for a node
    that the rotor lacks, and for a bearing's.
    """
    node, rotor = machine.coupling_node, machine.rotor
    if node is None:
        ends = [end for end in (0, rotor.n_nodes - 1) if end not in (*rotor.bearing_nodes, *rotor.disc_nodes)]
        return [Place(f"node {end}", end) for end in ends]
    if not node < rotor.n_nodes:
        raise ConfigError(
            f"identify.coupling_node must be one of the nodes 0 to {rotor.n_nodes - 1} of the rotor, but got {node}"
        )
    if node in rotor.bearing_nodes:
        raise ConfigError(
            "identify.coupling_node must be a node without a bearing, since no vibration tells a coupling from "
            f"the bearing beside it, but got the bearing node {node}"
        )
    return [Place(f"node {node}", node)]


KINDS = (
    Kind(
        name="youngs_modulus",
        prior=PositiveShare,
        meaning="of the shaft, as a share, with the shear modulus",
        places=everywhere,
        usual=0.01,
        rotor=lambda parameter, rotor: {
            "stiffness": parameter.deviation * rotor.stiffness * (np.arange(rotor.n_dof) < DOF_PER_NODE * rotor.n_nodes)
        },
    ),
    Kind(
        name="density",
        prior=PositiveShare,
        meaning="of the shaft, as a share",
        places=everywhere,
        usual=0.005,
        rotor=lambda parameter, rotor: {
            "mass": parameter.deviation * rotor.shaft_mass,
            "gyroscopic": parameter.deviation * rotor.shaft_gyroscopic,
        },
    ),
    Kind(
        name="disc_mass",
        prior=PositiveShare,
        meaning="of each disc, as a share",
        places=lambda machine: machine.discs,
        missing="no disc",
        usual=0.02,
        widens=False,
        rotor=lambda parameter, rotor: _change_disc(parameter, rotor, 0, TRANSLATIONS),
    ),
    Kind(
        name="disc_inertia",
        prior=PositiveShare,
        meaning="of each disc, as a share, diametral and polar together",
        places=lambda machine: machine.discs,
        missing="no disc",
        usual=0.03,
        widens=False,
        rotor=lambda parameter, rotor: _change_disc(parameter, rotor, TRANSLATIONS, DOF_PER_NODE),
    ),
    Kind(
        name="coupling_stiffness",
        prior=Stiffness,
        meaning="of a coupling to ground at coupling_node, radial; none is stated",
        places=_find_coupling,
        missing="no end of its shaft without disc and bearing",
        unit="N/m",
        usual=1e5,
        widens=False,
        rotor=lambda parameter, rotor: _couple(parameter, rotor, "stiffness"),
    ),
    Kind(
        name="coupling_mass",
        prior=Mass,
        meaning="of a coupling; none is stated",
        places=_find_coupling,
        missing="no end of its shaft without disc and bearing",
        unit="kg",
        usual=0.5,
        widens=False,
        rotor=lambda parameter, rotor: _couple(parameter, rotor, "mass"),
    ),
)
