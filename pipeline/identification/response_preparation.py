"""What a fit by the output error starts from: the readings, the problem on training speeds and runs, the start.

Legend: S speeds, P channels, R runs, M members, U unknowns, Z free numbers.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from pipeline.config.runs import NoiseConfig
from pipeline.data.dataset import reading_deviation
from pipeline.equations.filtered import BearingFilter, filtered
from pipeline.equations.response import ResponseEquations
from pipeline.identification.coefficient_model import CoefficientModel, coefficient_model
from pipeline.identification.feature_basis import FeatureBasis, feature_basis
from pipeline.identification.response_block import Readings, block_of
from pipeline.identification.response_problem import ResponseProblem
from pipeline.identification.response_start import differences, linear_start
from pipeline.identification.training import PreparedTraining, TrainingSetup, held_out_speeds, initial_guess
from pipeline.rotor.bearing_table import BearingTable
from pipeline.unknowns import UnknownSet, unknown_set

if TYPE_CHECKING:
    import torch

_GUESSES = (0.03, 0.1, 0.3, 1.0, 3.0, 10.0, 30.0)
"""Where the sensors are too few for a linear start, the configured guess is tried in these sizes."""


@dataclass(frozen=True, eq=False)
class MeasuredResponse:
    """The readings, and how they are weighted."""

    equations: ResponseEquations
    displacement: np.ndarray  # (S, P, R) complex, m
    noise: NoiseConfig
    subtracted: np.ndarray | None = None  # (S, P, R) m, the baseline that was taken off

    def deviation(self) -> np.ndarray:
        """(S, P, R) root mean square of the noise, m, by the sizes of the readings."""
        return self.deviation_of(self.displacement, self.subtracted, np.ones(self.displacement.shape[1]))

    def deviation_of(self, displacement: np.ndarray, subtracted: np.ndarray | None, factor: np.ndarray) -> np.ndarray:
        """(.., S, P, R) of readings of another size; ``factor`` (P,) is a channel's deviation over the stated one."""
        size = reading_deviation(displacement, subtracted, self.noise.additive, self.noise.multiplicative)
        return np.asarray(np.maximum(size * factor[:, None], _LEAST))


_LEAST = 1e-15
"""m; a reading of zero without additive noise would have none at all."""


@dataclass(frozen=True, eq=False)
class PreparedResponse:
    """Everything before the first step."""

    data: MeasuredResponse
    training: PreparedTraining
    problem: ResponseProblem
    held_out_speeds: ResponseProblem | None
    held_out_runs: ResponseProblem | None
    start: torch.Tensor  # (G, 1, Z); several where they are guesses
    keep: np.ndarray  # (S,) mask of training speeds
    from_guess: bool  # the sensors were too few for a linear start
    rough: np.ndarray | None  # (M, S, U) at the training speeds: what a filter made of few sensors


def prepare_response(
    data: MeasuredResponse, known: BearingTable, setup: TrainingSetup, seed: int, held_out_runs: np.ndarray
) -> PreparedResponse:
    """The problem on the training speeds and runs, and where it starts."""
    import torch

    equations, readings = data.equations, Readings(data.displacement, data.deviation(), data.subtracted)
    unknowns = unknown_set({node: setup.identify.at(node) for node in equations.bearing_nodes})
    members = 1 if setup.identify.tie_bearings else len(equations.bearing_nodes)
    keep = ~held_out_speeds(len(equations.speeds), setup.training.holdout_every)
    runs = np.setdiff1d(np.arange(data.displacement.shape[-1]), held_out_runs)
    guess = initial_guess(setup, unknowns.names, members)
    model = coefficient_model(setup.model, unknowns.names, equations.speeds, _sizes(setup, unknowns, members))
    drawn = model.spread_parameters(guess, torch.Generator().manual_seed(seed))
    basis = feature_basis(model, drawn, equations.speeds[keep])
    values = _linear_start(equations, readings, unknowns, known, basis, keep, runs)
    starts, rough = [values], None
    if values is None:
        shape = (members, int(keep.sum()), len(unknowns.names))
        starts = [np.broadcast_to(size * guess[:, None], shape) for size in _GUESSES]
        rough = _filtered(equations, readings, unknowns, known, np.abs(_sizes(setup, unknowns, members)), keep, runs)
    else:
        basis = replace(basis, model=_scaled_by(basis.model, values))
    plane_scale = _plane_scale(equations, data.displacement)

    def problem(speeds: np.ndarray, of: np.ndarray) -> ResponseProblem:
        return response_problem(basis, equations, unknowns, known, readings, speeds, of, plane_scale)

    train = problem(keep, runs)
    return PreparedResponse(
        data,
        PreparedTraining(basis.model, unknowns, train, None, None, equations.bearing_nodes, ()),
        train,
        problem(~keep, runs) if not keep.all() else None,
        problem(np.ones_like(keep), held_out_runs) if len(held_out_runs) else None,
        torch.cat([start_at(train, start) for start in starts if start is not None]),
        keep,
        from_guess=values is None,
        rough=rough,
    )


