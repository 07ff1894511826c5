"""Modelled bearings: each kind with its section of the configuration, its coefficients, and ROSS's element of it.

Legend: S operating points, 8 coefficients. SI units, temperatures in K.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, get_args

import numpy as np
from pydantic import Field, PositiveInt, create_model

from pipeline.coefficients import COEFFICIENTS
from pipeline.config.quantities import (
    CONDITION,
    Angle,
    Length,
    ModelledLoad,
    ShaftAngle,
    check_clearance,
    define_coefficients,
)
from pipeline.config.section import NonNegativeInt, Section, rule
from pipeline.errors import ConfigError
from pipeline.laws.numbers import LOAD, scale_film, turn_axes
from pipeline.laws.oil import ConstantOilConfig, ModelledViscosity, OilConfig
from pipeline.laws.short_bearing import short_coefficients, short_eccentricity
from pipeline.laws.table import make_film_table, packaged_file, read_film_table
from pipeline.write_numbers import write_number

Operating = Mapping[str, np.ndarray]


class _Bearing(Section):
    """A kind of bearing: a new one is a class with :meth:`tabulate` or :meth:`make_element`, named in a union below.

    A ``static_load`` of ``condition`` and an ``oil_viscosity`` that is a law follow operating conditions.
    """

    changes: ClassVar[bool] = True
    """Whether its coefficients may change with the speed."""
    saved: ClassVar[bool] = False
    """Whether it is part of the rotor's file."""

    def at(self, node: int) -> _Bearing:
        """The bearing at a node. Raises ConfigError where there is none."""
        return self

    @property
    def places(self) -> tuple[int, ...]:
        """The nodes that it names; none for all alike."""
        return ()

    def read_bytes(self) -> bytes:
        """What the file of its table holds; nothing where it has none, or there is no such file."""
        return b""

    @property
    def oil(self) -> OilConfig:
        """The oil; of a bearing without a film one that follows nothing."""
        oil = getattr(self, "oil_viscosity", 1.0)
        return ConstantOilConfig(law="constant", viscosity=oil) if isinstance(oil, float) else oil

    @property
    def conditions(self) -> tuple[str, ...]:
        """The operating conditions that its coefficients follow."""
        return (*((LOAD,) if getattr(self, "static_load", None) == CONDITION else ()), *self.oil.inputs)

    def find_film(self, operating: Operating, share: float, count: int) -> tuple[np.ndarray, np.ndarray]:
        """(S,) load in N and viscosity in Pa s at ``count`` points; ``share`` is the load where it gives none.

        Raises ConfigError where a condition is missing, or not above zero.
        """
        given = {name: pick_condition(operating, name, count) for name in self.conditions}
        load = np.full(count, getattr(self, "static_load", None) or share) if LOAD not in given else given[LOAD]
        warm = [given[name] for name in self.oil.inputs] or [np.zeros(count)]
        return load, self.oil.viscosity_at(warm[0])

    def tabulate(self, speeds: np.ndarray, operating: Operating, share: float, ross: Any) -> np.ndarray:
        """(S, 8) at ``speeds`` (S,) rad/s and ``operating`` conditions (S,), N/m and N s/m.

        ``share`` is its part of the rotor's weight in N, ``ross`` the module. Here from ROSS's element, which has one
        load: one element for each. Raises ConfigError where a condition is missing.
        """
        if LOAD in self.conditions:
            loads, values = pick_condition(operating, LOAD, len(speeds)), np.empty((len(speeds), len(COEFFICIENTS)))
            for load in np.unique(loads):
                loaded = self.model_copy(update={"static_load": float(load)})
                values[loads == load] = loaded.tabulate(speeds[loads == load], {}, share, ross)
            return values
        ascending, group = np.unique(speeds, return_inverse=True)  # ROSS's splines over the speed ask for that
        element = self.make_element(ross, 0, ascending, share)
        return np.array([flatten(element.K(speed), element.C(speed)) for speed in ascending])[group]

    def make_element(self, ross: Any, node: int, speeds: np.ndarray, share: float) -> Any:
        """ROSS's element at ``speeds`` (S,) rad/s, ascending, of a kind that :meth:`tabulate` has no numbers of."""
        # Kinds that tabulate themselves are never asked: this names one that does neither.
        raise NotImplementedError(f"{type(self).__name__} has coefficients of its own")


class BallBearingConfig(_Bearing):
    """ROSS ``BallBearingElement`` (Friswell et al. 2010, pages 182-185)."""

    kind: Literal["ball"]
    n_balls: PositiveInt
    ball_diameter: Length
    static_load: ModelledLoad
    contact_angle: Angle

    changes: ClassVar[bool] = False

    def make_element(self, ross: Any, node: int, speeds: np.ndarray, share: float) -> Any:
        """ROSS's element."""
        return ross.BallBearingElement(
            n=node,
            n_balls=self.n_balls,
            d_balls=self.ball_diameter,
            fs=self.static_load,
            alpha=self.contact_angle,
        )


class _JournalBearing(_Bearing):
    """A bearing with a film between journal and bore."""

    journal_diameter: Length
    length: Length
    radial_clearance: Length
    oil_viscosity: ModelledViscosity

    _turns_in_its_bore = rule(check_clearance)


