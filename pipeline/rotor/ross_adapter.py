"""The one module that imports ROSS: configuration in, matrices and bearing tables out.

``import ross`` takes seconds, so it happens on first use.

A bearing on a support is identified as the shaft feels it, film and support in series: no vibration of the shaft tells
one from the other. With a support's node i and a shaft's node s it is

    Z = Z_ss - Z_si Z_ii^-1 Z_is,     K = Re Z,     C = Im Z / w,     each part K + j w C - w^2 M

at the speed w: exact where the frequency is the rotor's.

Legend: m nodes of a stand, the shaft's first. SI units.
"""

from __future__ import annotations

import itertools
import sys
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache, lru_cache
from importlib import import_module
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np

from pipeline.config.rotor import RotorConfig
from pipeline.errors import ConfigError, name_beside, nearest
from pipeline.files import hash_file
from pipeline.rotor.bearing_table import BearingTable
from pipeline.rotor.bearings import BearingConfig, Operating, flatten
from pipeline.rotor.model import COLUMNS, NO_SEALS, RotorModel, Seals
from pipeline.rotor.weight import GRAVITY
from pipeline.write_numbers import write_number

_LATERAL = (0, 1, 3, 4)
"""x, y, alpha, beta among ROSS's six DOF of a node (x, y, z, alpha, beta, theta)."""


@cache
def ross() -> Any:
    """The module ``ross``. Its package of fluids serves gas seals alone, takes half of its time and prints at C level:
    it is imported at its first use."""
    sys.modules["ccp"] = fluids = ModuleType("ccp")
    vars(fluids)["__getattr__"] = lambda name: getattr(import_module("ccp"), name)
    try:
        with warnings.catch_warnings(action="ignore"):  # ROSS warns about optional parts
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
    last, stands = len(rotor.nodes) - 1, find_stands(rotor)
    on_shaft = [*rotor.disk_elements, *(mass for mass in rotor.point_mass_elements if mass.n <= last)]
    shaft = _sum_elements(len(rotor.nodes), rotor.shaft_elements)
    mass, damping, gyroscopic, stiffness = shaft + _sum_elements(len(rotor.nodes), on_shaft)
    return RotorModel(
        mass=mass,
        damping=damping,
        gyroscopic=gyroscopic,
        stiffness=stiffness,
        shaft_mass=shaft[0],
        shaft_gyroscopic=shaft[2],
        positions=np.array(rotor.nodes_pos, dtype=float),
        bearing_nodes=_find_bearings(config, rotor),
        disc_nodes=tuple(int(disc.n) for disc in rotor.disk_elements),
        total_mass=float(rotor.m),
        seals=find_seals(rotor),
        supported_nodes=tuple(stand.node for stand in stands if config.file and stand.supported),
    )


def _sum_elements(n_nodes: int, elements: Sequence[Any]) -> np.ndarray:
    """M, C, G, K of the ``elements`` of a shaft at its lateral DOF, (4, 4 ``n_nodes``, 4 ``n_nodes``), in their order.

    ROSS sums them in the order of a set, which changes from process to process, and with it their last bits.
    """
    total, lateral = np.zeros((4, 6 * n_nodes, 6 * n_nodes)), np.add.outer(6 * np.arange(n_nodes), _LATERAL).ravel()
    for element in elements:
        places = 6 * element.n + np.array(list(element.dof_mapping().values()))
        total[:, places[:, None], places] += [element.M(), element.C(), element.G(), element.K()]
    return total[:, lateral[:, None], lateral]


def bearing_table(
    config: RotorConfig, bearing: BearingConfig, speeds: np.ndarray, operating: Operating | None = None
) -> BearingTable:
    """The modelled coefficients at ``speeds`` (S,) rad/s and ``operating`` conditions (S,).

    Raises ConfigError where a bearing needs a condition that is not there, or gives no finite coefficients.
    """
    rotor = make_rotor(config)
    speeds, operating = np.asarray(speeds, dtype=float), operating or {}
    if bearing.saved:
        stands = find_stands(rotor)
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
    """ROSS's elements of a rotor, and what they sum to: its own rotor where a file has one, which it checks.

    Without a file the names of ROSS's rotor are there, but not its tables of pandas: 1 s for 200 elements.

    Raises ConfigError for a file that can't be read.
    """
    if config.file:
        return read_rotor_file(Path(config.file), hash_file(Path(config.file)))
    rs = ross()
    if not config.material:
        raise ConfigError("machine.rotor.material must be given for a rotor without machine.rotor.file")
    material = rs.Material(
        "rotor",
        rho=config.material.density,
        E=config.material.youngs_modulus,
        G_s=config.material.shear_modulus,
    )
    nodes = itertools.count()
    shaft = [
        rs.ShaftElement(
            n=next(nodes),
            L=segment.length / segment.elements,
            idl=segment.inner_diameter,
            odl=segment.outer_diameter + i * rise,
            odr=segment.outer_diameter + (i + 1) * rise,
            material=material,
            shear_effects=config.shear_effects,
            rotary_inertia=config.rotary_inertia,
        )
        for segment in config.shaft
        for rise in [((segment.end_diameter or segment.outer_diameter) - segment.outer_diameter) / segment.elements]
        for i in range(segment.elements)
    ]
    discs = [
        rs.DiskElement(n=disc.node, m=disc.mass, Id=disc.diametral_inertia, Ip=disc.polar_inertia)
        if disc.mass
        else rs.DiskElement.from_geometry(
            n=disc.node, material=material, width=disc.width, i_d=disc.inner_diameter, o_d=disc.outer_diameter
        )
        for disc in config.discs
    ]
    return SimpleNamespace(
        shaft_elements=shaft,
        disk_elements=discs,
        bearing_elements=[],
        point_mass_elements=[],
        nodes=range(len(shaft) + 1),
        nodes_pos=np.cumsum([0.0, *(element.L for element in shaft)]),
        m=np.sum([disc.m for disc in discs]) + np.sum([element.m for element in shaft]),
    )


