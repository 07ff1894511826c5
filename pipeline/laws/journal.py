"""The law of a journal bearing: one dimensionless table, made dimensional by a few physical numbers.

``S = eta N L D / W (R / C)^2`` with N in 1/s; ``k = Kbar W / C``, ``c = Bbar W / (w C)``; the first axis of the table
points along the load. A short bearing's table is over ``S (L / D)^2``.

Legend: G members, S operating points, Th unknown numbers, 8 coefficients. SI units.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from pipeline.laws.numbers import Number, add_slope
from pipeline.laws.points import LOAD, Points, turn_axes
from pipeline.laws.table import FilmTable

if TYPE_CHECKING:
    import torch

_NUMBERS = ("diameter", "length", "clearance", "load", "share", "preload")


@dataclass(frozen=True, eq=False, kw_only=True)
class JournalLaw:
    """A table, and the numbers that make it dimensional. Where ``loaded`` the load is the condition times a share."""

    kind: Literal["short_journal", "journal_table"]
    table: FilmTable
    diameter: Number  # m
    length: Number  # m
    clearance: Number  # m
    load: Number  # N; without meaning where `loaded`
    share: Number
    preload: Number
    loaded: bool
    load_angle: float  # rad

    needs_oil = True

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

    def to_record(self) -> dict[str, Any]:
        """A JSON-able twin."""
        numbers = {name: asdict(getattr(self, name)) for name in _NUMBERS}
        kept = {"kind": self.kind, "loaded": self.loaded, "load_angle": self.load_angle}
        return {**kept, **numbers, "table": self.table.to_record()}

    @classmethod
    def from_record(cls, record: dict[str, Any]) -> JournalLaw:
        """The law of :meth:`to_record`."""
        numbers = {name: Number(**record[name]) for name in _NUMBERS}
        kept = {"kind": record["kind"], "loaded": record["loaded"], "load_angle": record["load_angle"]}
        return cls(**{**kept, **numbers, "table": FilmTable.from_record(record["table"])})