class CylindricalBearingConfig(_JournalBearing):
    """ROSS ``CylindricalBearing``, a short fluid-film bearing (Friswell et al. 2010, page 177).

    ``static_load`` of null shares the rotor's weight equally among the bearings.
    """

    kind: Literal["cylindrical"]
    static_load: ModelledLoad | None = None

    def tabulate(self, speeds: np.ndarray, operating: Operating, share: float, ross: Any) -> np.ndarray:
        """(S, 8) by ROSS, which takes one viscosity and one load; where these follow conditions by its closed form.

        Raises ConfigError for a journal at rest, too.
        """
        if (speeds <= 0).any():
            raise ConfigError(
                "a cylindrical bearing must turn, since no film carries its journal at rest, but got 0 rpm: choose "
                "bearings.kind=linear"
            )
        if not self.conditions:
            return super().tabulate(speeds, operating, share, ross)
        load, viscosity = self.find_film(operating, share, len(speeds))
        slim = self.length**3 * self.journal_diameter / (8 * np.pi * self.radial_clearance**2)
        pure = short_coefficients(short_eccentricity(viscosity * speeds * slim / load))
        return np.asarray(scale_film(pure, load, self.radial_clearance, speeds) @ turn_axes(-np.pi / 2).T)

    def make_element(self, ross: Any, node: int, speeds: np.ndarray, share: float) -> Any:
        """ROSS's element."""
        return ross.CylindricalBearing(
            n=node,
            speed=[float(speed) for speed in speeds],
            weight=self.static_load or share,
            bearing_length=self.length,
            journal_diameter=self.journal_diameter,
            radial_clearance=self.radial_clearance,
            oil_viscosity=float(self.oil.viscosity_at(np.zeros(1))[0]),
        )


class JournalTableConfig(_JournalBearing):
    """A journal bearing from a table of dimensionless coefficients over the Sommerfeld number.

    ``rows`` are (S, Kxx, Kxy, Kyx, Kyy, Bxx, Bxy, Byx, Byy), with x the direction of the load,
    S = viscosity N L D / W (R / C)^2, N in 1/s; k = K W / C and c = B W / (w C). Between the rows: cubic splines of the
    logarithm of S. ``table`` in their place is the name of a table of the package, or a CSV file.
    """

    kind: Literal["journal_table"]
    rows: tuple[Annotated[tuple[float, ...], Field(min_length=9, max_length=9)], ...] | None = Field(None, min_length=4)
    table: str | None = None
    static_load: ModelledLoad
    preload: float | None = Field(None, ge=0, lt=1)
    load_angle: ShaftAngle = 0.0

    @rule
    def _ascending(self) -> Iterator[str]:
        if bool(self.rows) == bool(self.table):
            yield f"must have either rows or table, but has {'both' if self.rows else 'neither'}"
        numbers = [row[0] for row in self.rows or ()]
        if numbers and (numbers[0] <= 0 or any(b <= a for a, b in itertools.pairwise(numbers))):
            yield f"must have rows with ascending Sommerfeld numbers above zero, but got {numbers}"

    def read_bytes(self) -> bytes:
        """What the file of its table holds."""
        path = packaged_file(self.table) or Path(self.table) if self.table else Path()
        return path.read_bytes() if path.is_file() else b""

    def tabulate(self, speeds: np.ndarray, operating: Operating, share: float = 0.0, ross: Any = None) -> np.ndarray:
        """(S, 8) by the table.

        Raises ConfigError for a speed whose Sommerfeld number lies outside the table, for a condition that is missing,
        for a table that is none, and for a preload that it has not.
        """
        table = read_film_table(self.table) if self.table else make_film_table(self.rows or (), "rows")
        low, high = table.preloads[[0, -1]]
        if table.has_preload != (self.preload is not None):
            raise ConfigError(
                "a bearing must have a preload where its table has a column preload, and none elsewhere, but it has "
                f"{'none' if self.preload is None else self.preload}"
            )
        if table.has_preload and not low <= (self.preload or 0.0) <= high:
            raise ConfigError(f"a bearing's table has preloads {low:g} to {high:g}, but got {self.preload:g}")
        load, viscosity = self.find_film(operating, share, len(speeds))
        per_turn = viscosity * self.length * self.journal_diameter / load
        sommerfeld = speeds / (2 * np.pi) * per_turn * (self.journal_diameter / 2 / self.radial_clearance) ** 2
        low, high = (float(np.exp(end)) for end in table.span)
        if len(beyond := _find_beyond(sommerfeld, low, high)):
            i = beyond[0]
            span = (30 / np.pi) * speeds[i] / sommerfeld[i] * np.array([low, high])
            raise ConfigError(
                f"a bearing's table must span the Sommerfeld numbers of all speeds, but it has {low:g} to {high:g} and "
                f"{write_number(sommerfeld[i], digits=3)} is needed: choose speeds from {span[0]:.0f} to "
                f"{span[1]:.0f} rpm"
            )
        pure = table.tabulate(np.log(sommerfeld), self.preload or 0.0)
        return np.asarray(scale_film(pure, load, self.radial_clearance, speeds) @ turn_axes(self.load_angle).T)


