"""The schema of a rotor: shaft, material, discs. SI."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated

from pydantic import Field, PositiveInt

from pipeline.config.quantities import (
    AnyDamping,
    AnyStiffness,
    Bore,
    Damping,
    Density,
    Frequency,
    Inertia,
    Length,
    Mass,
    Pressure,
    Stiffness,
)
from pipeline.config.section import NonNegativeInt, Once, Section, ascending, rule


class MaterialConfig(Section):
    """An isotropic shaft and disc material."""

    density: Density
    youngs_modulus: Pressure
    shear_modulus: Pressure


class ShaftSegmentConfig(Section):
    """A piece of shaft, divided into ``elements`` equally long finite elements.

    It is a cylinder, or with ``end_diameter`` a cone from ``outer_diameter`` to that.
    """

    length: Length
    outer_diameter: Length
    end_diameter: Length | None = None
    inner_diameter: Bore = 0.0
    elements: PositiveInt = 1

    _hollow = ascending("inner_diameter", "outer_diameter", strictly=True)
    _hollow_end = ascending("inner_diameter", "end_diameter", strictly=True)


class DiscConfig(Section):
    """A rigid disc: by its geometry (width, diameters) or by its inertia (mass, Id, Ip)."""

    node: NonNegativeInt
    width: Length | None = None
    inner_diameter: Length | None = None
    outer_diameter: Length | None = None
    mass: Mass | None = None
    diametral_inertia: Inertia | None = None
    polar_inertia: Inertia | None = None

    _hollow = ascending("inner_diameter", "outer_diameter", strictly=True)

    @rule
    def _one_description(self) -> Iterator[str]:
        geometry = (self.width, self.inner_diameter, self.outer_diameter)
        inertia = (self.mass, self.diametral_inertia, self.polar_inertia)
        complete = [all(group) for group in (geometry, inertia)]
        given = [any(group) for group in (geometry, inertia)]
        if given != complete or sum(complete) != 1:
            yield (
                "must give either width, inner_diameter and outer_diameter, or mass, diametral_inertia and "
                f"polar_inertia, but got {sorted(self.model_fields_set - {'node'})}"
            )


class SupportConfig(Section):
    """What the casing of the bearing at ``node`` stands on, in x and in y, and the mass that moves with it."""

    node: NonNegativeInt
    mxx: Mass
    myy: Mass
    kxx: Stiffness
    kyy: Stiffness
    cxx: Damping
    cyy: Damping
    kxy: AnyStiffness = 0.0
    kyx: AnyStiffness = 0.0
    cxy: AnyDamping = 0.0
    cyx: AnyDamping = 0.0

    @property
    def matrices(self) -> dict[str, list[list[float]]]:
        """Of x and y, by the names of RotorModel's."""
        return {
            "mass": [[self.mxx, 0.0], [0.0, self.myy]],
            "damping": [[self.cxx, self.cxy], [self.cyx, self.cyy]],
            "stiffness": [[self.kxx, self.kxy], [self.kyx, self.kyy]],
        }


class BaseModeConfig(Section):
    """A mode of a base: its ``participation`` is the motion in x and y of each point, normalised to unit modal mass."""

    frequency: Frequency
    damping_ratio: Annotated[float, Field(ge=0, lt=1)]
    participation: tuple[tuple[float, float], ...]


class BaseConfig(Section):
    """A base that pedestals share, by its modes without the rotor.

    ``points`` are bearing nodes: the first of a node is its pedestal, further ones are places of probes beside it.
    """

    points: tuple[NonNegativeInt, ...] = ()
    modes: tuple[BaseModeConfig, ...] = ()

    @rule
    def _lawful(self) -> Iterator[str]:
        if bool(self.points) != bool(self.modes):
            yield "must have both points and modes, or neither"
        for r, mode in enumerate(self.modes):
            if not any(map(any, mode.participation)):
                yield f"must have modes that move a point, but all of mode {r + 1} is zero: leave it out"
            if len(mode.participation) != len(self.points):
                yield (
                    f"must give every mode the participation of each of {len(self.points)} points, but got "
                    f"{len(mode.participation)}"
                )


class RotorConfig(Section):
    """Shaft, discs and bearing nodes; or ``file``, a rotor saved by ROSS (.toml, .json).

    ``supports`` are those of bearings on soft ground: the casing of the first is the node after the shaft's last, and
    so on; so are the points of a ``base`` that bearings share.
    """

    file: str | None = None
    shaft: tuple[ShaftSegmentConfig, ...] = ()
    material: MaterialConfig | None = None
    discs: tuple[DiscConfig, ...] = ()
    bearing_nodes: Annotated[tuple[NonNegativeInt, ...], Once] = ()
    supports: tuple[SupportConfig, ...] = ()
    base: BaseConfig = BaseConfig()
    shear_effects: bool = True
    rotary_inertia: bool = True  # of the shaft

    @property
    def n_nodes(self) -> int:
        """Nodes of the shaft and casings; the shaft of a file has its own."""
        return sum(segment.elements for segment in self.shaft) + 1 + self.n_casings

    @property
    def n_casings(self) -> int:
        """Casings on supports, or points of a base."""
        return len(self.supports) + len(self.base.points)

    @rule
    def _nodes_exist(self) -> Iterator[str]:
        if self.supports and self.base.points:
            yield "must have supports or a base, but both are given: a support is a base of a mode in x and one in y"
        if self.file:
            return
        if not self.shaft or not self.material or not self.bearing_nodes:
            yield "must give shaft, material and bearing_nodes (or file, a rotor saved by ROSS)"
        last = sum(segment.elements for segment in self.shaft)
        for what, nodes in (
            ("bearing_nodes", self.bearing_nodes),
            ("discs", [disc.node for disc in self.discs]),
        ):
            for node in nodes:
                if node > last:
                    yield f"must use nodes 0 to {last} (the shaft has {last} elements), but {what} got node {node}"