def _linear_start(
    equations: ResponseEquations,
    readings: Readings,
    unknowns: UnknownSet,
    known: BearingTable,
    basis: FeatureBasis,
    keep: np.ndarray,
    runs: np.ndarray,
) -> np.ndarray | None:
    """:func:`~pipeline.identification.response_start.linear_start` on the training speeds and runs."""
    return linear_start(
        _restricted(equations, keep, runs),
        readings.displacement[keep][..., runs],
        readings.deviation[keep][..., runs],
        unknowns,
        known.at(np.flatnonzero(keep)),
        basis.at(equations.speeds[keep]).numpy(),
        np.array(basis.model.scale),
    )


def _filtered(
    equations: ResponseEquations,
    readings: Readings,
    unknowns: UnknownSet,
    known: BearingTable,
    guess: np.ndarray,
    keep: np.ndarray,
    runs: np.ndarray,
) -> np.ndarray | None:
    """Unknowns (M, S, U) of each training speed by itself; None where the sensors are too few for that, too."""
    equations = _restricted(equations, keep, runs)
    measured, deviation = (of[keep][..., runs] for of in (readings.displacement, readings.deviation))
    if equations.planes:
        equations, measured, deviation = differences(equations, measured, deviation)
    if 2 * measured[0].size < int(unknowns.present[: len(guess)].sum()):
        return None
    alike = len(guess) < len(equations.bearing_nodes)
    problem = BearingFilter(equations, measured, deviation, unknowns, known.at(np.flatnonzero(keep)), alike)
    values, settled = filtered(problem, guess)
    if settled.mean() < _LEAST_SETTLED:
        return None
    order = np.flatnonzero(settled)
    nearest = order[np.abs(np.arange(len(settled))[:, None] - order).argmin(axis=1)]
    return values[:, nearest]


_LEAST_SETTLED = 0.5
"""Share of the speeds at which the filter must have settled to be a start."""


def _scaled_by(model: CoefficientModel, values: np.ndarray) -> CoefficientModel:
    """The model with the sizes of unknowns (M, S, U) found in the data in place of guessed ones."""
    found = np.median(np.abs(values), axis=1)
    return replace(model, scale=tuple(map(tuple, np.where(found > 0, found, model.scale).tolist())))


def _restricted(equations: ResponseEquations, keep: np.ndarray, runs: np.ndarray) -> ResponseEquations:
    """The equations at training speeds and runs, the runs numbered anew."""
    blocks = []
    for block in equations.blocks:
        own = block.at(keep, runs)
        if len(own.runs):
            blocks.append(replace(own, runs=np.searchsorted(runs, own.runs)))
    return replace(equations, speeds=equations.speeds[keep], blocks=tuple(blocks))


def _sizes(setup: TrainingSetup, unknowns: UnknownSet, members: int) -> np.ndarray:
    """(M, U) what an output of 1 stands for before anything is known: the configured guesses of direct coefficients."""
    model = setup.model
    values = [model.initial_stiffness if name.startswith("k") else model.initial_damping for name in unknowns.names]
    return np.tile(values, (members, 1))


