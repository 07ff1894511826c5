"""Uncertain numbers of bearings: what is taken as known of them, and what differs between the runs.

Legend: T parameters, S speeds, B bearings, R runs. SI units.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from pipeline.coefficients import COEFFICIENTS
from pipeline.config.quantities import Mass
from pipeline.parameters.kind import Kind, Machine, ModelParameter, Place, PositiveShare
from pipeline.rotor.bearing_table import BearingTable
from pipeline.rotor.interpolation import bearing_places
from pipeline.rotor.model import TRANSLATIONS, RotorModel

BASELINE = ""
"""The run of a bearing's drift in the baseline that was taken off the others."""


def _find_known(machine: Machine) -> list[Place]:
    known = machine.known
    fixed = np.argwhere(~machine.unknowns.identified & known.values.any(axis=1))
    return [Place(f"{COEFFICIENTS[c]} node {known.nodes[b]}", int(b), COEFFICIENTS[c]) for b, c in fixed]


def _find_drifts(machine: Machine) -> list[Place]:
    runs = [*machine.dataset.runs, *([] if machine.dataset.subtracted is None else [BASELINE])]
    return [
        Place(f"node {node} {run or 'baseline'}", b, run)
        for b, node in enumerate(machine.rotor.bearing_nodes)
        for run in runs
    ]


def known_variation(parameters: Sequence[ModelParameter], known: BearingTable) -> np.ndarray:
    """(S, B, 8, T) derivative of the known coefficients by the parameters, N/m and N s/m."""
    result = np.zeros((len(known.speeds), len(known.nodes), len(COEFFICIENTS), len(parameters)))
    for t, parameter in enumerate(parameters):
        if parameter.kind == "known_coefficients":
            c = COEFFICIENTS.index(parameter.detail)
            result[:, parameter.place, c, t] = parameter.deviation * known.values[parameter.place, :, c]
    return result


def _find_masses(machine: Machine) -> list[Place]:
    """Of each stiffness that is identified at a seal."""
    nodes, asked = machine.rotor.bearing_nodes, np.argwhere(machine.unknowns.identified[:, :4])
    places = [(int(b), COEFFICIENTS[c][1:]) for b, c in asked if nodes[b] in machine.seal_nodes]
    return [Place(f"m{axes} node {nodes[b]}", b, axes) for b, axes in places]


def _add_mass(parameter: ModelParameter, rotor: RotorModel) -> Mapping[str, np.ndarray]:
    """At the bearing's node, as it is stated."""
    loads = bearing_places(replace(rotor, bearing_shifts=())).loads(rotor.n_dof)
    first, second = (loads[:, TRANSLATIONS * parameter.place + "xy".index(axis)] for axis in parameter.detail)
    return {"mass": parameter.deviation * np.outer(first, second)}


def drift_scales(parameters: Sequence[ModelParameter], runs: Sequence[str], n_bearings: int) -> np.ndarray:
    """(R, B, T) what one deviation of each parameter adds to one, by which a bearing is scaled in a run."""
    scales = np.zeros((len(runs), n_bearings, len(parameters)))
    for t, parameter in enumerate(parameters):
        if parameter.kind == "bearing_drift" and parameter.detail in runs:
            scales[runs.index(parameter.detail), parameter.place, t] = parameter.deviation
    return scales


KINDS = (
    Kind(
        name="added_mass",
        prior=Mass,
        meaning="of the mass that the fluid adds at each of seal_nodes, in the directions whose stiffness is "
        "identified; none is stated",
        places=_find_masses,
        missing="no bearing at identify.seal_nodes whose stiffness is identified",
        unit="kg",
        local="m",
        rotor=_add_mass,
    ),
    Kind(
        name="known_coefficients",
        prior=PositiveShare,
        meaning="of each known coefficient other than zero, as a share, at all speeds alike",
        places=_find_known,
        missing="no known coefficient other than zero",
    ),
    Kind(
        name="bearing_drift",
        prior=PositiveShare,
        meaning="of each bearing in each run about what it is on average, as a share of all its coefficients",
        places=_find_drifts,
        usual=0.02,
        widens=False,
        scope="run",
    ),
)
