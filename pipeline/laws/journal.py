"""The law of a journal bearing: one dimensionless table, made dimensional by a few physical numbers.

``S = eta N L D / W (R / C)^2`` with N in 1/s; ``k = Kbar W / C``, ``c = Bbar W / (w C)``; the first axis of the table
points along the load. A short bearing's table is over ``S (L / D)^2``.

Legend: G members, S operating points, Th unknown numbers, 8 coefficients. SI units.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar, Literal

import numpy as np

from pipeline.config.quantities import (
    CONDITION,
    LengthNumber,
    LoadNumber,
    PureNumber,
    ShaftAngle,
    check_clearance,
    middle,
)
from pipeline.config.section import Section, rule
from pipeline.errors import ConfigError
from pipeline.laws.numbers import LOAD, Number, Points, Recorded, add_slope, turn_axes
from pipeline.laws.short_bearing import short_table
from pipeline.laws.table import FilmTable, read_film_table

if TYPE_CHECKING:
    import torch


class _JournalLawConfig(Section):
    """What every journal bearing has."""

    journal_diameter: LengthNumber
    length: LengthNumber
    radial_clearance: LengthNumber
    static_load: LoadNumber
    load_share: PureNumber = 1.0

    kind: Literal["short_journal", "journal_table"]
    load_angle: ShaftAngle = 0.0

    has_film: ClassVar[bool] = True

    _turns_in_its_bore = rule(check_clearance)

    @rule
    def _shares_a_condition(self) -> Iterator[str]:
        if self.static_load != CONDITION and self.load_share != 1.0:
            yield "load_share must be left out where static_load is not `condition`, but it is given"

    @abstractmethod
    def read_table(self, where: str) -> FilmTable:
        """The dimensionless coefficients. Raises ConfigError: no such table, a preload that does not fit it."""

    def make(self, where: str, number: Callable[[Section, str], Number]) -> JournalLaw:
        """The law of the bearing at ``where``, its numbers made by ``number(section, name)``. Raises ConfigError."""
        loaded, absent, table = self.static_load == CONDITION, Number(1.0), self.read_table(where)
        return JournalLaw(
            kind=self.kind,
            table=table,
            diameter=number(self, "journal_diameter"),
            length=number(self, "length"),
            clearance=number(self, "radial_clearance"),
            load=absent if loaded else number(self, "static_load"),
            share=number(self, "load_share") if loaded else absent,
            preload=number(self, "preload") if table.has_preload else absent,
            loaded=loaded,
            load_angle=self.load_angle,
        )


class ShortJournalLawConfig(_JournalLawConfig):
    """A short journal bearing in closed form (Friswell et al. 2010, page 177), as the modelled ``cylindrical``."""

    kind: Literal["short_journal"]
    load_angle: ShaftAngle = -math.pi / 2

    def read_table(self, where: str) -> FilmTable:
        """That of the closed form."""
        return short_table()


class JournalTableLawConfig(_JournalLawConfig):
    """A journal bearing from a table over the Sommerfeld number, packaged (by its name) or a CSV file.

    A table with a column ``preload`` needs a ``preload``.
    """

    kind: Literal["journal_table"]
    table: str
    preload: PureNumber | None = None

    @rule
    def _is_a_preload(self) -> Iterator[str]:
        if self.preload is not None and middle(self.preload) >= 1:
            yield f"preload must be between 0 and 1, but got {middle(self.preload):g}"

    def read_table(self, where: str) -> FilmTable:
        """The named one, of the package or of a file."""
        table = read_film_table(self.table)
        if table.has_preload == (self.preload is not None):
            return table
        span = f"from {table.preloads[0]:g} to {table.preloads[-1]:g}" if table.has_preload else "none"
        verb = "give" if table.has_preload else "leave out"
        raise ConfigError(
            f"machine.laws.bearings.{where} must have a preload where its table has some, but '{self.table}' has "
            f"{span}: {verb} preload"
        )


@dataclass(frozen=True, eq=False, kw_only=True)
class JournalLaw(Recorded):
    """A table, and the numbers that make it dimensional. Where ``loaded`` the load is the condition times a share."""

    kind: Literal["short_journal", "journal_table"]
    loaded: bool
    load_angle: float  # rad
    diameter: Number  # m
    length: Number  # m
    clearance: Number  # m
    load: Number  # N; without meaning where `loaded`
    share: Number
    preload: Number
    table: FilmTable

    @property
    def inputs(self) -> tuple[str, ...]:
        """The operating conditions that it needs besides those of the oil."""
        return (LOAD,) if self.loaded else ()

    def _powers(self) -> Iterator[tuple[Number, float, float]]:
        """Each number, its power in the Sommerfeld number, and its power in the size of coefficients."""
        short = self.kind == "short_journal"
        yield self.length, 3.0 if short else 1.0, 0.0
        yield self.diameter, 1.0 if short else 3.0, 0.0
        yield self.clearance, -2.0, -1.0
        yield (self.share if self.loaded else self.load), -1.0, 1.0

    def log_sommerfeld(self, theta: torch.Tensor, points: Points) -> tuple[torch.Tensor, torch.Tensor]:
        """(G, S) the logarithm of the Sommerfeld number, and that of the coefficients' size W / C in N/m."""
        result = points.log_viscosity + (points.speeds / (8 * math.pi)).log()
        size = theta.new_zeros(1)
        for number, in_s, in_size in self._powers():
            log = number.log(theta)
            result, size = result + in_s * log, size + in_size * log
        if self.loaded:
            result, size = result - points.operating[LOAD].log(), size + points.operating[LOAD].log()
        return result, size.expand_as(result)

    def evaluate(self, theta: torch.Tensor, points: Points) -> tuple[torch.Tensor, torch.Tensor]:
        """(G, S, 8) coefficients in N/m and N s/m, and (G, S, 8, Th) their slopes."""
        import torch

        log_s, log_size = self.log_sommerfeld(theta, points)
        preload = self.preload.of(theta)
        pure, by_s, by_preload = self.table.evaluate(log_s, preload)
        slopes = by_s[..., None] * points.viscosity_slopes[:, :, None]
        for number, in_s, in_size in self._powers():
            add_slope(slopes, number, in_s * by_s + in_size * pure)
        add_slope(slopes, self.preload, by_preload * preload[..., None])
        size = log_size.exp()
        size = torch.stack([size, size / points.speeds], -1).repeat_interleave(4, -1)
        turn = torch.from_numpy(turn_axes(self.load_angle))
        return (size * pure) @ turn.T, turn @ (size[..., None] * slopes)

    def outside(self, theta: torch.Tensor, points: Points) -> np.ndarray:
        """(G, S) True where a point lies beyond the rows of the table."""
        return self.table.outside(self.log_sommerfeld(theta, points)[0].numpy(), self.preload.of(theta).numpy())