def _plane_scale(equations: ResponseEquations, displacement: np.ndarray) -> float:
    """kg m that moves the sensors about as much as what was measured."""
    units = [np.abs(block.unit_sensors) for block in equations.blocks if block.unit_sensors.shape[-1]]
    if not units:
        return 1.0
    return float(np.median(np.abs(displacement)) / np.median(units[0]))


def robust_start(problem: ResponseProblem, values: np.ndarray) -> torch.Tensor:
    """As :func:`start_at`, of rough unknowns (M, S, U): single speeds that are far off count less (Huber 1964)."""
    import torch

    raw = problem.basis.model.raw_from(torch.as_tensor(np.ascontiguousarray(values)), problem.scale)
    rows: list[torch.Tensor] = []
    for m, u in problem.active:
        features, target = problem.features[m], raw[m, :, u]
        weight, found = torch.ones_like(target), torch.zeros(features.shape[-1], dtype=target.dtype)
        for _ in range(_ROUNDS):
            weighted = features * weight[:, None]
            ridge = _RIDGE * torch.eye(len(found), dtype=target.dtype)
            found = torch.linalg.solve(features.T @ weighted + ridge, weighted.T @ target)
            off = (target - features @ found).abs()
            weight = 1 / (off / off.median().clamp(min=_SMALLEST)).clamp(min=1.0)
        rows.append(found * problem.kept[len(rows)])
    planes = torch.zeros(2 * problem.n_planes, dtype=raw.dtype)
    return torch.cat([torch.stack(rows).flatten(), planes])[None, None]


_ROUNDS, _RIDGE, _SMALLEST = 20, 1e-12, 1e-12


def start_at(problem: ResponseProblem, values: np.ndarray) -> torch.Tensor:
    """(1, 1, Z) the free vector that comes nearest to unknowns (M, S, U), without residual unbalance.

    ``problem`` is that of the training speeds, where the features are orthonormal: their coordinates are projections.
    """
    import torch

    raw = problem.basis.model.raw_from(torch.as_tensor(np.ascontiguousarray(values)), problem.scale)  # (M, S, U)
    own = torch.stack([problem.features[m].T @ raw[m, :, u] for m, u in problem.active]) * problem.kept  # (A, K)
    planes = torch.zeros(2 * problem.n_planes, dtype=own.dtype)
    return torch.cat([own.flatten(), planes])[None, None]


def response_problem(
    basis: FeatureBasis,
    equations: ResponseEquations,
    unknowns: UnknownSet,
    known: BearingTable,
    readings: Readings,
    keep: np.ndarray,
    runs: np.ndarray,
    plane_scale: float,
) -> ResponseProblem:
    """The problem at the speeds ``keep`` (mask) and ``runs`` (indices)."""
    import torch

    n_bearings = len(equations.bearing_nodes)
    members = len(basis.parameters)
    # Members share one p where the bearings are alike: then each unknown moves the coefficients of all bearings.
    present = unknowns.present[:members]
    active = tuple((m, u) for m in range(members) for u in range(len(unknowns.names)) if present[m, u])
    spread = np.zeros((n_bearings, 8, len(active)))
    for a, (m, u) in enumerate(active):
        for b in range(n_bearings):
            if members == 1 or b == m:
                spread[b, :, a] = unknowns.expansion[b, :, u]
    others = np.where(unknowns.identified[:, None], 0.0, known.values)[:, keep]
    blocks = [block.at(keep, runs) for block in equations.blocks]
    return ResponseProblem(
        basis,
        basis.at(equations.speeds[keep]),
        basis.model.scale_tensor(),
        active,
        torch.as_tensor(spread.reshape(8 * n_bearings, -1)),
        torch.as_tensor(others.swapaxes(0, 1).reshape(int(keep.sum()), -1)),
        equations.reference,
        len(equations.planes),
        plane_scale,
        torch.ones(len(active), basis.n_features, dtype=torch.bool),
        tuple(block_of(block, readings, keep) for block in blocks if len(block.runs)),
    )
