"""The one module that imports ROSS: configuration in, matrices and bearing tables out.

``import ross`` takes seconds and prints at C level, so it happens on first use, with file descriptor 1
pointed elsewhere.
"""

from __future__ import annotations

import os
import sys
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.coefficients import COEFFICIENTS
from pipeline.config.bearings import (
    BallBearingConfig,
    BearingConfig,
    CylindricalBearingConfig,
    PerNodeBearingConfig,
    RotorFileBearingConfig,
)
from pipeline.config.guesses import CONDITION
from pipeline.config.rotor import RotorConfig, ShaftSegmentConfig
from pipeline.errors import ConfigError
from pipeline.laws.points import LOAD, OIL_TEMPERATURE
from pipeline.rotor.bearing_table import BearingTable
from pipeline.rotor.journal_table import (
    Operating,
    follows_conditions,
    pick_condition,
    tabulate,
)
from pipeline.rotor.model import RotorModel
from pipeline.rotor.ross_file import read_rotor_file
from pipeline.rotor.supports import Stand, find_seals, find_stands

GRAVITY = 9.80665  # m/s^2
_SPLINE_POINTS = 4
_LATERAL = (0, 1, 3, 4)
"""x, y, alpha, beta among ROSS's six DOF of a node (x, y, z, alpha, beta, theta)."""


@contextmanager
def _quiet_stdout() -> Iterator[None]:
    sys.stdout.flush()
    saved = os.dup(1)
    sink = os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(sink, 1)
        yield
    finally:
        os.dup2(saved, 1)
        os.close(saved)
        os.close(sink)


@cache
def ross() -> Any:
    """The module ``ross``, imported in silence."""
    with _quiet_stdout(), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # ROSS and its fluid-property packages warn about optional parts
        import ross as module
    return module


@cache
def assemble(config: RotorConfig) -> RotorModel:
    """Shaft and discs of a configuration as matrices, without bearings.

    Raises ConfigError where ``config.file`` can't be read.
    """
    rotor = _make_rotor(config)
    lateral = np.array([rotor.number_dof * node + dof for node in range(len(rotor.nodes)) for dof in _LATERAL])
    last, stands = len(rotor.nodes) - 1, _find_stands(rotor)
    beside = {*map(id, rotor.bearing_elements), *(id(mass) for mass in rotor.point_mass_elements if mass.n > last)}
    without_bearings = [element for element in rotor.elements if id(element) not in beside]
    mass, damping, gyroscopic, stiffness = _sum_elements(rotor, without_bearings, lateral)
    shaft_mass, _, shaft_gyroscopic, _ = _sum_elements(rotor, rotor.shaft_elements, lateral)
    return RotorModel(
        mass=mass,
        damping=damping,
        gyroscopic=gyroscopic,
        stiffness=stiffness,
        shaft_mass=shaft_mass,
        shaft_gyroscopic=shaft_gyroscopic,
        positions=np.array(rotor.nodes_pos, dtype=float),
        bearing_nodes=_find_bearings(config, rotor),
        disc_nodes=tuple(int(disc.n) for disc in rotor.disk_elements),
        total_mass=float(rotor.m),
        seals=find_seals(rotor.bearing_elements, last, ross().SealElement),
        supported_nodes=tuple(stand.node for stand in stands if config.file is not None and stand.supported),
    )


def _find_stands(rotor: Any) -> tuple[Stand, ...]:
    """The bearings of a rotor, with their supports."""
    last = len(rotor.nodes) - 1
    return find_stands(rotor.bearing_elements, rotor.point_mass_elements, last, ross().SealElement)


def _sum_elements(rotor: Any, elements: Sequence[Any], lateral: np.ndarray) -> list[np.ndarray]:
    """M, C, G, K of the ``elements`` at the ``lateral`` DOF, summed in the rotor's own order.

    ROSS sums them in the order of a set, which changes from process to process, and with it their last bits.
    """
    sums = [np.zeros((rotor.ndof, rotor.ndof)) for _ in range(4)]
    for element in elements:
        where = np.ix_(*[list(element.dof_global_index.values())] * 2)
        for total, matrix in zip(sums, (element.M(), element.C(), element.G(), element.K()), strict=True):
            total[where] += matrix
    return [matrix[np.ix_(lateral, lateral)] for matrix in sums]