def _find_bearings(config: RotorConfig, rotor: Any) -> tuple[int, ...]:
    """Where the bearings stand: in a rotor file that has bearings, the file says so."""
    if config.file and (stands := find_stands(rotor)):
        return tuple(stand.node for stand in stands)
    if not config.bearing_nodes:
        raise ConfigError(
            f"machine.rotor.file must have bearings to identify, but '{config.file}' has none: give "
            "machine.rotor.bearing_nodes"
        )
    return config.bearing_nodes


@lru_cache(maxsize=1)
def read_rotor_file(file: Path, _: str) -> Any:
    """ROSS's rotor of a file that it saved (.toml, .json), read element by element, once while its hash stays.

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
        with warnings.catch_warnings(action="ignore"):
            data = rs.utils.load_data(file)
            kinds = (rs.ShaftElement, rs.DiskElement, rs.BearingElement, rs.PointMass)
            elements = [
                _find_class(name, content, file, kinds).read_toml_data(content)
                for name, content in data.items()
                if name not in ("parameters", "ross_version") and not name.startswith("_")
            ]
            nodes = sorted({int(element.n) for element in elements if isinstance(element, rs.ShaftElement)})
            if not nodes:
                raise ConfigError(f"machine.rotor.file must have a shaft, but '{file}' has no ShaftElement")
            if nodes[0] != 0:
                raise ConfigError(
                    f"machine.rotor.file must have a shaft from node 0 on, but '{file}' begins at {nodes[0]}"
                )
            if gap := next(((a, b) for a, b in itertools.pairwise(nodes) if b != a + 1), None):
                raise ConfigError(
                    f"machine.rotor.file must have one shaft, but that of '{file}' ends at node {gap[0] + 1} and "
                    f"another begins at node {gap[1]} (rotors on one axis or joined by gears): save the rotor that was "
                    "measured by itself"
                )
            parts = [[element for element in elements if isinstance(element, kind)] for kind in kinds]
            return rs.Rotor(*parts, **data["parameters"])
    except ConfigError:
        raise
    except Exception as error:  # ROSS's elements and its rotor raise many kinds
        raise ConfigError(
            f"machine.rotor.file must be a rotor saved by ROSS (.toml or .json), but '{file}' can't be read as one "
            f"({type(error).__name__}: {error})"
        ) from error


def _find_class(name: str, content: Any, file: Path, kinds: tuple[Any, ...]) -> Any:
    """The class that reads an element that is called CLASS_TAG in the file, of one of the ``kinds``: the simplest that
    has its matrices."""
    rs, word = ross(), name.partition("_")[0]
    ross_class = getattr(rs, word, None)
    if not isinstance(ross_class, type) or not issubclass(ross_class, kinds):
        known = sorted(
            name for name, candidate in vars(rs).items() if isinstance(candidate, type) and issubclass(candidate, kinds)
        )
        raise ConfigError(
            f"machine.rotor.file must have elements that ROSS {rs.__version__} knows, but '{file}' has a '{word}': "
            f"{nearest(word, known)}; put a DiskElement, BearingElement or ShaftElement of its values in its place"
        )
    if wide := [key for key in COLUMNS if np.ndim(content.get(key) or 0) > 1]:
        raise ConfigError(
            f"machine.rotor.file must have coefficients over one axis, frequency, which is read as the speed, but "
            f"{wide[0]} of '{name}' in '{file}' has {np.shape(content[wide[0]])} values: save it with those at the "
            "frequency of each speed"
        )
    if issubclass(ross_class, rs.DiskElement) and "m" in content:
        return rs.DiskElement
    count, speeds = len(content.get("kxx") or []), len(content.get("frequency") or [])
    if issubclass(ross_class, rs.BearingElement) and count in (1, speeds):
        return rs.SealElement if issubclass(ross_class, rs.SealElement) else rs.BearingElement
    return ross_class


# --- what stands between shaft and ground --------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Stand:
    """Everything that holds one node of the shaft: ROSS's bearing elements, and point masses beside the shaft."""

    node: int
    elements: tuple[Any, ...]
    masses: tuple[Any, ...] = ()

    @property
    def supported(self) -> bool:
        """True where the coefficients that the shaft feels hold at the rotor's own frequency alone."""
        linked = any(_ends(element) != {self.node} for element in self.elements)
        return linked or any(_has(element, "m") for element in self.elements)

    def blocks(self, speed: float) -> tuple[np.ndarray, np.ndarray]:
        """K and C (2, 2) that the shaft feels at ``speed`` rad/s."""
        if not self.supported:  # as they stand in the file
            stiffness = sum(element.K(speed)[:2, :2] for element in self.elements)
            return np.asarray(stiffness), np.asarray(sum(element.C(speed)[:2, :2] for element in self.elements))
        felt = self._condense(speed)
        return felt.real, felt.imag / speed

    def _condense(self, w: float) -> np.ndarray:
        nodes = list(dict.fromkeys([self.node, *(end for one in self.elements for end in sorted(_ends(one)))]))
        total = np.zeros((len(nodes), 2, len(nodes), 2), dtype=complex)
        for element in self.elements:
            whole = element.K(w) + 1j * w * element.C(w) - w**2 * element.M(w)
            ends = [nodes.index(int(end)) for end in (element.n, element.n_link) if end is not None]
            for i, a in enumerate(ends):
                for j, b in enumerate(ends):
                    total[a, :, b] += whole[3 * i : 3 * i + 2, 3 * j : 3 * j + 2]
        for mass in self.masses:
            at = nodes.index(int(mass.n))
            total[at, :, at] -= w**2 * mass.M()[:2, :2]
        matrix = total.reshape(2 * len(nodes), 2 * len(nodes))
        try:
            solution = np.linalg.solve(matrix[2:, 2:], matrix[2:, :2])
        except np.linalg.LinAlgError:
            raise ConfigError(
                f"a support must be held to give its bearing coefficients, but that of node {self.node} is not at "
                f"{write_number(w, digits=6)} rad/s: add a bearing element from its node to the ground"
            ) from None
        return np.asarray(matrix[:2, :2] - matrix[:2, 2:] @ solution)


