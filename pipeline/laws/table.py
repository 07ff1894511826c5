"""Dimensionless coefficients of a film over the logarithm of a Sommerfeld number, and over the preload.

Between the rows: cubic splines, as SciPy makes them. Beyond them a column goes on as a power of the Sommerfeld number
(as films do), or as a straight line over its logarithm where that power would be above 2: smooth, so that a fit can
pass there, and told (:meth:`FilmTable.outside`), since nobody computed it.

Tables come with the package, by name, or are a user's own CSV files.

Legend: G members, S operating points, J preloads, n rows, 8 coefficients.
"""

from __future__ import annotations

import csv
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.errors import ConfigError, nearest

if TYPE_CHECKING:
    import torch

FOLDER = Path(__file__).with_name("tables")
COLUMNS = ("S", "Kxx", "Kxy", "Kyx", "Kyy", "Bxx", "Bxy", "Byx", "Byy")
PRELOAD = "preload"


@dataclass(frozen=True, eq=False)
class Curve:
    """Columns over one variable: of a film, over the logarithm of S."""

    nodes: np.ndarray  # (n,) ascending
    columns: np.ndarray  # (n, k)
    steepest: float = 2.0  # a steeper power beyond the ends is a straight line; below zero: straight in any case

    @cached_property
    def _pieces(self) -> tuple[torch.Tensor, ...]:
        import torch
        from scipy.interpolate import CubicSpline

        spline = CubicSpline(self.nodes, self.columns)
        ends, slopes = self.columns[[0, -1]], spline(self.nodes[[0, -1]], 1)
        with np.errstate(divide="ignore", invalid="ignore"):
            power = slopes / ends
        steep = ~(np.abs(power) <= self.steepest)
        arrays = (
            self.nodes,
            np.moveaxis(spline.c, 0, 1),
            np.where(steep, 0.0, power),
            np.where(steep, slopes, 0.0),
        )
        return tuple(torch.from_numpy(np.ascontiguousarray(array)) for array in arrays)

    def evaluate(self, at: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """(.., k) ``at`` places (..), and their slopes."""
        import torch

        nodes, pieces, power, line = self._pieces
        inside = at.clamp(nodes[0], nodes[-1])
        i = (torch.searchsorted(nodes, inside.detach().contiguous(), right=True) - 1).clamp(0, len(nodes) - 2)
        u = (inside - nodes[i])[..., None]
        c3, c2, c1, c0 = pieces[i].unbind(-2)
        value, slope = ((c3 * u + c2) * u + c1) * u + c0, (3 * c3 * u + 2 * c2) * u + c1
        if bool(((at < nodes[0]) | (at > nodes[-1])).any()):
            beyond = (at - inside)[..., None]
            end = (beyond[..., 0] > 0).long()
            factor = torch.exp(power[end] * beyond)
            slope = torch.where(beyond == 0, slope, value * power[end] * factor + line[end])
            value = value * factor + line[end] * beyond
        return value, slope


@dataclass(frozen=True, eq=False)
class FilmTable:
    """Curves at ascending preloads; one alone where the table has no preload."""

    preloads: np.ndarray  # (J,) of the curves; (0.,) alone where there is none
    curves: tuple[Curve, ...]  # J

    @property
    def has_preload(self) -> bool:
        """True for a table over the preload, too."""
        return len(self.curves) > 1

    @property
    def span(self) -> tuple[float, float]:
        """The logarithms of S between which every curve has rows."""
        return max(float(curve.nodes[0]) for curve in self.curves), min(float(curve.nodes[-1]) for curve in self.curves)

    def evaluate(self, log_s: torch.Tensor, preload: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """(G, S, 8) at ``log_s`` (G, S) and ``preload`` (G, 1); their slopes by ``log_s`` and by the preload."""
        import torch

        if not self.has_preload:
            value, slope = self.curves[0].evaluate(log_s)
            return value, slope, torch.zeros_like(value)
        evaluated = [curve.evaluate(log_s) for curve in self.curves]
        values, slopes = (torch.stack(parts) for parts in zip(*evaluated, strict=True))
        weights, turns = self._shares.evaluate(preload[:, 0])
        return (
            torch.einsum("gj,jgsk->gsk", weights, values),
            torch.einsum("gj,jgsk->gsk", weights, slopes),
            torch.einsum("gj,jgsk->gsk", turns, values),
        )

    @cached_property
    def _shares(self) -> Curve:
        """What each curve counts at a preload: a spline is linear in its values."""
        return Curve(self.preloads, np.eye(len(self.preloads)), steepest=-1.0)

    def tabulate(self, log_s: np.ndarray, preload: float) -> np.ndarray:
        """(S, 8) at ``log_s`` (S,) within the rows, without torch."""
        from scipy.interpolate import CubicSpline

        columns = np.stack([CubicSpline(curve.nodes, curve.columns)(log_s) for curve in self.curves])
        if not self.has_preload:
            return np.asarray(columns[0])
        return np.asarray(
            np.tensordot(CubicSpline(self.preloads, np.eye(len(self.preloads)))(preload), columns, axes=1)
        )

    def outside(self, log_s: np.ndarray, preload: np.ndarray, room: float = 1e-6) -> np.ndarray:
        """(G, S) True where ``log_s`` (G, S) or ``preload`` (G, 1) lies beyond the rows.

        A point that lies so little beyond them (``room``, as a share of S) was made of a row.
        """
        low, high = self.span
        beyond = (log_s < low - room) | (log_s > high + room)
        if self.has_preload:
            beyond |= (preload < self.preloads[0] - room) | (preload > self.preloads[-1] + room)
        return np.asarray(beyond)

    def to_record(self) -> list[dict[str, Any]]:
        """A JSON-able twin."""
        return [
            {"preload": float(preload), "log_s": curve.nodes.tolist(), "columns": curve.columns.tolist()}
            for preload, curve in zip(self.preloads, self.curves, strict=True)
        ]

    @classmethod
    def from_record(cls, record: Sequence[dict[str, Any]]) -> FilmTable:
        """The table of :meth:`to_record`."""
        curves = tuple(Curve(np.array(entry["log_s"]), np.array(entry["columns"])) for entry in record)
        return cls(np.array([entry["preload"] for entry in record]), curves)


def packaged_tables() -> tuple[str, ...]:
    """Names of the tables that come with the package."""
    return tuple(sorted(path.stem for path in FOLDER.glob("*.csv")))


def packaged_file(table: str) -> Path | None:
    """The file of a table that comes with the package; None for another."""
    return FOLDER / f"{table}.csv" if table in packaged_tables() else None


def read_film_table(table: str) -> FilmTable:
    """A table of the package by its name, or of a CSV file by its path.

    Lines that begin with ``#`` are its head. It has the columns :data:`COLUMNS`, dimensionless, and perhaps
    ``preload``; others are left alone. Raises ConfigError: no such table, a column that is missing, a value that is no
    number, Sommerfeld numbers that do not ascend (at each preload), too few rows.
    """
    path = packaged_file(table) or Path(table)
    try:
        lines = [line for line in path.read_text(encoding="utf-8").splitlines() if line.strip() and line[0] != "#"]
    except (OSError, UnicodeDecodeError):
        raise ConfigError(
            f"a bearing's table must be one of the package or a CSV file, but '{table}' is neither: "
            f"{nearest(table, packaged_tables())}"
        ) from None
    header, *cells = list(csv.reader(lines)) or [[]]
    names = [name.strip() for name in header]
    if missing := [name for name in COLUMNS if name not in names]:
        raise ConfigError(
            f"a bearing's table must have the columns {', '.join(COLUMNS)} (and perhaps {PRELOAD}), but '{table}' has "
            f"no {missing[0]}: {nearest(missing[0], names)}"
        )
    wanted = [names.index(name) for name in (*COLUMNS, *([PRELOAD] if PRELOAD in names else []))]
    try:
        rows = np.array([[float(row[i]) for i in wanted] for row in cells])
    except (ValueError, IndexError):
        raise ConfigError(f"a bearing's table must have a number in every cell, but '{table}' has not") from None
    return make_film_table(rows, table)


def make_film_table(rows: np.ndarray | Sequence[Sequence[float]], name: str, fewest: int = 4) -> FilmTable:
    """The table of ``rows`` (n, 9) over S, or (n, 10) with a preload in the last column.

    Raises ConfigError as :func:`read_film_table`.
    """
    rows = np.asarray(rows, dtype=float).reshape(len(rows), -1 if len(rows) else len(COLUMNS))
    if not np.isfinite(rows).all():
        raise ConfigError(f"a bearing's table must be finite, but '{name}' is not")
    own = rows[:, len(COLUMNS)] if rows.shape[1] > len(COLUMNS) else np.zeros(len(rows))
    preloads, curves = np.unique(own), []
    if len(preloads) > 1 and not (preloads[0] >= 0 and preloads[-1] < 1):
        raise ConfigError(f"a bearing's table must have preloads from 0 to below 1, but '{name}' has others")
    for preload in preloads if len(rows) else [0.0]:
        same_preload = rows[own == preload]
        where = f" at the preload {preload:g}" if len(preloads) > 1 else ""
        if len(same_preload) < fewest:
            raise ConfigError(f"a bearing's table must have {fewest} rows{where}, but '{name}' has {len(same_preload)}")
        if same_preload[0, 0] <= 0 or (np.diff(same_preload[:, 0]) <= 0).any():
            raise ConfigError(
                f"a bearing's table must have ascending Sommerfeld numbers above zero{where}, but '{name}' has not: "
                "sort its rows by S"
            )
        curves.append(Curve(np.log(same_preload[:, 0]), same_preload[:, 1 : len(COLUMNS)]))
    return FilmTable(preloads, tuple(curves))
