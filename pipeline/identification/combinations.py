"""Which combinations of constant coefficients, and which model parameters, the data tell.

Two coefficients may each be unknown while their sum is known well. The covariance of the coefficients, in shares of
their sizes, has directions of smallest and largest deviation: what is known best, and what least. It is that of the
fit that will be made, at its likely start, with residual unbalance and model parameters.

Legend: A active unknowns, T model parameters, Z weights.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from pipeline.data.dataset import VibrationDataset
from pipeline.identification.output_error_start import find_likely
from pipeline.identification.problem import OutputError, output_error
from pipeline.identification.training import FitSetup
from pipeline.problem.condition_noise import NO_LEVELS
from pipeline.problem.determination import measure_sizes
from pipeline.problem.measurement import Measurement
from pipeline.problem.ranking import find_least, list_leading, rank_indices
from pipeline.problem.slopes import deviate, invert

if TYPE_CHECKING:
    import torch

_SPEEDS = (0.25, 0.5, 0.75, 1.25, 1.5, 1.75, 2.0, 2.5)
"""Speeds that one more run is tried at, in shares of the highest one that was run."""
WORTH = 0.8
"""One more run is worth naming where it leaves less than this of the deviation."""


@dataclass(frozen=True)
class Combination:
    """A direction among the coefficients."""

    shares: Mapping[str, float]  # coefficient -> its part of a unit vector, in shares of the coefficient's size
    deviation: float  # standard deviation along it, a share
    leading: float = 0.35  # members with a share below this one are not named

    @property
    def words(self) -> str:
        """Its leading coefficients, joined by their signs."""
        (first, _), *others = list_leading(self.shares, self.leading).items()
        return " ".join([first, *(f"{'with' if share > 0 else 'against'} {name}" for name, share in others)])


@dataclass(frozen=True)
class NextRun:
    """One more run of the heaviest weights."""

    run: str
    speed: float  # rad/s
    deviation: float  # of the weakest combination, with it


@dataclass(frozen=True)
class Combinations:
    """What is known best and least of constant coefficients, and what the data tell of model parameters."""

    strongest: Combination
    weakest: Combination
    parameters: Mapping[str, tuple[float, float]]  # kind (of a support: number) -> least, most left of the tolerances
    next_run: NextRun | None  # none that was tried helps


def combine(measurement: Measurement, setup: FitSetup) -> Combinations | None:
    """The combinations at the likely start of the fit; None where coefficients are functions of the speed."""
    if not setup.constant:
        return None
    start = find_likely(measurement, setup)
    problem, weights = start.problem, start.weights
    information, relative = problem.normal(weights)[1][0, 0], _share(problem, weights)
    covariance, measurement = invert(information), problem.measurement
    spread, directions = _directions(relative, covariance)
    nodes, unknowns = measurement.rotor.bearing_nodes, measurement.unknowns
    labels = [
        unknowns.names[u] if unknowns.shared else f"{unknowns.names[u]} at node {nodes[m]}" for m, u in problem.active
    ]
    ends = [Combination(dict(zip(labels, directions[:, i].tolist(), strict=True)), float(spread[i])) for i in (0, -1)]
    left, spans = np.sqrt(np.diag(covariance)[problem.places.parameters]), {}
    kinds = [number.name if number.growth else number.kind for number in measurement.parameters]
    for kind in dict.fromkeys(kinds):
        deviations = [float(value) for value, other in zip(left, kinds, strict=True) if other == kind]
        spans[kind] = (min(deviations), max(deviations))
    direction = directions[:, -1] @ relative
    return Combinations(ends[0], ends[1], spans, _try_runs(problem, weights, information, direction))


def _share(problem: OutputError, weights: torch.Tensor) -> np.ndarray:
    """(A, Z) change of each constant, as a share of its size (:func:`measure_sizes`), by the weights."""
    unknowns, table = problem.measurement.unknowns, problem.identified(weights).table(problem.measurement.known)
    sizes = unknowns.to_active(unknowns.leading(measure_sizes(table.values)))[0]
    shares = problem.unknown_slopes(weights)[0, 0] / np.where(sizes > 0, sizes, 1.0)[:, None]
    return np.pad(shares, ((0, 0), (0, problem.places.size - shares.shape[1])))


def _directions(relative: np.ndarray, covariance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(A,) deviations, ascending, and (A, A) their directions in columns."""
    values, vectors = np.linalg.eigh(relative @ covariance @ relative.T)
    return np.sqrt(np.maximum(values, 0.0)), vectors


def _try_runs(
    problem: OutputError, weights: torch.Tensor, information: torch.Tensor, direction: np.ndarray
) -> NextRun | None:
    """The speed at which the run of the heaviest weights tells most of the ``direction`` (Z,)."""
    measurement, data = problem.measurement, problem.measurement.dataset
    heaviest = [sum(weight.magnitude for weight in data.excitation_of(r)) for r in range(len(data.runs))]
    if not max(heaviest):
        return None
    run, speeds = rank_indices(heaviest)[0], np.array(_SPEEDS) * data.speeds[-1]
    acting = tuple(excitation for excitation in data.excitations if excitation.run == data.runs[run])
    read = np.zeros((len(speeds), len(data.channels), 1), dtype=complex)
    dataset = VibrationDataset(speeds, (data.runs[run],), data.channels, read, acting)
    known = replace(measurement.known.at(np.full(len(speeds), -1)), speeds=speeds)
    other = replace(measurement, dataset=dataset, known=known, drift=NO_LEVELS)
    shown = output_error(other, problem.basis, problem.plane_scale).displacement(weights)
    other = replace(other, dataset=replace(dataset, displacement=shown))
    rows = output_error(other, problem.basis, problem.plane_scale).columns(weights)[0, :, :-1]
    rows = rows.unflatten(0, (len(speeds), -1))  # of each speed
    left = deviate(direction, invert(information + rows.mT @ rows))
    s = find_least(dict(enumerate(left.tolist())))
    worth_it = left[s] < WORTH * deviate(direction, invert(information))
    return NextRun(data.runs[run], float(speeds[s]), float(left[s])) if worth_it else None
