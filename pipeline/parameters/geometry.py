"""Where the bearings are along the shaft, and a bow of the shaft.

A shaft with the bow ``u`` resists ``q - u``, not q: with the shaft's own stiffness K its force is ``-K (q - u)``, so
that ``K u`` acts on the straight one and turns with it (Nelson and McVaugh 1976; Childs 1993). The same at all speeds,
it is no unbalance. The shapes here are those that a force at a disc gives the shaft between its bearings.

Legend: T parameters, n lateral DOF. SI units and radians.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import numpy as np

from pipeline.config.quantities import Length
from pipeline.parameters.kind import PARTS, UNSHOWN, Kind, Machine, ModelParameter, Place, require_on_shaft
from pipeline.rotor.interpolation import derive_by_bearing, move_bearing
from pipeline.rotor.model import RotorModel, bearing_dof, translation_dof


def _find_bows(machine: Machine) -> list[Place]:
    rotor = machine.rotor
    if not machine.shows_bow or len(rotor.bearing_nodes) < 2:
        return []
    bent = [disc for disc in machine.discs if disc.place not in rotor.bearing_nodes]
    return [Place(f"{disc.label} {component}", disc.place, component) for disc in bent for component in PARTS]


def bow_change(parameter: ModelParameter, rotor: RotorModel) -> np.ndarray | None:
    """(n,) N, complex, derivative of the bow's force by the parameter; None where it is of no bow.

    ``rotor`` is the stated one: a bow is what its stiffness makes of the force.
    """
    if parameter.kind != "bow":
        return None
    x, y = (_bend(rotor, parameter.place, direction) for direction in range(2))
    return np.asarray(parameter.deviation * PARTS[parameter.detail] * (x - 1j * y))


def bow_force(parameters: Sequence[ModelParameter], rotor: RotorModel) -> np.ndarray:
    """(n,) N, complex, that turns with the shaft at the values of the parameters."""
    total = np.zeros(rotor.n_dof, dtype=complex)
    for parameter in parameters:
        if parameter.kind == "bow":
            total += parameter.value * np.asarray(bow_change(parameter, rotor))
    return total


@lru_cache(maxsize=16)
def _bend(rotor: RotorModel, node: int, direction: int) -> np.ndarray:
    """(n,) N: the force that bends the shaft by 1 m at the node, held at its bearings, with what holds it there."""
    held = bearing_dof(rotor).ravel()
    free = np.setdiff1d(np.arange(rotor.n_dof), held)
    at, unit = translation_dof(node, direction), np.zeros(rotor.n_dof)
    unit[at] = 1.0
    shape = np.zeros(rotor.n_dof)
    shape[free] = np.linalg.solve(rotor.stiffness[np.ix_(free, free)], unit[free])
    unit[held] = rotor.stiffness[held] @ shape
    return np.asarray(unit / shape[at])


KINDS = (
    Kind(
        name="bearing_position",
        prior=Length,
        meaning="of the place of each bearing along the shaft",
        places=lambda machine: [
            Place(f"node {node}", b) for b, node in enumerate(machine.rotor.bearing_nodes) if not machine.rotor.casings
        ],
        missing="bearings on soft ground",
        require=lambda parameter, machine: require_on_shaft(
            parameter, machine, machine.rotor.bearing_nodes[parameter.place], min
        ),
        unit="m",
        move=move_bearing,
        derive_places=derive_by_bearing,
    ),
    Kind(
        name="bow",
        prior=Length,
        meaning="of a bow of the shaft at each disc, real and imaginary part",
        places=_find_bows,
        missing=f"{UNSHOWN}, or no disc between or beyond two bearings",
        unit="m",
        shown=("um", 1e6),
        scope="runs",
    ),
)
