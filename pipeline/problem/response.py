"""What the sensors would measure, as a function of the bearings: a small system, whatever the number of nodes.

On reference bearings H0 the rotor has the forced response u0 and the receptance a (displacements of a unit force at the
bearings). Bearings H = H0 + dH change the force on the shaft by ``-dH q_b``, so that

    q_b = (I + a_bb dH)^-1 u0_b                        at the bearings
    q_s = u0_s - a_sb dH q_b                           at the sensors

and a derivative needs no further solution: with ``T = a_sb - a_sb dH (I + a_bb dH)^-1 a_bb``, the receptance of the
rotor on the bearings H, ``dq_s / dH_ij = -T_i q_bj``.

Where a casing moves (:mod:`pipeline.rotor.stored`) its x and y stand beside those of the bearings, whose
displacements are then the shaft's less the casing's, and dH has the change of its support.

These equations are written once, for arrays of NumPy and for tensors of torch, which may lead with a batch.

Legend: ``..`` batch, S speeds, P channels, R runs, B bearings, N balance planes. SI units.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np

from pipeline.rotor.bearing_table import BearingTable

Array = Any
"""An array of NumPy, or a tensor of torch."""


def _library(array: Array) -> Any:
    """The functions that take this array: numpy, or torch."""
    if isinstance(array, np.ndarray):
        return np
    import torch

    return torch


def _solve(system: Array, right: Array) -> Array:
    """The solution; of tensors NaN where the system is singular, since a search may pass there and turn back."""
    if isinstance(system, np.ndarray):
        return np.linalg.solve(system, right)
    import torch

    solution, failed = torch.linalg.solve_ex(system, right)
    return torch.where(failed[..., None, None] == 0, solution, float("nan"))


@dataclass(frozen=True, eq=False, kw_only=True)
class ResponseBlock:
    """Runs that share their frequencies, on the reference bearings."""

    runs: np.ndarray  # (R,) indices among the runs of the data
    frequencies: Array  # (S,) rad/s
    forced_sensors: Array  # u0_s, (S, P, R) complex, m
    forced_bearings: Array  # u0_b, (S, 2 B, R)
    receptance_sensors: Array  # a_sb, (S, P, 2 B) m/N
    receptance_bearings: Array  # a_bb, (S, 2 B, 2 B)
    unit_sensors: Array  # (S, P, N) of 1 kg m at each balance plane; N = 0 where the runs are not synchronous
    unit_bearings: Array  # (S, 2 B, N)

    def at(self, keep: np.ndarray, runs: np.ndarray) -> ResponseBlock:
        """The same at the speeds ``keep`` (mask or index), for those of the ``runs`` that it has, numbered anew."""
        selected = self.of_runs(np.isin(self.runs, runs)).converted(lambda array: array[keep])
        return replace(selected, runs=np.searchsorted(runs, selected.runs))

    def of_runs(self, at: np.ndarray | slice) -> ResponseBlock:
        """The same with the runs ``at`` these places (mask, index or slice) alone."""
        sensors, bearings = self.forced_sensors[..., at], self.forced_bearings[..., at]
        return replace(self, runs=self.runs[at], forced_sensors=sensors, forced_bearings=bearings)

    def converted(self, convert: Callable[[Array], Array]) -> ResponseBlock:
        """The same with every array but the numbers of the runs as ``convert`` makes it."""
        made = {f.name: convert(getattr(self, f.name)) for f in fields(self) if f.name != "runs"}
        return replace(self, **made)

    def vary(self, variation: ResponseBlock, shift: Array) -> ResponseBlock:
        """The block, leading with a batch G, at model parameters that differ by ``shift`` (G, T).

        ``variation`` has the derivatives by the parameters, leading with T.
        """
        library, kept = _library(shift), ("runs", "frequencies")
        varied = {
            f.name: getattr(self, f.name)
            + library.tensordot(shift + 0j, getattr(variation, f.name), 1)  # (G, T) and (T, ..)
            for f in fields(self)
            if f.name not in kept
        }
        return replace(self, **varied)


@dataclass(frozen=True, eq=False)
class BlockResponse:
    """The runs of a block on some bearings."""

    sensors: Array  # q_s, (.., S, P, R) m
    bearings: Array  # q_b, (.., S, 2 B, R) m
    unit_sensors: Array  # (.., S, P, N) of 1 kg m at each balance plane
    receptance_sensors: Array  # T, (.., S, P, 2 B) m/N; None where no derivative was asked for
    receptance_bearings: Array  # (.., S, 2 B, 2 B) m/N; likewise


def impedance_change(coefficients: Array, frequencies: Array, reference: Array | complex) -> Array:
    """dH, (.., S, 2 B, 2 B) N/m, from coefficients (.., S, B, 8) at ``frequencies`` (S,) rad/s.

    ``reference`` is that of all places, or (2 B,) of each.
    """
    library = _library(coefficients)
    eight = coefficients.reshape(*coefficients.shape[:-1], 2, 2, 2)
    blocks = eight[..., 0, :, :] + 1j * frequencies[:, None, None, None] * eight[..., 1, :, :]
    count = blocks.shape[-3]
    places = library.eye(count, dtype=blocks.dtype)
    full = library.einsum("...bij,bc->...bicj", blocks, places).reshape(*blocks.shape[:-3], 2 * count, 2 * count)
    return full - reference * library.eye(2 * count, dtype=full.dtype)


def respond(
    block: ResponseBlock, change: Array, unbalance: Array | None = None, derivative: bool = True
) -> BlockResponse:
    """The block on bearings that differ from the reference by ``change`` (.., S, 2 B, 2 B).

    ``unbalance`` (.., N) complex, kg m, is a residual unbalance at the balance planes.
    """
    library = _library(change)
    system = library.eye(change.shape[-1], dtype=change.dtype) + block.receptance_bearings @ change
    n_runs, n_units = block.forced_bearings.shape[-1], block.unit_bearings.shape[-1]
    right = [block.forced_bearings, block.unit_bearings, *([block.receptance_bearings] if derivative else [])]
    joined = library.concatenate(right, axis=-1)
    solved = _solve(system, library.broadcast_to(joined, (*change.shape[:-2], *joined.shape[-2:])))
    carried = block.receptance_sensors @ change
    displacements = solved[..., :n_runs]
    sensors = block.forced_sensors - carried @ displacements
    units = block.unit_sensors - carried @ solved[..., n_runs : n_runs + n_units]
    if n_units and unbalance is not None:
        residual = unbalance[..., None, :, None]
        sensors = sensors + units @ residual
        displacements = displacements + solved[..., n_runs : n_runs + n_units] @ residual
    if not derivative:
        return BlockResponse(sensors, displacements, units, None, None)
    at_bearings = solved[..., n_runs + n_units :]
    return BlockResponse(sensors, displacements, units, block.receptance_sensors - carried @ at_bearings, at_bearings)


def derive(block: ResponseBlock, response: BlockResponse, moves: Array) -> Array:
    """(.., S, P, R, n) derivative of the displacements at the sensors, m, by numbers that move the coefficients by
    ``moves`` (.., S, 8 B, n) N/m and N s/m; (8 B, n) at every speed alike.
    """
    library, omega = _library(moves), block.frequencies[:, None, None, None, None]
    eight = moves.reshape(*moves.shape[:-2], -1, 2, 2, 2, moves.shape[-1])  # (.., S, B, 2, 2, 2, n)
    change = eight[..., 0, :, :, :] + 1j * omega * eight[..., 1, :, :, :]
    bearings = response.bearings.reshape(*response.bearings.shape[:-2], -1, 2, response.bearings.shape[-1])
    force = library.einsum("...bijn,...bjr->...birn", change, bearings)
    shape = (*force.shape[:-4], response.bearings.shape[-2], -1)
    by_numbers = -response.receptance_sensors @ force.reshape(shape)
    return by_numbers.reshape(*by_numbers.shape[:-1], *force.shape[-2:])


def derive_by_parameters(
    variation: ResponseBlock, response: BlockResponse, change: Array, unbalance: Array | None
) -> Array:
    """(G, S, P, R, T) derivative of the displacements at the sensors by model parameters other than the bearings', m.

    With the force ``f = -dH q_b`` on the shaft: ``dq_s = du0_s + da_sb f - T dH (du0_b + da_bb f)``. ``change`` dH is
    (G, S, 2 B, 2 B), ``variation`` leads with T, ``response`` with the batch G.
    """
    library = _library(change)
    force = -(change @ response.bearings)  # (G, S, 2 B, R)
    product = "tsij,gsjr->gtsir"  # speed by speed: as a product of matrices it would take ten times as long
    at_sensors = variation.forced_sensors + library.einsum(product, variation.receptance_sensors, force)
    at_bearings = variation.forced_bearings + library.einsum(product, variation.receptance_bearings, force)
    if unbalance is not None and variation.unit_sensors.shape[-1]:
        residual = unbalance[:, None, None, :, None]
        at_sensors = at_sensors + variation.unit_sensors @ residual
        at_bearings = at_bearings + variation.unit_bearings @ residual
    through = (response.receptance_sensors @ change)[:, None]
    return library.moveaxis(at_sensors - through @ at_bearings, 1, -1)


def join_runs(runs: Sequence[np.ndarray], blocks: Sequence[np.ndarray]) -> np.ndarray:
    """(S, P, R, ..) as the data set has them, from what every block (S, P, R of the block, ..) has of its ``runs``."""
    return np.concatenate(blocks, axis=2)[:, :, np.argsort(np.concatenate(runs))]


@dataclass(frozen=True, eq=False)
class ResponseEquations:
    """The response at the sensors of every run and speed."""

    bearing_nodes: tuple[int, ...]  # B
    speeds: np.ndarray  # (S,) rad/s
    reference: complex  # H0 in x and y of every bearing, N/m
    planes: tuple[int, ...]  # N nodes of the residual unbalance
    blocks: tuple[ResponseBlock, ...]

    @property
    def n_runs(self) -> int:
        """R, of all blocks."""
        return sum(len(block.runs) for block in self.blocks)

    @property
    def frequencies(self) -> np.ndarray:
        """(S, R) rad/s."""
        return self._gather(lambda block: np.repeat(block.frequencies[:, None, None], len(block.runs), axis=2))[:, 0]

    @property
    def films(self) -> tuple[ResponseBlock, ...]:
        """The blocks without the casings, whose supports are as they were solved with."""
        count = 2 * len(self.bearing_nodes)
        return tuple(
            replace(
                block,
                forced_bearings=block.forced_bearings[..., :count, :],
                receptance_sensors=block.receptance_sensors[..., :count],
                receptance_bearings=block.receptance_bearings[..., :count, :count],
                unit_bearings=block.unit_bearings[..., :count, :],
            )
            for block in self.blocks
        )

    @property
    def references(self) -> np.ndarray:
        """(2 B,) N/m, of bearings and casings: supports count as what changes of them."""
        count = self.blocks[0].receptance_bearings.shape[-1]
        return np.where(np.arange(count) < 2 * len(self.bearing_nodes), self.reference, 0.0)

    def at(self, keep: np.ndarray, runs: np.ndarray | None = None) -> ResponseEquations:
        """The same at the speeds ``keep`` (mask or index) and for the ``runs`` (indices; None for all)."""
        chosen = np.arange(self.n_runs) if runs is None else runs
        blocks = [block.at(keep, chosen) for block in self.blocks if np.isin(block.runs, chosen).any()]
        return replace(self, speeds=self.speeds[keep], blocks=tuple(blocks))

    def shifted(self, shown: np.ndarray) -> ResponseEquations:
        """The same where the sensors show ``shown`` (S, P, R) m besides."""
        blocks = [replace(b, forced_sensors=b.forced_sensors + shown[..., b.runs]) for b in self.blocks]
        return replace(self, blocks=tuple(blocks))

    def predict(self, bearings: BearingTable, unbalance: np.ndarray | None = None) -> np.ndarray:
        """(S, P, R) m, of the bearings at the same speeds; residual ``unbalance`` (N,) complex, kg m."""
        return self._gather(lambda block: respond(block, self.change(bearings, block), unbalance, False).sensors)

    def sensitivity(self, bearings: BearingTable, unbalance: np.ndarray | None = None) -> np.ndarray:
        """(S, P, R, B, 8) derivative of :meth:`predict` by the coefficients."""
        n_bearings, count = len(self.bearing_nodes), 4 * self.blocks[0].receptance_bearings.shape[-1]
        moves = np.eye(count)[:, : 8 * n_bearings]

        def by_coefficient(block: ResponseBlock) -> Array:
            every = derive(block, respond(block, self.change(bearings, block), unbalance), moves)
            return every.reshape(*every.shape[:-1], n_bearings, 8)

        return self._gather(by_coefficient)

    def derive_by_unbalance(self, bearings: BearingTable) -> np.ndarray:
        """(S, P, R, N) derivative of :meth:`predict` by the residual unbalance, m over kg m."""

        def by_unbalance(block: ResponseBlock) -> Array:
            if not block.unit_sensors.shape[-1]:
                return np.zeros((*block.forced_sensors.shape, len(self.planes)))
            shown = respond(block, self.change(bearings, block), derivative=False).unit_sensors[:, :, None]
            return np.repeat(shown, len(block.runs), axis=2)

        return self._gather(by_unbalance)

    def _gather(self, make: Callable[[ResponseBlock], Array]) -> np.ndarray:
        """(S, P, R, ..) of all runs, from what is made (S, P, R of the block, ..) of each block."""
        return join_runs([block.runs for block in self.blocks], [make(block) for block in self.blocks])

    def change(self, bearings: BearingTable, block: ResponseBlock) -> np.ndarray:
        """dH, (S, 2 B, 2 B) N/m."""
        casings = block.receptance_bearings.shape[-1] // 2 - len(bearings.values)
        values = np.pad(bearings.values, ((0, casings), (0, 0), (0, 0))) if casings else bearings.values
        return np.asarray(
            impedance_change(values.swapaxes(0, 1), block.frequencies, self.references[: 2 * len(values)])
        )
