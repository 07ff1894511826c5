"""What the sensors read, and what they would read for given unknowns: values, derivatives, and noise.

One place where rows are whitened, block by block of runs that share their frequencies.

Legend: G data sets or starts, S speeds, P channels, R runs of a block, B bearings and casings, A active unknowns, N
balance planes, T model parameters, n columns.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.parameters.bearings import BASELINE, drift_scales
from pipeline.parameters.ground import local_change, softening
from pipeline.problem.baseline import add_baseline
from pipeline.problem.measurement import Measurement
from pipeline.problem.response import (
    ResponseBlock,
    derive,
    derive_by_parameters,
    impedance_change,
    join_runs,
    respond,
)
from pipeline.rotor.bearing_table import BearingTable

if TYPE_CHECKING:
    import torch


@dataclass(frozen=True, eq=False, kw_only=True)
class Readings:
    """The readings of a measurement, with the precisions that count at the moment."""

    measurement: Measurement
    runs: tuple[np.ndarray, ...]  # of each block
    measured: tuple[torch.Tensor, ...]  # (G or 1, S, P, R) m
    mixing: tuple[torch.Tensor, ...]  # (R, S P, S P) where noise ties probes and speeds together; none elsewhere
    precision: tuple[torch.Tensor, ...] = ()  # (G or 1, S, P, R) 1/m: root of 2 over the own deviation, for both parts
    common: tuple[torch.Tensor, ...] = ()  # likewise, a subtracted baseline's deviation over the own one; none without
    records: tuple[torch.Tensor, ...] = ()  # likewise, complex: what one deviation of a record's factor moves; or none
    shares: tuple[np.ndarray, ...] = ()  # by which the precision has the readings count: less than one if far off
    correlation: float = 0.0  # of a reading's noise with that at the speed before

    @property
    def size(self) -> int:
        """Real numbers that were measured."""
        return 2 * self.measurement.dataset.n_readings

    def at(self, starts: torch.Tensor) -> Readings:
        """Those of some data sets or starts."""
        parts: dict[str, Any] = {
            name: tuple(each if len(each) == 1 else each[starts] for each in getattr(self, name))
            for name in ("measured", "precision", "common", "records")
        }
        return replace(self, **parts)

    def whiten(self, b: int, rows: torch.Tensor) -> torch.Tensor:
        """Rows (G, S, P, R, n) of block b over each reading's own noise, without what runs share: with the deviations u
        of a subtracted baseline their covariance is 1 + u u', whose inverse root takes a part along u away.

        So it is with the factor of a record, which moves both parts of its readings: a block of one number a record,
        whose prior is normal about 1, eliminated.
        """
        if self.records:
            v = self.records[b][..., None]
            rows = rows - _share(v, 2) * v * (v.conj() * rows).real.sum(2, keepdim=True)
        if self.common:
            u = self.common[b][..., None]
            rows = rows - _share(u, 3) * u * (u * rows).sum(3, keepdim=True)
        return rows

    def mix(self, b: int, rows: torch.Tensor) -> torch.Tensor:
        """Rows (G, S, P, R, n) that are :meth:`whiten`-ed, without what noise in levels shares over probes and speeds
        (:meth:`pipeline.problem.noise_levels.NoiseLevels.mixing`), or what follows from the speed before.
        """
        import torch

        if self.mixing:
            rows = torch.einsum("rij,gjrn->girn", self.mixing[b], rows.flatten(1, 2)).unflatten(1, rows.shape[1:3])
        if self.correlation > 0:
            before, ties = self._ties[b]
            index = before[None, :, None, :, None].expand(len(rows), -1, rows.shape[2], -1, rows.shape[4])
            factor = ties[:, None, :, None]
            rows = (rows - factor * rows.gather(1, index)) * (1 - factor.square()).rsqrt()
            rows = rows * self.present(b)[..., None]
        return rows

    @cached_property
    def _ties(self) -> tuple[tuple[torch.Tensor, torch.Tensor], ...]:
        """Of each block the speed (S, R) at which a run was read before, and how its noise there correlates (S, R)."""
        import torch

        every = []
        for b in range(len(self.runs)):
            here = self.present(b)[:, 0] > 0
            count = torch.arange(len(here))[:, None].expand(here.shape)
            seen = torch.where(here, count, -1).cummax(dim=0).values
            before = torch.cat([torch.full_like(seen[:1], -1), seen[:-1]])
            ties = torch.where(before >= 0, self.correlation ** (count - before).double(), 0.0)
            every.append((before.clamp(min=0), ties))
        return tuple(every)

    def log_determinant(self) -> float:
        """That of the covariance of both parts of all readings (of one data set), where noise is by reading."""
        total, n_channels = 0.0, len(self.measurement.dataset.channels)
        for b, (_, ties) in enumerate(self._ties):
            here, precision = self.present(b), self.precision[b][0]
            total += 2 * n_channels * float((here[:, 0] * (1 - ties.square()).log()).sum())
            total -= 4 * float(precision[here.expand_as(precision) > 0].log().sum())
            if self.common:
                total += 2 * float((1 + self.common[b][0].square().sum(-1)).log().sum())
            if self.records:  # a record's factor moves both parts of its readings together
                total += float((1 + self.records[b][0].abs().square().sum(-2)).log().sum())
        return total

    # --- other precisions --------------------------------------------------------------------------

    def scaled(self, shares: torch.Tensor | float) -> Readings:
        """The same with precisions times ``shares``."""
        parts: dict[str, Any] = {n: tuple(e * shares for e in getattr(self, n)) for n in ("precision", "records")}
        return replace(self, **parts)

    def deviation(self, b: int, predicted: np.ndarray, factor: np.ndarray | float = 1.0) -> np.ndarray:
        """(.., S, P, R) m of the ``predicted`` readings of block b; ``factor`` (P,) over the stated noise."""
        return self.measurement.deviation_of(
            predicted, self.measurement.baseline[..., self.runs[b]], factor, alone=True, runs=self.runs[b]
        )

    def departure(self, b: int, predicted: np.ndarray, factor: np.ndarray | float = 1.0) -> np.ndarray:
        """(.., S, P, R) own deviations that readings of block b are off by, at the likeliest factor of their record."""
        noise = self.deviation(b, predicted, factor)
        off, moves = (predicted - self.measured[b].numpy()) / noise, self.measurement.noise.record * predicted / noise
        share = (moves.conj() * off).real.sum(-2, keepdims=True) / (0.5 + (np.abs(moves) ** 2).sum(-2, keepdims=True))
        return np.asarray(np.abs(off - moves * share))

    def present(self, b: int) -> torch.Tensor:
        """(S, 1, R) one where a run of block b was measured, zero elsewhere."""
        import torch

        return torch.as_tensor(self.measurement.dataset.present[:, self.runs[b]], dtype=torch.float64)[:, None]

    def follow(
        self,
        predicted: Sequence[torch.Tensor],
        factor: np.ndarray | float = 1.0,
        shares: Sequence[np.ndarray] = (),
    ) -> Readings:
        """The same with the noise of ``predicted`` readings, of which ``shares`` count (all of them), by block.

        The deviation of a reading follows from the predicted amplitude, not from the measured one, whose noise would
        bias a fit. Runs that the same baseline was taken off share its noise: what is weighed is each reading's own.
        """
        import torch

        measurement, precision, common, records = self.measurement, [], [], []
        counted = tuple(shares) or (np.ones(1),) * len(self.runs)
        for b, expected in enumerate(predicted):
            taken = measurement.baseline[..., self.runs[b]]
            alone = measurement.deviation_of(expected.numpy() + taken, factor=factor, alone=True, runs=self.runs[b])
            precision.append(torch.as_tensor(np.sqrt(2.0 * counted[b]) / alone) * self.present(b))
            if measurement.noise.record:
                records.append(measurement.noise.record * expected * precision[-1])
            if measurement.baseline.any():
                noise = measurement.deviation_of(taken, factor=factor, runs=self.runs[b])
                common.append(torch.as_tensor(np.where(taken != 0, noise, 0.0) / alone))
        every: dict[str, Any] = {"precision": tuple(precision), "common": tuple(common), "records": tuple(records)}
        return replace(self, **every, shares=counted)


def _share(vectors: torch.Tensor, axis: int) -> torch.Tensor:
    """c for which ``1 - c v v'`` is the inverse root of ``1 + v v'``, for vectors v along an axis."""
    square = vectors.abs().square().sum(axis, keepdim=True)
    return (1 - (1 + square).rsqrt()) / square.clamp(min=1e-30)


def gather_readings(measurement: Measurement) -> Readings:
    """The readings of a measurement, with the stated noise of what was read."""
    import torch

    every = tuple(np.asarray(block.runs) for block in measurement.response.blocks)
    measured = tuple(torch.as_tensor(measurement.dataset.displacement[None][..., runs]) for runs in every)
    levels = measurement.drift.mixing() if measurement.drift else ()
    mixing = tuple(torch.as_tensor(levels[runs]) for runs in every if len(levels))
    return Readings(measurement=measurement, runs=every, measured=measured, mixing=mixing).follow(measured)


# --- what they would read -------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class _Placed:
    """Runs of a block on their bearings, V of them: one a speed, or one a run and speed."""

    block: ResponseBlock  # at the model parameters
    variation: ResponseBlock | None  # its derivatives by them; None without any
    change: torch.Tensor  # dH, (G, V, 2 B, 2 B) N/m
    factor: torch.Tensor  # (G, V, B) what these runs' bearings are scaled by
    eight: torch.Tensor  # (G, V, B, 8) coefficients before that
    scale: torch.Tensor  # (V, B, T) derivative of the factor
    known: torch.Tensor  # (G, V or 1, 8 B, T) derivative of what softens in these runs


@dataclass(frozen=True, eq=False)
class SensorModel:
    """The response of a measurement's rotor, of first order in the model parameters about those it was solved at.

    Bearings and supports are exact: they act at the few places where they stand.
    """

    measurement: Measurement
    whole: Measurement  # with the baseline as the last run, where bearings drift and it was taken off
    blocks: tuple[ResponseBlock, ...]  # of tensors

    @cached_property
    def solved_at(self) -> torch.Tensor:
        """(T,) model parameters."""
        import torch

        return torch.as_tensor(self.measurement.parameter_values)

    @cached_property
    def _influence(self) -> torch.Tensor:
        """(8 B, A) which coefficients each active unknown moves."""
        import torch

        influence = self.measurement.unknowns.influence
        every = np.pad(influence, ((0, self.measurement.rotor.n_ground), (0, 0), (0, 0)))
        return torch.as_tensor(every.reshape(every.shape[0] * every.shape[1], -1))

    @cached_property
    def _known(self) -> torch.Tensor:
        """(S, 8 B) N/m and N s/m, the other coefficients, zero where identified; supports are as they were solved."""
        import torch

        measurement, n_speeds = self.measurement, len(self.measurement.dataset.speeds)
        others = np.where(measurement.unknowns.identified[:, None], 0.0, measurement.updated_known.values)  # (B, S, 8)
        every = np.pad(others, ((0, measurement.rotor.n_ground), (0, 0), (0, 0)))
        return torch.as_tensor(every.swapaxes(0, 1).reshape(n_speeds, -1))

    @cached_property
    def _known_slopes(self) -> tuple[torch.Tensor, ...]:
        """(S, 8 B, T) of each block: how the other coefficients and the supports move with steps of the parameters."""
        import torch

        measurement, slopes = self.measurement, []
        for block in self.blocks:
            every = local_change(measurement.parameters, measurement.rotor, block.frequencies.numpy())
            every[:, : len(measurement.rotor.bearing_nodes)] += measurement.known_variation
            slopes.append(torch.as_tensor(every.reshape(len(every), len(self._influence), len(self.solved_at))))
        return tuple(slopes)

    @cached_property
    def _growth(self) -> torch.Tensor:
        """(T,) prior deviations of what grows with the exponential of its parameter; zero for what is in proportion."""
        import torch

        return torch.tensor([p.growth for p in self.measurement.parameters], dtype=torch.float64)

    @cached_property
    def _spread(self) -> torch.Tensor:
        """(T,) bool, what acts by the rotor's matrices, not where bearings and casings stand alone."""
        import torch

        return torch.tensor([not p.row.local for p in self.measurement.parameters], dtype=torch.bool)

    def _step(self, parameters: torch.Tensor) -> torch.Tensor:
        """(G, T) by how many deviations each number is off: supports grow with the exponential of their parameter."""
        import torch

        growth = self._growth.clamp(min=1e-300)
        return torch.where(self._growth > 0, (parameters * self._growth).expm1() / growth, parameters)

    @cached_property
    def _placed(self) -> tuple[tuple[ResponseBlock, ...], ...]:
        """Of each block the groups of runs that are solved at once."""
        return tuple(map(self._group, self.blocks))

    @cached_property
    def _variations(self) -> tuple[tuple[ResponseBlock, ...], ...]:
        """Their derivatives by the model parameters that :attr:`_spread`; none where there are none."""
        import torch

        def spread(array: np.ndarray) -> torch.Tensor:
            every = torch.as_tensor(array)
            return every[self._spread] if every.ndim > 1 else every  # frequencies are the same for all

        return tuple(self._group(block.converted(spread)) for block in self.whole.variations)

    def _group(self, block: ResponseBlock, most: int = 1000) -> tuple[ResponseBlock, ...]:
        """The block, or where bearings or the base differ between runs, some of these at a time, one after the other
        as speeds of a single run, ``most`` speeds or so: more take memory, and less take time.
        """
        if not (len(self._softening[2]) or self._drift.any()):
            return (block,)
        size = max(1, most // len(self._known))
        return tuple(_line_up(block.of_runs(slice(i, i + size))) for i in range(0, len(block.runs), size))

    @cached_property
    def _softening(self) -> tuple[torch.Tensor, ...]:
        """(8 B,) N/m, (8 B, T) and (R, S, 8 B, T), as :func:`pipeline.parameters.ground.softening` has them."""
        import torch

        every = softening(self.measurement.parameters, self.measurement.rotor, self.whole.dataset)
        stated, growth, fall = map(torch.as_tensor, every)
        return stated.flatten(), growth.flatten(0, 1), fall.flatten(2, 3)

    def _soften(self, parameters: torch.Tensor, runs: np.ndarray) -> tuple[torch.Tensor, torch.Tensor]:
        """(G, V, 8 B) N/m that changes in the ``runs``, and its derivatives (G, V, 8 B, T); V is 1 if nothing does."""
        import torch

        stated, growth, falls = self._softening
        fall = falls[runs].flatten(0, 1) if len(falls) else torch.zeros_like(growth)[None]
        held = (stated * (parameters @ growth.T).exp())[:, None]
        change = held * (-(fall @ parameters[:, None, :, None])[..., 0]).expm1()
        return change, change[..., None] * growth - (held + change)[..., None] * fall

    @cached_property
    def _drift(self) -> torch.Tensor:
        """(R, B, T) how model parameters scale each bearing in each run."""
        import torch

        return torch.as_tensor(
            drift_scales(self.measurement.parameters, self.whole.dataset.runs, len(self._influence) // 8)
        )

    def _place(
        self, b: int, values: torch.Tensor, parameters: torch.Tensor, derivative: bool = True
    ) -> Iterator[_Placed]:
        """The groups of block b at the model parameters; their derivatives by them, which take long, where they are
        asked for or the parameters are not those that the rotor was solved at.
        """
        import torch

        shift = (parameters - self.solved_at)[:, self._spread]
        shifted = shift.requires_grad or bool(shift.any())
        steps = self._step(parameters) - self._step(self.solved_at)
        known = self._known + (self._known_slopes[b] @ steps[:, None, :, None])[..., 0]
        whole, references = values @ self._influence.T + known, torch.as_tensor(self.whole.response.references)
        nothing = (None,) * len(self._placed[b])
        varied = self._variations[b] if (derivative or shifted) and self._variations else nothing
        for block, variation in zip(self._placed[b], varied, strict=True):
            count = len(block.frequencies) // len(self._known)  # of runs that stand apart, 1 if none do
            softer, softer_slopes = self._soften(parameters, block.runs)
            held = (whole.repeat(1, count, 1) + softer).unflatten(-1, (-1, 8))
            scale = self._drift[block.runs[:count]].repeat_interleave(len(self._known), dim=0)
            factor = 1 + (scale @ parameters[:, None, :, None])[..., 0]
            change = impedance_change(held * factor[..., None], block.frequencies, references)
            block = block.vary(variation, shift) if shifted and variation else block
            yield _Placed(block, variation, change, factor, held, scale, softer_slopes)

    def predict(self, values: torch.Tensor, unbalance: torch.Tensor, parameters: torch.Tensor) -> list[torch.Tensor]:
        """(G, S, P, R) m of every block.

        Args:
            values: (G, S, A) active unknowns, N/m and N s/m.
            unbalance: (G, N) complex, kg m.
            parameters: (G, T) in prior deviations.
        """
        every = [self._place(b, values, parameters, False) for b in range(len(self.blocks))]
        return [
            self._join(b, [respond(placed.block, placed.change, unbalance, False).sensors for placed in groups])
            for b, groups in enumerate(every)
        ]

    def _join(self, b: int, groups: Sequence[torch.Tensor]) -> torch.Tensor:
        """(G, S, P, R, ..) of block b, from the same of its groups, without the baseline that is taken off."""
        import torch

        size = len(self._known)
        shown = torch.cat([each.unflatten(1, (-1, size)).movedim(1, 3).flatten(3, 4) for each in groups], dim=3)
        if self.whole.dataset.runs[self.blocks[b].runs[-1]] != BASELINE:
            return shown
        return shown[:, :, :, :-1] - shown[:, :, :, -1:]

    def derive(
        self,
        b: int,
        values: torch.Tensor,
        unbalance: torch.Tensor,
        parameters: torch.Tensor,
        slopes: torch.Tensor | None = None,
    ) -> tuple[torch.Tensor, ...]:
        """Readings of block b, and their derivatives (G, S, P, R, ..) by what :meth:`predict` takes: A unknowns, or n
        numbers by which these have ``slopes`` (G, S, A, n); N planes (by 1 kg m); T model parameters.
        """
        known = self._known_slopes[b] * (parameters * self._growth).exp()[:, None, None]  # (G, S, 8 B, T)
        influence = self._influence.expand(*known.shape[:3], -1)
        moves = influence if slopes is None else self._influence @ slopes  # (G, S, 8 B, n)
        every = [self._derive(placed, unbalance, moves, known) for placed in self._place(b, values, parameters)]
        return tuple(self._join(b, groups) for groups in zip(*every, strict=True))

    def _derive(
        self, placed: _Placed, unbalance: torch.Tensor, moves: torch.Tensor, known: torch.Tensor
    ) -> tuple[torch.Tensor, ...]:
        """As :meth:`derive`, of a group of runs."""
        import torch

        response, count = respond(placed.block, placed.change, unbalance), len(placed.scale) // moves.shape[1]
        moves, known = (by.repeat(1, count, 1, 1) for by in (moves, known))
        factor = placed.factor.repeat_interleave(8, dim=2)[..., None]
        by_scale = placed.eight.flatten(2)[..., None] * placed.scale.repeat_interleave(8, dim=1)
        every = torch.cat([moves * factor, (known + placed.known) * factor + by_scale], dim=-1)
        by_numbers, by_parameters = derive(placed.block, response, every).split(
            [moves.shape[-1], known.shape[-1]], dim=-1
        )
        by_planes = response.sensors.new_zeros(*response.sensors.shape, unbalance.shape[-1])
        if response.unit_sensors.shape[-1]:
            by_planes = response.unit_sensors[:, :, :, None, :].expand(by_planes.shape)
        if placed.variation is not None:
            by_model = derive_by_parameters(placed.variation, response, placed.change, unbalance)
            by_parameters = by_parameters.index_add(-1, self._spread.nonzero()[:, 0], by_model)
        return response.sensors, by_numbers, by_planes, by_parameters


def _line_up(block: ResponseBlock) -> ResponseBlock:
    """The block with its runs one after the other, as speeds of a single run."""
    count = len(block.runs)

    def turn(forced: torch.Tensor) -> torch.Tensor:
        return forced.movedim(-1, -3).flatten(-3, -2)[..., None]

    def repeat(array: torch.Tensor) -> torch.Tensor:
        return array.repeat(*[1] * (array.ndim - 3), count, 1, 1)

    return ResponseBlock(
        runs=block.runs,
        frequencies=block.frequencies.repeat(count),
        forced_sensors=turn(block.forced_sensors),
        forced_bearings=turn(block.forced_bearings),
        receptance_sensors=repeat(block.receptance_sensors),
        receptance_bearings=repeat(block.receptance_bearings),
        unit_sensors=repeat(block.unit_sensors),
        unit_bearings=repeat(block.unit_bearings),
    )


def sensor_model(measurement: Measurement) -> SensorModel:
    """That of a measurement, at the values of its model parameters."""
    import torch

    whole = add_baseline(measurement)
    return SensorModel(measurement, whole, tuple(block.converted(torch.as_tensor) for block in whole.response.blocks))


def read_answer(measurement: Measurement, bearings: BearingTable, unbalance: np.ndarray | None) -> np.ndarray:
    """(S, P, R) m as the data set has them, of fitted coefficients and a residual unbalance (N,) kg m.

    ``measurement`` is at the fitted model parameters, which give each run its bearings where these drift.
    """
    import torch

    unknowns = measurement.unknowns
    model, planes = sensor_model(measurement), np.zeros(len(unknowns.planes)) if unbalance is None else unbalance
    values = torch.as_tensor(unknowns.to_active(unknowns.leading(bearings.values)))
    shown = model.predict(values[None], torch.as_tensor(planes.astype(complex))[None], model.solved_at[None])
    return join_runs([block.runs for block in measurement.response.blocks], [each[0].numpy() for each in shown])
