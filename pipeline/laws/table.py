"""Dimensionless coefficients of a film over the logarithm of a Sommerfeld number, and over the preload.

Between the rows: cubic splines, as SciPy makes them. Beyond them a column goes on as a power of the Sommerfeld number
(as films do), or as a straight line over its logarithm where that power would be above 2: smooth, so that a fit can
pass there, and told (:meth:`FilmTable.outside`), since nobody computed it.

Legend: G members, S operating points, J preloads, n rows, 8 coefficients.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    import torch


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
