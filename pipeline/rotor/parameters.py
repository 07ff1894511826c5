"""Uncertain numbers of the machine's model, and what those of the rotor change of its matrices.

An engineer knows the shaft, the discs, the weights and the probes to a tolerance only. Each such number is a parameter
``theta`` in units of its prior standard deviation: its prior is normal with mean 0 and variance 1, and theta = 0 is
what the configuration states. The dynamic stiffness is linear in the parameters of the rotor,

    D(w, theta) = D(w) + sum_t theta_t dD_t(w),

so the sensitivity of the structure is exact: it comes from the matrices of its parts, not from differences.
Supports are known to an order of magnitude: theta is the logarithm of each of their numbers over what is stated.

Legend: T parameters. SI units and radians.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from pipeline.rotor.interpolation import derive_by_bearing, derive_by_casing, move_bearing, move_casing
from pipeline.rotor.model import DOF_PER_NODE, NO_SEALS, TRANSLATIONS, RotorModel, translation_dof

UNITS = {
    "youngs_modulus": "",
    "density": "",
    "disc_mass": "",
    "disc_inertia": "",
    "coupling_stiffness": "N/m",
    "coupling_mass": "kg",
    "bearing_position": "m",
    "support_stiffness": "ln",
    "support_damping": "ln",
    "support_mass": "ln",
    "base_participation": "1/sqrt(kg)",
    "base_softening": "ln/sqrt(N)",
    "bow": "m",
    "unbalance_magnitude": "",
    "unbalance_phase": "rad",
    "weight_angle": "rad",
    "weight_law": "1/(kg m)",
    "weight_gain": "ln",
    "label_gain": "ln",
    "label_angle": "rad",
    "probe_gain": "",
    "probe_angle": "rad",
    "probe_position": "m",
    "runout": "m",
    "known_coefficients": "",
    "bearing_drift": "",
}
"""Every kind, and the unit of its deviation; without a unit it is a share of the stated value, and ln is the logarithm
of the number over that."""
OF_SHAFT = ("youngs_modulus", "density")
OF_DISC = ("disc_mass", "disc_inertia")
OF_COUPLING = ("coupling_stiffness", "coupling_mass")
OF_SUPPORT = {
    "support_stiffness": ("stiffness", "N/m"),
    "support_damping": ("damping", "N s/m"),
    "support_mass": ("mass", "kg"),
}
"""Kinds whose logarithm is normal: the matrix that each is part of, and the unit of the number."""
MOVED = {
    "bearing_position": (move_bearing, derive_by_bearing),
    "base_participation": (move_casing, derive_by_casing),
}
"""Kinds that move what bearings feel of the DOF: how, by the rotor, the parameter's place and its shift, and the
derivative by that."""
OF_WEIGHT = ("unbalance_magnitude", "unbalance_phase")
OF_ALL_WEIGHTS = ("weight_angle", "weight_law", "weight_gain")
OF_LABEL = ("label_gain", "label_angle")
OF_PROBE = ("probe_gain", "probe_angle", "probe_position")


@dataclass(frozen=True)
class ModelParameter:
    """One uncertain number.

    ``youngs_modulus`` scales the shaft's whole stiffness (a shear modulus of constant Poisson's ratio with it),
    ``density`` its mass, ``disc_inertia`` both inertias of a disc. A coupling acts at a node in x and y alike.
    ``bearing_position`` moves a bearing along the shaft, and ``base_participation`` a casing in a mode; their matrices
    stay, and the bearing's places on them change. By ``base_softening`` the logarithm of a mode's stiffness falls with
    the root of the force that excites a run.
    """

    kind: str
    deviation: float  # prior standard deviation in the unit of the kind
    label: str  # what it belongs to, such as "node 3"; empty for the whole shaft
    place: int = 0  # node, position among the run's excitations, channel, bearing, or participation of a base
    detail: str = ""  # run of an excitation, name of a coefficient, part of a complex number, or direction
    stated: float = 0.0  # SI, of a support, or of what softens
    value: float = 0.0  # theta, where rotor, weights and probes are made

    @property
    def name(self) -> str:
        """Kind and place, as tables show them."""
        return f"{self.kind} {self.label}".strip()

    @property
    def shift(self) -> float:
        """By how much it is off at its :attr:`value`, in the unit of the kind."""
        return self.value * self.deviation

    @property
    def slope(self) -> float:
        """The derivative by the value of what it is off by, in deviations."""
        return float(np.exp(self.shift)) if self.kind in OF_SUPPORT else 1.0


def rotor_change(parameter: ModelParameter, rotor: RotorModel) -> RotorModel | None:
    """The rotor's matrices dM, dC, dG, dK of one deviation; None for a parameter that moves none of them."""
    nothing = np.zeros_like(rotor.mass)
    change: dict[str, Any] = dict.fromkeys(("mass", "damping", "gyroscopic", "stiffness"), nothing)
    change["seals"] = NO_SEALS  # no parameter changes them
    size, first = parameter.deviation, translation_dof(parameter.place, 0)
    if parameter.kind == "youngs_modulus":
        shaft = np.arange(rotor.n_dof) < DOF_PER_NODE * rotor.n_nodes
        change["stiffness"] = size * rotor.stiffness * shaft
    elif parameter.kind == "density":
        change |= {"mass": size * rotor.shaft_mass, "gyroscopic": size * rotor.shaft_gyroscopic}
    elif parameter.kind in OF_DISC:
        turning = parameter.kind == "disc_inertia"
        places = slice(first + TRANSLATIONS, first + DOF_PER_NODE) if turning else slice(first, first + TRANSLATIONS)
        kept = np.zeros_like(nothing)
        kept[places, places] = size
        change |= {
            "mass": kept * (rotor.mass - rotor.shaft_mass),
            "gyroscopic": kept * (rotor.gyroscopic - rotor.shaft_gyroscopic),
        }
    elif parameter.kind in OF_COUPLING:
        added = np.zeros_like(nothing)
        added[[first, first + 1], [first, first + 1]] = size
        change["mass" if parameter.kind == "coupling_mass" else "stiffness"] = added
    elif parameter.kind in OF_SUPPORT:
        held, at = np.zeros_like(nothing), translation_dof(parameter.place, "xy".index(parameter.detail))
        held[at, at] = size * parameter.stated
        change[OF_SUPPORT[parameter.kind][0]] = held
    else:
        return None
    return replace(rotor, **change)


def update_rotor(rotor: RotorModel, parameters: Sequence[ModelParameter]) -> RotorModel:
    """The rotor at the values of the parameters."""
    sums: dict[str, Any] = {name: getattr(rotor, name) for name in ("mass", "damping", "gyroscopic", "stiffness")}
    for parameter in parameters:
        if parameter.kind in MOVED and parameter.value:
            rotor = MOVED[parameter.kind][0](rotor, parameter.place, parameter.shift)
        if parameter.value and (change := rotor_change(parameter, rotor)) is not None:
            step = (
                float(np.expm1(parameter.shift)) / parameter.deviation
                if parameter.kind in OF_SUPPORT
                else parameter.value
            )
            sums = {name: total + step * getattr(change, name) for name, total in sums.items()}
    return replace(rotor, **sums)