def make_rotor(config: RotorConfig) -> Any:
    """ROSS's own rotor without bearings, or as its file has it. Raises ConfigError for a file that can't be read."""
    return _make_rotor(config)


def ross_rotor(config: RotorConfig, bearing: BearingConfig, speeds: np.ndarray) -> Any:
    """ROSS's own rotor with bearings, for its analyses (and as an oracle in tests). ``speeds`` (S,) rad/s."""
    rotor = _make_rotor(config)
    if isinstance(bearing, RotorFileBearingConfig):
        return rotor
    seals = [element for element in rotor.bearing_elements if isinstance(element, ross().SealElement)]
    bearings = _make_elements(config, bearing, rotor, speeds)
    return ross().Rotor(rotor.shaft_elements, rotor.disk_elements, [*bearings, *seals])


def bearing_table(
    config: RotorConfig, bearing: BearingConfig, speeds: np.ndarray, operating: Operating | None = None
) -> BearingTable:
    """The modelled coefficients at ``speeds`` (S,) rad/s and ``operating`` conditions (S,).

    Raises ConfigError where a bearing needs a condition that is not there, or gives no finite coefficients.
    """
    rotor = _make_rotor(config)
    speeds = np.asarray(speeds, dtype=float)
    if isinstance(bearing, RotorFileBearingConfig):
        stands = _find_stands(rotor)
        nodes = tuple(stand.node for stand in stands)
        values = np.array([[_flatten(*stand.blocks(speed)) for speed in speeds] for stand in stands])
    else:
        nodes = _find_bearings(config, rotor)
        share = rotor.m * GRAVITY / len(nodes)
        values = np.stack([_tabulate_at(_select(bearing, node), speeds, operating or {}, share) for node in nodes])
    if not np.isfinite(values).all():
        raise ConfigError(
            "Modelled bearing coefficients must be finite, but ROSS gave some that are not: check the bearing's "
            "load and geometry"
        )
    return BearingTable(nodes, speeds, values, operating or {})


def _tabulate_at(bearing: BearingConfig, speeds: np.ndarray, operating: Operating, share: float) -> np.ndarray:
    """(S, 8) of one bearing; ``share`` is its part of the rotor's weight, N."""
    table = tabulate(bearing, speeds, operating, share)
    if table is not None:
        return table
    if isinstance(bearing, BallBearingConfig) and bearing.static_load == CONDITION:
        loads, group = np.unique(pick_condition(operating, LOAD, len(speeds)), return_inverse=True)
        given = [bearing.model_copy(update={"static_load": float(load)}) for load in loads]
        return np.stack([_tabulate_at(loaded, speeds[:1], {}, share)[0] for loaded in given])[group]
    ascending, group = np.unique(speeds, return_inverse=True)  # ROSS's splines over the speed ask for that
    element = _make_element(bearing, 0, ascending, share)
    return np.array([_flatten(element.K(speed), element.C(speed)) for speed in ascending])[group]


def _select(bearing: BearingConfig, node: int) -> BearingConfig:
    """The bearing at a node. Raises ConfigError where there is none."""
    if not isinstance(bearing, PerNodeBearingConfig):
        return bearing
    if node not in bearing.nodes:
        raise ConfigError(
            f"machine.bearings.nodes must have a bearing for every bearing node, but node {node} has none (it has "
            f"{', '.join(map(str, bearing.nodes))})"
        )
    return bearing.nodes[node]


def _flatten(stiffness: np.ndarray, damping: np.ndarray) -> list[float]:
    """The eight coefficients of matrices over x and y (and more)."""
    blocks = {"k": stiffness, "c": damping}
    return [float(blocks[name[0]]["xy".index(name[1]), "xy".index(name[2])]) for name in COEFFICIENTS]