def find_stands(rotor: Any) -> tuple[Stand, ...]:
    """The bearings of ROSS's ``rotor`` with their supports, one for each node of the shaft that one stands at.

    Raises ConfigError for bearings that hold two nodes of the shaft together.
    """
    last, stands = len(rotor.nodes) - 1, []
    bearings = [element for element in rotor.bearing_elements if not isinstance(element, ross().SealElement)]
    # A thrust bearing holds the shaft along its axis alone.
    bearings = [element for element in bearings if _has(element, *"kcm") or not _has(element, "kzz", "czz")]
    for node in sorted({end for bearing in bearings for end in _ends(bearing) if end <= last}):
        joined, found = {node}, []
        rest = list(bearings)
        # From the shaft's node through the supports; another node of the shaft ends the way.
        while grown := [element for element in rest if _ends(element) & joined]:
            rest = [element for element in rest if element not in grown]
            found += grown
            joined |= {end for element in grown for end in _ends(element) if end > last}
            both = sorted({end for element in grown for end in _ends(element) if end <= last} | {node})
            if len(both) > 1:
                raise ConfigError(
                    "machine.rotor.file must hold each bearing node of the shaft by itself, but "
                    f"'{grown[0].tag}' holds the nodes {both[0]} and {both[1]} together: give each bearing a support "
                    "of its own, or link it to none (n_link)"
                )
        beside = tuple(mass for mass in rotor.point_mass_elements if int(mass.n) in joined and int(mass.n) > last)
        stands.append(Stand(node, tuple(found), beside))
    return tuple(stands)


def find_seals(rotor: Any) -> Seals:
    """The seals of ROSS's ``rotor``. Raises ConfigError for one on a support, and one beside the shaft."""
    rows: list[list[float]] = []
    seals: list[Any] = [element for element in rotor.bearing_elements if isinstance(element, ross().SealElement)]
    for seal, spring in enumerate(seals):
        if spring.n_link is not None or spring.n >= len(rotor.nodes):
            raise ConfigError(
                f"machine.rotor.file must have seals between shaft and ground, but '{spring.tag}' at node {spring.n} "
                "stands on a support: leave out its n_link"
            )
        constant = spring.frequency is None or len(spring.kxx) == 1
        speeds = np.array([np.nan]) if constant else np.array(spring.frequency, dtype=float)
        columns = np.array([np.asarray(getattr(spring, name), dtype=float) for name in COLUMNS])
        rows += [[seal, spring.n, speed, *values] for speed, values in zip(speeds, columns.T, strict=True)]
    return Seals(np.array(rows)) if rows else NO_SEALS


def _ends(element: Any) -> set[int]:
    """The nodes that an element joins to each other or to the ground."""
    return {int(element.n)} | ({int(element.n_link)} if element.n_link is not None else set())


def _has(element: Any, *kinds: str) -> bool:
    """Whether a coefficient of these kinds (k, c, m: any lateral one) is not zero."""
    names = [name for name in (*COLUMNS, "kzz", "czz") if name in kinds or (name[0] in kinds and name in COLUMNS)]
    return any(np.any(np.asarray(getattr(element, name), dtype=float)) for name in names)