class SpeedTableConfig(_Bearing):
    """Coefficients at some speeds, such as measured or published ones, and straight lines between them.

    ``rows`` are (speed in rpm, kxx, kxy, kyx, kyy, cxx, cxy, cyx, cyy), N/m and N s/m.
    """

    kind: Literal["speed_table"]
    rows: tuple[Annotated[tuple[float, ...], Field(min_length=9, max_length=9)], ...] = Field(min_length=2)

    @rule
    def _ascending(self) -> Iterator[str]:
        speeds = [row[0] for row in self.rows]
        if speeds[0] < 0 or any(b <= a for a, b in itertools.pairwise(speeds)):
            yield f"must have rows with ascending speeds (rpm), but got {speeds}"

    def tabulate(
        self, speeds: np.ndarray, operating: Operating | None = None, share: float = 0.0, ross: Any = None
    ) -> np.ndarray:
        """(S, 8) on straight lines between the rows. Raises ConfigError for a speed outside the table."""
        rows, rpm = np.array(self.rows), speeds * 30 / np.pi
        low, high = rows[[0, -1], 0]
        if len(beyond := _find_beyond(rpm, low, high)):
            raise ConfigError(
                f"a bearing's table must span all speeds, but it has {low:g} to {high:g} rpm and "
                f"{write_number(rpm[beyond[0]], digits=6)} rpm is needed: add a row, or choose speeds within the table"
            )
        return np.stack([np.interp(rpm, rows[:, 0], column) for column in rows[:, 1:].T], axis=1)


class LinearBearingConfig(
    create_model(  # type: ignore[misc]  # a key for each of the eight coefficients
        "_Linear", __base__=_Bearing, kind=(Literal["linear"], ...), **define_coefficients(0.0)
    )
):
    """A support with the same coefficients at every speed."""

    changes: ClassVar[bool] = False

    def tabulate(self, speeds: np.ndarray, operating: Operating, share: float, ross: Any) -> np.ndarray:
        """(S, 8) alike."""
        return np.tile([getattr(self, name) for name in COEFFICIENTS], (len(speeds), 1))


class RotorFileBearingConfig(_Bearing):
    """The bearings that are saved in ``machine.rotor.file``."""

    kind: Literal["rotor_file"]

    saved: ClassVar[bool] = True


_SingleBearing = (
    BallBearingConfig | CylindricalBearingConfig | JournalTableConfig | SpeedTableConfig | LinearBearingConfig
)


class PerNodeBearingConfig(_Bearing):
    """Bearings that differ, by node."""

    kind: Literal["per_node"]
    nodes: dict[NonNegativeInt, Annotated[_SingleBearing, Field(discriminator="kind")]] = Field(min_length=1)

    changes: ClassVar[bool] = False

    @property
    def places(self) -> tuple[int, ...]:
        """The nodes that it names."""
        return tuple(self.nodes)

    def at(self, node: int) -> _Bearing:
        """The bearing at a node. Raises ConfigError where there is none."""
        if node not in self.nodes:
            raise ConfigError(
                f"machine.bearings.nodes must have a bearing for every bearing node, but node {node} has none (it has "
                f"{', '.join(map(str, self.nodes))})"
            )
        return self.nodes[node]

    def read_bytes(self) -> bytes:
        """What the files of all tables hold."""
        return b"".join(bearing.read_bytes() for bearing in self.nodes.values())


BearingConfig = Annotated[_SingleBearing | PerNodeBearingConfig | RotorFileBearingConfig, Field(discriminator="kind")]
CHANGING = {
    get_args(section.model_fields["kind"].annotation)[0]
    for section in get_args(get_args(BearingConfig)[0])
    if section.changes
}
"""Kinds of bearings whose coefficients change with the speed, or may."""


def pick_condition(operating: Operating, name: str, count: int) -> np.ndarray:
    """The condition ``name`` (S,) of ``count`` points.

    Raises ConfigError where it is missing, or not above zero.
    """
    if name not in operating:
        raise ConfigError(
            f"the modelled bearings need the operating condition {name}, but there is {', '.join(operating) or 'none'}"
            f": give machine.operating.{name}, or a number in place of what depends on it"
        )
    values = np.broadcast_to(np.asarray(operating[name], dtype=float), (count,))
    if not (values > 0).all():
        raise ConfigError(f"the modelled bearings need {name} above zero, but got {np.min(values):g}")
    return values


def flatten(stiffness: np.ndarray, damping: np.ndarray) -> list[float]:
    """The eight coefficients of matrices over x and y (and more)."""
    blocks = {"k": stiffness, "c": damping}
    return [float(blocks[name[0]]["xy".index(name[1]), "xy".index(name[2])]) for name in COEFFICIENTS]


def _find_beyond(values: np.ndarray, low: float, high: float, room: float = 1e-6) -> np.ndarray:
    """Which of ``values`` lie beyond a table's ends; a speed made from a row of it is within by ``room``."""
    return np.flatnonzero((values < low * (1 - room)) | (values > high * (1 + room)))