def _make_elements(config: RotorConfig, bearing: BearingConfig, rotor: Any, speeds: np.ndarray) -> list[Any]:
    """ROSS bearing elements of ``bearing`` at every bearing node of the rotor."""
    nodes = _find_bearings(config, rotor)
    share = rotor.m * GRAVITY / len(nodes)
    return [_make_element(_select(bearing, node), node, speeds, share) for node in nodes]


def _make_element(bearing: BearingConfig, node: int, speeds: np.ndarray, share: float) -> Any:
    """ROSS's element; ``share`` is the bearing's part of the rotor's weight, N."""
    rs = ross()
    if follows_conditions(bearing):
        pick_condition({}, LOAD if getattr(bearing, "static_load", None) == CONDITION else OIL_TEMPERATURE, 0)
    if isinstance(bearing, BallBearingConfig):
        return rs.BallBearingElement(
            n=node,
            n_balls=bearing.n_balls,
            d_balls=bearing.ball_diameter,
            fs=bearing.static_load,
            alpha=bearing.contact_angle,
        )
    if isinstance(bearing, CylindricalBearingConfig):
        return rs.CylindricalBearing(
            n=node,
            speed=[float(speed) for speed in speeds],
            weight=bearing.static_load or share,
            bearing_length=bearing.length,
            journal_diameter=bearing.journal_diameter,
            radial_clearance=bearing.radial_clearance,
            oil_viscosity=bearing.oil_viscosity,
        )
    table = tabulate(bearing, speeds, {}, share)
    assert table is not None, bearing.kind
    columns = {name: [float(v) for v in column] for name, column in zip(COEFFICIENTS, table.T, strict=True)}
    if len(speeds) < _SPLINE_POINTS:  # too few for ROSS's spline over the speed
        return rs.BearingElement(n=node, **{name: column[0] for name, column in columns.items()})
    return rs.BearingElement(n=node, **columns, frequency=[float(speed) for speed in speeds])


def _make_rotor(config: RotorConfig) -> Any:
    """ROSS's rotor without bearings, or as its file has it."""
    if config.file is not None:
        return read_rotor_file(ross(), Path(config.file))
    rs = ross()
    if config.material is None:
        raise ConfigError("machine.rotor.material must be given for a rotor without machine.rotor.file")
    material = rs.Material(
        "rotor",
        rho=config.material.density,
        E=config.material.youngs_modulus,
        G_s=config.material.shear_modulus,
    )
    shaft = [
        rs.ShaftElement(
            L=segment.length / segment.elements,
            idl=segment.inner_diameter,
            odl=left,
            odr=right,
            material=material,
            shear_effects=config.shear_effects,
            rotary_inertia=config.rotary_inertia,
        )
        for segment in config.shaft
        for left, right in _diameters(segment)
    ]
    discs = [
        rs.DiskElement(n=disc.node, m=disc.mass, Id=disc.diametral_inertia, Ip=disc.polar_inertia)
        if disc.mass is not None
        else rs.DiskElement.from_geometry(
            n=disc.node, material=material, width=disc.width, i_d=disc.inner_diameter, o_d=disc.outer_diameter
        )
        for disc in config.discs
    ]
    return rs.Rotor(shaft, discs)


def _diameters(segment: ShaftSegmentConfig) -> Iterator[tuple[float, float]]:
    """Outer diameters of each element at its ends, m."""
    first, count = segment.outer_diameter, segment.elements
    rise = 0.0 if segment.end_diameter is None else (segment.end_diameter - first) / count
    for i in range(count):
        yield first + i * rise, first + (i + 1) * rise


def _find_bearings(config: RotorConfig, rotor: Any) -> tuple[int, ...]:
    """Where the bearings stand: in a rotor file that has bearings, the file says so."""
    if config.file is not None and (stands := _find_stands(rotor)):
        return tuple(stand.node for stand in stands)
    if not config.bearing_nodes:
        raise ConfigError(
            f"machine.rotor.file must have bearings to identify, but '{config.file}' has none: give "
            "machine.rotor.bearing_nodes"
        )
    return config.bearing_nodes
