"""Uncertain numbers of supports and of a base, which are known to an order of magnitude.

Legend: T parameters, S speeds, R runs, B bearings, C casings. SI units and radians.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from pydantic import PositiveFloat

from pipeline.coefficients import COEFFICIENTS
from pipeline.config.quantities import Damping, Stiffness
from pipeline.data.dataset import DIRECTIONS, VibrationDataset
from pipeline.parameters.kind import Kind, Machine, ModelParameter, Place
from pipeline.parameters.weights import size_excitations
from pipeline.rotor.interpolation import derive_by_casing, move_casing
from pipeline.rotor.model import RotorModel, casing_dof, translation_dof


def _find_supports(machine: Machine, matrix: str) -> list[Place]:
    """Each direction of a support, or each mode of a base, with what is stated of the rotor's ``matrix``."""
    rotor = machine.rotor
    labels = [f"node {node} {axis}" for node in rotor.casings for axis in DIRECTIONS]
    if rotor.participation.size:
        labels = [f"mode {r + 1}" for r in np.flatnonzero(rotor.participation.any(axis=(0, 1)))]
    ground = [(rotor.n_nodes + c, axis) for c in range(rotor.n_ground) for axis in DIRECTIONS]
    held = np.diagonal(getattr(rotor, matrix))[casing_dof(rotor)].ravel()
    # A node of the ground has two coordinates: an odd number of modes leaves one without a parameter.
    return [Place(label, *at, float(n)) for label, at, n in zip(labels, ground, held, strict=False)]


def _find_crosses(machine: Machine) -> list[Place]:
    """xy and yx of each support; modes of a base have none."""
    rotor = machine.rotor
    alone = enumerate(() if rotor.participation.size else rotor.casings, rotor.n_nodes)
    return [Place(f"node {node} {axes}", casing, axes) for casing, node in alone for axes in ("xy", "yx")]


def _find_participations(machine: Machine) -> list[Place]:
    participation = machine.rotor.participation
    return [
        Place(f"mode {r + 1} at node {machine.rotor.n_nodes + q} {'xy'[d]}", i)
        for i, (q, d, r) in enumerate(np.ndindex(participation.shape))
        if participation[:, :, r].any()
    ]


def _hold(parameter: ModelParameter, rotor: RotorModel, matrix: str) -> Mapping[str, np.ndarray]:
    held, axes = np.zeros_like(rotor.mass), (2 * parameter.detail)[:2]
    row, column = (translation_dof(parameter.place, "xy".index(axis)) for axis in axes)
    held[row, column] = parameter.deviation * (parameter.stated if parameter.growth else 1.0)
    return {matrix: held}


def local_change(parameters: Sequence[ModelParameter], rotor: RotorModel, frequencies: np.ndarray) -> np.ndarray:
    """(S, B + C, 8, T) what one deviation of each parameter changes where bearings and casings stand, N/m and N s/m.

    At ``frequencies`` w (S,) rad/s, where a mass m is the stiffness ``-w^2 m``.
    """
    first = len(rotor.bearing_nodes)
    result = np.zeros((len(frequencies), first + rotor.n_ground, len(COEFFICIENTS), len(parameters)))
    for t, parameter in enumerate(parameters):
        if letter := parameter.row.local:
            at = parameter.place if parameter.place < rotor.n_nodes else first + parameter.place - rotor.n_nodes
            c = COEFFICIENTS.index(letter.replace("m", "k") + (2 * parameter.detail)[:2])
            factor = -(frequencies**2) if letter == "m" else 1.0
            result[:, at, c, t] = parameter.deviation * (parameter.stated or 1.0) * factor
    return result


