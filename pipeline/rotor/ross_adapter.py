"""The one module that imports ROSS: configuration in, matrices and bearing tables out.

``import ross`` takes seconds, so it happens on first use.
"""

from __future__ import annotations

import itertools
import sys
import warnings
from collections.abc import Iterator, Sequence
from functools import cache
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from pipeline.config.rotor import RotorConfig, ShaftSegmentConfig
from pipeline.errors import ConfigError, name_beside, nearest
from pipeline.rotor.bearing_table import BearingTable
from pipeline.rotor.bearings import BearingConfig, Operating, flatten
from pipeline.rotor.model import RotorModel
from pipeline.rotor.supports import Stand, find_seals, find_stands
from pipeline.rotor.weight import GRAVITY

_LATERAL = (0, 1, 3, 4)
"""x, y, alpha, beta among ROSS's six DOF of a node (x, y, z, alpha, beta, theta)."""


@cache
def ross() -> Any:
    """The module ``ross``. Its package of fluids serves gas seals alone, takes half of its time and prints at C level:
    it is imported at its first use."""
    sys.modules["ccp"] = fluids = ModuleType("ccp")
    vars(fluids)["__getattr__"] = lambda name: getattr(import_module("ccp"), name)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # ROSS warns about optional parts
            import ross as module
    finally:
        del sys.modules["ccp"]
    return module


@cache
def assemble(config: RotorConfig) -> RotorModel:
    """Shaft and discs of a configuration as matrices, without bearings.

    Raises ConfigError where ``config.file`` can't be read.
    """
    rotor = make_rotor(config)
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
        supported_nodes=tuple(stand.node for stand in stands if config.file and stand.supported),
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


def bearing_table(
    config: RotorConfig, bearing: BearingConfig, speeds: np.ndarray, operating: Operating | None = None
) -> BearingTable:
    """The modelled coefficients at ``speeds`` (S,) rad/s and ``operating`` conditions (S,).

    Raises ConfigError where a bearing needs a condition that is not there, or gives no finite coefficients.
    """
    rotor = make_rotor(config)
    speeds, operating = np.asarray(speeds, dtype=float), operating or {}
    if bearing.saved:
        stands = _find_stands(rotor)
        nodes = tuple(stand.node for stand in stands)
        values = np.array([[flatten(*stand.blocks(speed)) for speed in speeds] for stand in stands])
    else:
        nodes = _find_bearings(config, rotor)
        share = float(rotor.m * GRAVITY / len(nodes))
        values = np.stack([bearing.at(node).tabulate(speeds, operating, share, ross()) for node in nodes])
    if not np.isfinite(values).all():
        raise ConfigError(
            "Modelled bearing coefficients must be finite, but ROSS gave some that are not: check the bearing's "
            "load and geometry"
        )
    return BearingTable(nodes, speeds, values, operating)


def make_rotor(config: RotorConfig) -> Any:
    """ROSS's own rotor without bearings, or as its file has it. Raises ConfigError for a file that can't be read."""
    if config.file:
        return read_rotor_file(Path(config.file))
    rs = ross()
    if not config.material:
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
        if disc.mass
        else rs.DiskElement.from_geometry(
            n=disc.node, material=material, width=disc.width, i_d=disc.inner_diameter, o_d=disc.outer_diameter
        )
        for disc in config.discs
    ]
    return rs.Rotor(shaft, discs)


def _diameters(segment: ShaftSegmentConfig) -> Iterator[tuple[float, float]]:
    """Outer diameters of each element at its ends, m."""
    first, count = segment.outer_diameter, segment.elements
    rise = ((segment.end_diameter or first) - first) / count
    for i in range(count):
        yield first + i * rise, first + (i + 1) * rise


def _find_bearings(config: RotorConfig, rotor: Any) -> tuple[int, ...]:
    """Where the bearings stand: in a rotor file that has bearings, the file says so."""
    if config.file and (stands := _find_stands(rotor)):
        return tuple(stand.node for stand in stands)
    if not config.bearing_nodes:
        raise ConfigError(
            f"machine.rotor.file must have bearings to identify, but '{config.file}' has none: give "
            "machine.rotor.bearing_nodes"
        )
    return config.bearing_nodes


def read_rotor_file(file: Path) -> Any:
    """ROSS's rotor of a file that it saved (.toml, .json), read element by element.

    Its own loader knows half of its classes only, and solves the oil film of some again, though the file has the
    coefficients.

    Raises ConfigError: no such file, none that ROSS saved, an element of another class, several shafts.
    """
    rs = ross()
    if not file.is_file():
        raise ConfigError(
            f"machine.rotor.file must be a rotor saved by ROSS (.toml or .json), but there is no file '{file}'"
            + name_beside(file)
        )
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            data = rs.utils.load_data(file)
            elements = [
                _find_class(name, content, file).read_toml_data(content)
                for name, content in data.items()
                if name not in ("parameters", "ross_version") and not name.startswith("_")
            ]
            _check_shaft([element.n for element in elements if isinstance(element, rs.ShaftElement)], file)
            kinds = (rs.ShaftElement, rs.DiskElement, rs.BearingElement, rs.PointMass)
            parts = [[element for element in elements if isinstance(element, kind)] for kind in kinds]
            return rs.Rotor(*parts, **data["parameters"])
    except ConfigError:
        raise
    except Exception as error:  # ROSS's elements and its rotor raise many kinds
        raise ConfigError(
            f"machine.rotor.file must be a rotor saved by ROSS (.toml or .json), but '{file}' can't be read as one "
            f"({type(error).__name__}: {error})"
        ) from error


def _find_class(name: str, content: Any, file: Path) -> Any:
    """The class that reads an element that is called CLASS_TAG in the file: the simplest that has its matrices."""
    rs, word = ross(), name.partition("_")[0]
    ross_class = getattr(rs, word, None)
    kinds = (rs.ShaftElement, rs.DiskElement, rs.BearingElement, rs.PointMass)
    if not isinstance(ross_class, type) or not issubclass(ross_class, kinds):
        known = sorted(
            name for name, candidate in vars(rs).items() if isinstance(candidate, type) and issubclass(candidate, kinds)
        )
        raise ConfigError(
            f"machine.rotor.file must have elements that ROSS {rs.__version__} knows, but '{file}' has a '{word}': "
            f"{nearest(word, known)}; put a DiskElement, BearingElement or ShaftElement of its values in its place"
        )
    if issubclass(ross_class, rs.DiskElement) and "m" in content:
        return rs.DiskElement
    count, speeds = len(content.get("kxx") or []), len(content.get("frequency") or [])
    if issubclass(ross_class, rs.BearingElement) and count in (1, speeds):
        return rs.SealElement if issubclass(ross_class, rs.SealElement) else rs.BearingElement
    return ross_class


def _check_shaft(starts: list[Any], file: Path) -> None:
    """Raise ConfigError where the elements, at the nodes ``starts``, are not one shaft from node 0 on."""
    nodes = sorted({int(start) for start in starts})
    if not nodes:
        raise ConfigError(f"machine.rotor.file must have a shaft, but '{file}' has no ShaftElement")
    if nodes[0] != 0:
        raise ConfigError(f"machine.rotor.file must have a shaft from node 0 on, but '{file}' begins at {nodes[0]}")
    for a, b in itertools.pairwise(nodes):
        if b != a + 1:
            raise ConfigError(
                f"machine.rotor.file must have one shaft, but that of '{file}' ends at node {a + 1} and another begins "
                f"at node {b} (rotors on one axis or joined by gears): save the rotor that was measured by itself"
            )
