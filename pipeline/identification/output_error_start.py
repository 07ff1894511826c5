"""Where the fit by the output error starts: weighted linear least squares of the residual, in the model's features.

From a random start the output error may stick; the residual, linear in the coefficients, has one answer. Where the
sensors are too few to tell the forces at the bearings, the start is the configured guess in several sizes, and what a
stationary Kalman smoother makes of each speed by itself.

Legend: G starts, S speeds, P channels, R runs, M members, U unknowns, A those of them that members have, K features, Z
weights.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from pipeline.identification.basis import Basis, orthonormal_basis
from pipeline.identification.configured_model import coefficient_model
from pipeline.identification.evidence_prior import add_beyond, with_sigma
from pipeline.identification.held_out import held_out_conditions, held_out_range, held_out_runs
from pipeline.identification.law_start import (
    LawStart,
    corrects,
    first_weights,
    scale_by_laws,
    start_laws,
    without_correction,
)
from pipeline.identification.law_term import for_model
from pipeline.identification.linear_start import linear_start
from pipeline.identification.model import CoefficientModel
from pipeline.identification.problem import OutputError, output_error
from pipeline.identification.training import FitSetup, held_out_speeds, initial_guess
from pipeline.problem.kalman_filter import filter_bearings
from pipeline.problem.measurement import Guess, Measurement

if TYPE_CHECKING:
    import torch

_GUESSES = (0.03, 0.1, 0.3, 1.0, 3.0, 10.0, 30.0)
"""Where the sensors are too few for a linear start, the configured guess is tried in these sizes."""


@dataclass(frozen=True, eq=False, kw_only=True)
class OutputErrorStart:
    """Everything before the first step."""

    measurement: Measurement  # all speeds and runs
    keep: np.ndarray  # (S,) mask of the training speeds
    problem: OutputError  # of the training speeds and runs
    weights: torch.Tensor  # (G, 1, Z); several where they are guesses
    held_out_speeds: OutputError | None
    held_out_runs: OutputError | None
    from_guess: bool  # the sensors were too few for a linear start
    filtered: np.ndarray | None  # (M, S, U) at the training speeds: what a filter made of few sensors
    law: LawStart | None = None  # of bearing laws: the numbers, and how many guesses led there

    @property
    def by_evidence(self) -> bool:
        """Whether all features are kept, and the likelihood says how large they are: corrections, several inputs."""
        model = self.problem.basis.model
        return bool(self.problem.kept.any()) and (model.fades or len(model.inputs) > 1)


def prepare_output_error(measurement: Measurement, setup: FitSetup) -> OutputErrorStart:
    """The problem on the training speeds and runs, and where it starts.

    Raises ConfigError for held-out runs that the data lack, or that leave no other.
    """
    measurement = for_model(measurement, setup)
    unknowns, speeds = measurement.unknowns, measurement.dataset.speeds
    held_out = held_out_runs(measurement, setup.training)
    keep = ~held_out_speeds(len(speeds), setup.training.holdout_every) & ~held_out_range(speeds, setup.training)
    keep &= ~held_out_conditions(measurement.dataset.operating, setup.training, len(speeds))
    runs = np.setdiff1d(np.arange(len(measurement.dataset.runs)), held_out)
    plane_scale = _plane_scale(measurement)  # solves the response, of which all problems are parts
    training = align_weights(measurement.select(keep, runs))
    sizes = Guess(setup.model.initial_stiffness, setup.model.initial_damping).sizes(unknowns)
    basis = drawn_basis(setup, training, measurement.dataset.points, sizes)
    if training.laws is not None:
        first = _start_by_laws(training, setup, basis, plane_scale)
    else:
        first = _start_by_coefficients(training, setup, basis, plane_scale)

    def held_out_part(keep: np.ndarray | None, runs: np.ndarray) -> OutputError:
        return output_error(measurement.select(keep, runs), first.basis, plane_scale)

    return OutputErrorStart(
        measurement=measurement,
        keep=keep,
        problem=first.problem,
        weights=first.weights,
        held_out_speeds=None if keep.all() else held_out_part(~keep, runs),
        held_out_runs=held_out_part(None, held_out) if len(held_out) else None,
        from_guess=first.from_guess,
        filtered=first.filtered,
        law=first.law,
    )


class _First(NamedTuple):
    problem: OutputError
    weights: torch.Tensor  # (G, 1, Z)
    from_guess: bool
    filtered: np.ndarray | None
    law: LawStart | None

    @property
    def basis(self) -> Basis:
        return self.problem.basis


def _start_by_coefficients(training: Measurement, setup: FitSetup, basis: Basis, plane_scale: float) -> _First:
    """Near the least squares of the residual; near guesses where the sensors are too few for that."""
    import torch

    unknowns, values = training.unknowns, None
    if training.guess.within is None:
        values = linear_start(training, basis.at(training.dataset.points).numpy(), np.array(basis.model.scale))
    starts, filtered = [values], None
    if values is None:
        shape = (unknowns.n_members, len(training.dataset.speeds), len(unknowns.names))
        guess = initial_guess(setup, unknowns)
        starts = [np.broadcast_to(size * guess[:, None], shape) for size in _GUESSES]
        filtered = _filter(training)
    else:
        basis = replace(basis, model=_scaled_by(basis.model, values))
    problem = output_error(training, basis, plane_scale)
    weights = torch.cat([start_at(problem, start) for start in starts if start is not None])
    # Free at once, the features of several inputs would follow the noise of points: the fit starts at their trend.
    return _First(problem, weights, values is None or len(basis.model.inputs) > 1, filtered, None)


def _start_by_laws(training: Measurement, setup: FitSetup, basis: Basis, plane_scale: float) -> _First:
    """At the best numbers of bearing laws, without a correction."""
    law = start_laws(training, basis, plane_scale)
    rows = scale_by_laws(output_error(training, basis, plane_scale), law.theta)
    basis = replace(basis, model=replace(basis.model, scale=rows))
    if corrects(setup):
        problem = with_sigma(output_error(training, add_beyond(basis), plane_scale))
    else:
        problem = without_correction(output_error(training, basis, plane_scale))
    return _First(problem, first_weights(problem, law.theta), False, None, law)


def align_weights(measurement: Measurement) -> Measurement:
    """The measurement at the common angle of all weights (``weight_angle``, where it is uncertain) that fits best.

    Far from it, Gauss-Newton steps end in another valley. For any bearings the response turns with the weights, so the
    angle is that between what the runs' differences show and what the guessed bearings make of them.
    """
    at = [t for t, parameter in enumerate(measurement.parameters) if parameter.kind == "weight_angle"]
    if not at:
        return measurement
    n_speeds, unknowns = len(measurement.dataset.speeds), measurement.unknowns
    guess = np.repeat(measurement.guess.sizes(unknowns)[:, None], n_speeds, axis=1)
    guess = guess * [name in ("kxx", "kyy", "cxx", "cyy") for name in unknowns.names]
    expected = measurement.response.predict(measurement.table(guess)) / measurement.deviation
    shown = measurement.dataset.displacement / measurement.deviation
    turned = [run - run.mean(axis=2, keepdims=True) for run in (expected, shown)]
    angle = np.angle(np.vdot(turned[0], turned[1]))
    values = measurement.parameter_values
    values[at[0]] += angle / measurement.parameters[at[0]].deviation
    return measurement.update(values)


def drawn_basis(setup: FitSetup, training: Measurement, points: Mapping[str, np.ndarray], sizes: np.ndarray) -> Basis:
    """The features of the configured model over the ``points`` (name -> (S,)), orthonormal at those of ``training``.

    ``sizes`` (M, U), N/m and N s/m, are what an output of 1 stands for.
    """
    import torch

    model = coefficient_model(setup.model, training.unknowns.names, points, sizes)
    generator = torch.Generator().manual_seed(setup.seed)
    drawn = model.spread_parameters(initial_guess(setup, training.unknowns), generator)
    return orthonormal_basis(model, drawn, training.dataset.points)


def _filter(training: Measurement) -> np.ndarray | None:
    """Unknowns (M, S, U) of each training speed by itself; None where the sensors are too few for that, too."""
    less = training.subtract_unbalance()
    if 2 * less.dataset.displacement[0].size < len(less.unknowns.active):
        return None
    values, settled = filter_bearings(less)
    if settled.mean() < _LEAST_SETTLED:
        return None
    order = np.flatnonzero(settled)
    nearest = order[np.abs(np.arange(len(settled))[:, None] - order).argmin(axis=1)]
    return values[:, nearest]


_LEAST_SETTLED = 0.5
"""Share of the speeds at which the filter must have settled to be a start."""


def _scaled_by(model: CoefficientModel, values: np.ndarray) -> CoefficientModel:
    """The model with the sizes of unknowns (M, S, U) found in the data in place of guessed ones."""
    medians = np.median(np.abs(values), axis=1)
    return replace(model, scale=tuple(map(tuple, np.where(medians > 0, medians, model.scale).tolist())))


def _plane_scale(measurement: Measurement) -> float:
    """kg m that moves the sensors about as much as what was measured."""
    units = [np.abs(block.unit_sensors) for block in measurement.response.blocks if block.unit_sensors.shape[-1]]
    if not units:
        return 1.0
    return float(np.median(np.abs(measurement.dataset.displacement)) / np.median(units[0]))


# --- weights near given coefficients -------------------------------------------------------------------


def start_at(problem: OutputError, values: np.ndarray) -> torch.Tensor:
    """(1, 1, Z) the weights that come nearest to unknowns (M, S, U), without residual unbalance, of the stated model.

    ``problem`` is that of the training speeds, where the features are orthonormal: their coordinates are projections.
    """
    import torch

    raw = _raw(problem, values)
    coordinates = (
        torch.stack([problem.features[m].T @ raw[m, :, u] for m, u in problem.active]) * problem.kept
    )  # (A, K)
    weights = torch.zeros(1, 1, problem.size, dtype=coordinates.dtype)
    weights[..., problem.places.coefficients] = coordinates.flatten()
    weights[..., problem.places.parameters] = problem.sensors.solved_at
    return weights


def robust_start(problem: OutputError, values: np.ndarray) -> torch.Tensor:
    """As :func:`start_at`, of rough unknowns (M, S, U): single speeds that are far off count less (Huber 1964)."""
    import torch

    raw = _raw(problem, values)
    rows: list[torch.Tensor] = []
    for m, u in problem.active:
        features, target = problem.features[m], raw[m, :, u]
        weight, solution = torch.ones_like(target), torch.zeros(features.shape[-1], dtype=target.dtype)
        for _ in range(_ROBUST_ROUNDS):
            weighted = features * weight[:, None]
            ridge = _RIDGE * torch.eye(len(solution), dtype=target.dtype)
            solution = torch.linalg.solve(features.T @ weighted + ridge, weighted.T @ target)
            off = (target - features @ solution).abs()
            weight = 1 / (off / off.median().clamp(min=_SMALLEST)).clamp(min=1.0)
        rows.append(solution * problem.kept[len(rows)])
    rest = torch.zeros(problem.places.n_rest, dtype=raw.dtype)
    return torch.cat([torch.stack(rows).flatten(), rest])[None, None]


_ROBUST_ROUNDS, _RIDGE, _SMALLEST = 20, 1e-12, 1e-12


def _raw(problem: OutputError, values: np.ndarray) -> torch.Tensor:
    """(M, S, U) outputs of the model that give unknowns (M, S, U)."""
    import torch

    return problem.basis.model.raw_from(torch.tensor(values), problem.scale)