def softening(
    parameters: Sequence[ModelParameter], rotor: RotorModel, dataset: VibrationDataset
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Which stiffnesses fall with the size of what excites a run: ``k exp(growth theta - fall theta)``.

    (B + C, 8) N/m, k as stated, and zero for all else; (B + C, 8, T) growth, by one deviation of each parameter; (R, S,
    B + C, 8, T) fall, by the root of the stated force, of no run where nothing softens. That root is what trials with a
    measured base showed (studies/soft_base): softer modes need no other number than this one.
    """
    first, n_runs = len(rotor.bearing_nodes), len(dataset.runs)
    stated = np.zeros((first + rotor.n_ground, len(COEFFICIENTS)))
    growth = np.zeros((*stated.shape, len(parameters)))
    softer = [(t, p) for t, p in enumerate(parameters) if p.kind == "base_softening"]
    fall = np.zeros((n_runs if softer else 0, len(dataset.speeds), *growth.shape))
    for t, parameter in enumerate(parameters):
        if parameter.kind in ("support_stiffness", "base_softening"):
            at = first + parameter.place - rotor.n_nodes, COEFFICIENTS.index("k" + 2 * parameter.detail)
            if parameter.kind == "support_stiffness":
                growth[*at, t] = parameter.deviation
            else:
                stated[at] = parameter.stated
                fall[:, :, *at, t] = parameter.deviation * size_excitations(dataset).T
    return stated, growth, fall


_NO_SUPPORT = "no support (machine.rotor.supports) and no base (machine.rotor.base)"
_NO_BASE = "no base (machine.rotor.base)"
_NO_CROSS = "no support (machine.rotor.supports); modes of a base have no cross terms"
KINDS = (
    Kind(
        name="support_stiffness",
        prior=PositiveFloat,
        meaning="of the logarithm of each support's stiffness, in x and in y, or of each mode's of the base, w^2",
        places=lambda machine: _find_supports(machine, "stiffness"),
        missing=_NO_SUPPORT,
        unit="ln",
        stated_unit="N/m",
        logarithmic=True,
        local="k",
        rotor=lambda parameter, rotor: _hold(parameter, rotor, "stiffness"),
    ),
    Kind(
        name="support_damping",
        prior=PositiveFloat,
        meaning="of the logarithm of each support's damping, in x and in y, or of each mode's, 2 zeta w",
        places=lambda machine: _find_supports(machine, "damping"),
        missing=_NO_SUPPORT,
        unit="ln",
        stated_unit="N s/m",
        logarithmic=True,
        local="c",
        rotor=lambda parameter, rotor: _hold(parameter, rotor, "damping"),
    ),
    Kind(
        name="support_mass",
        prior=PositiveFloat,
        meaning="of the logarithm of each support's mass, in x and in y",
        places=lambda machine: [] if _find_participations(machine) else _find_supports(machine, "mass"),
        missing="no support (machine.rotor.supports); modes of a base have unit mass by definition",
        unit="ln",
        stated_unit="kg",
        logarithmic=True,
        local="m",
        rotor=lambda parameter, rotor: _hold(parameter, rotor, "mass"),
    ),
    Kind(
        name="support_cross_stiffness",
        prior=Stiffness,
        meaning="of each support's kxy and kyx, beyond what is stated",
        places=_find_crosses,
        missing=_NO_CROSS,
        unit="N/m",
        mirrored=True,
        local="k",
        rotor=lambda parameter, rotor: _hold(parameter, rotor, "stiffness"),
    ),
    Kind(
        name="support_cross_damping",
        prior=Damping,
        meaning="of each support's cxy and cyx, beyond what is stated",
        places=_find_crosses,
        missing=_NO_CROSS,
        unit="N s/m",
        mirrored=True,
        local="c",
        rotor=lambda parameter, rotor: _hold(parameter, rotor, "damping"),
    ),
    Kind(
        name="base_participation",
        prior=PositiveFloat,
        meaning="of each participation of a point of the base in a mode, 1/sqrt(kg)",
        places=_find_participations,
        missing=_NO_BASE,
        unit="1/sqrt(kg)",
        move=move_casing,
        derive_places=derive_by_casing,
    ),
    Kind(
        name="base_softening",
        prior=PositiveFloat,
        meaning="of what the logarithm of each mode's stiffness falls by, over the root of the force on a run, "
        "1/sqrt(N)",
        places=lambda machine: _find_supports(machine, "stiffness") if _find_participations(machine) else [],
        missing=_NO_BASE,
        unit="ln/sqrt(N)",
        scope="runs",
    ),
)
