"""The rotor as a fit left it, as ROSS's own object and file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from inspect import signature
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.coefficients import COEFFICIENTS
from pipeline.config.rotor import RotorConfig
from pipeline.errors import ConfigError
from pipeline.rotor.bearing_table import BearingTable
from pipeline.rotor.ross_adapter import make_rotor, ross

if TYPE_CHECKING:
    from pipeline.parameters.kind import ModelParameter


def export_rotor(config: RotorConfig, parameters: Sequence[ModelParameter], bearings: BearingTable) -> Any:
    """ROSS's rotor at the values of the model parameters, on the identified ``bearings``.

    Supports of a rotor file are part of the bearings as the shaft feels them; those beside it are elements between
    casing and ground. Seals and masses on the shaft stay. A fitted coupling is a bearing element of its own.

    Raises ConfigError where the rotor file can't be read, and for a base.
    """
    rs, base = ross(), make_rotor(config)
    shifted = {(parameter.kind, parameter.place): parameter.shift for parameter in parameters}
    young, density = 1.0 + shifted.get(("youngs_modulus", 0), 0.0), 1.0 + shifted.get(("density", 0), 0.0)
    shaft = [_change_material(one, young, density) for one in base.shaft_elements]
    discs = []
    for element in base.disk_elements:
        mass, inertia = (1.0 + shifted.get((kind, element.n), 0.0) for kind in ("disc_mass", "disc_inertia"))
        discs.append(
            rs.DiskElement(element.n, mass * element.m, inertia * element.Id, inertia * element.Ip, tag=element.tag)
        )
    if config.base.points:
        raise ConfigError(
            "a rotor must stand on the ground or on supports to be written for ROSS, whose elements hold no modes of a "
            "base, but machine.rotor.base gives some: leave the base out"
        )
    last = len(base.nodes) - 1
    masses = [one for one in base.point_mass_elements if one.n <= last]
    links = {support.node: last + 1 + i for i, support in enumerate(config.supports)}
    shifts = {(parameter.kind, parameter.place, parameter.detail): parameter.slope for parameter in parameters}
    crossed = {(parameter.kind, parameter.place, parameter.detail): parameter.shift for parameter in parameters}
    seals = [element for element in base.bearing_elements if isinstance(element, rs.SealElement)]
    standing = [*make_bearings(bearings, links), *seals]
    for support in config.supports:
        casing = links[support.node]
        held = {
            f"{letter}{axis}{axis}": getattr(support, f"{letter}{axis}{axis}") * shifts.get((kind, casing, axis), 1.0)
            for kind, letter in (("support_stiffness", "k"), ("support_damping", "c"), ("support_mass", "m"))
            for axis in "xy"
        }
        held |= {
            letter + axes: getattr(support, letter + axes) + crossed.get((kind, casing, axes), 0.0)
            for kind, letter in (("support_cross_stiffness", "k"), ("support_cross_damping", "c"))
            for axes in ("xy", "yx")
        }
        size = held.pop("mxx")  # along the shaft, too: held by nothing, a mass of zero has no response there
        masses.append(rs.PointMass(casing, mx=size, my=held.pop("myy"), mz=size, tag=f"casing {support.node}"))
        standing.append(rs.BearingElement(casing, **held, tag=f"support of node {support.node}"))
    couplings = ("coupling_stiffness", "coupling_mass")
    for node in {node for kind, node in shifted if kind in couplings}:
        stiffness, mass = (shifted.get((kind, node), 0.0) for kind in couplings)
        standing.append(rs.BearingElement(node, kxx=stiffness, cxx=0.0, mxx=mass, tag="coupling"))
    for place, node in enumerate(bearings.nodes):
        added = {f"m{p.detail}": p.shift for p in parameters if p.kind == "added_mass" and p.place == place}
        nothing = dict.fromkeys(("kxx", "cxx", "mxx", "mxy", "myx", "myy"), 0.0)
        standing += [rs.BearingElement(node, **nothing | added, tag=f"added mass of node {node}")] * bool(added)
    return rs.Rotor(shaft, discs, standing, masses)


def make_bearings(bearings: BearingTable, links: Mapping[int, int]) -> list[Any]:
    """ROSS's bearing elements: tables over the speed, or constants where no coefficient changes with it.

    ``links`` has the casings that they stand in, by node.
    """
    rs, made = ross(), []
    for node, values in zip(bearings.nodes, bearings.values, strict=True):
        columns: dict[str, Any] = dict(zip(COEFFICIENTS, values.T.tolist(), strict=True))
        columns["frequency"] = bearings.speeds.tolist()
        if (values == values[0]).all():
            columns = dict(zip(COEFFICIENTS, values[0].tolist(), strict=True))
        made.append(rs.BearingElement(node, **columns, n_link=links.get(node), tag=f"bearing at node {node}"))
    return made


def read_table(elements: Sequence[Any], speeds: np.ndarray) -> BearingTable:
    """The coefficients as ROSS evaluates the ``elements`` at ``speeds`` (S,) rad/s.

    ROSS smooths a table of four speeds or more by a spline that leaves a root mean square of 1 N/m and 1 N s/m.
    """
    values = [
        [[float(getattr(element, f"{name}_interpolated")(speed)) for name in COEFFICIENTS] for speed in speeds]
        for element in elements
    ]
    return BearingTable(tuple(int(element.n) for element in elements), speeds, np.array(values))


def _change_material(element: Any, young: float, density: float) -> Any:
    """The shaft's element with its stiffness and its mass times these; its own damping stays."""
    if young == density == 1.0:
        return element
    given = {name: getattr(element, name) for name in list(signature(type(element).__init__).parameters)[1:]}
    if "material" not in given:  # a coupling
        factors = {name: young if name[0] == "k" else density for name in given if name[0] in "kmI"}
        return type(element)(**given | {name: factor * given[name] for name, factor in factors.items()})
    old = element.material
    changed = {"rho": density * float(old.rho), "E": young * float(old.E), "G_s": young * float(old.G_s)}
    loads = {name: young * given[name] for name in ("axial_force", "torque")}
    damping = {"alpha": element.alpha / density, "beta": element.beta / young}
    return type(element)(**given | loads | damping | {"material": ross().Material(old.name, **changed)})
