"""The response loss in the stages: what it needs of the inputs, and its account of what is left over."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.config.schema import Config
from pipeline.data.dataset import VibrationDataset, direction_name
from pipeline.data.tables import write_table
from pipeline.data.vibration_files import to_rpm
from pipeline.equations.response import ResponseEquations, response_equations
from pipeline.errors import ConfigError
from pipeline.evaluation.fit_quality import autocorrelation, chi_square, variance_inflation
from pipeline.identification.response_fit import BAD_POINT, ResponseFit, fit_response
from pipeline.identification.response_preparation import MeasuredResponse, PreparedResponse, prepare_response
from pipeline.identification.response_problem import ResponseProblem
from pipeline.identification.training import Progress, TrainingSetup
from pipeline.identification.uncertainty import Uncertainty
from pipeline.stages.inputs import Inputs, require_nodes


def equations_of(config: Config, inputs: Inputs) -> ResponseEquations:
    """The response at the sensors. Raises ConfigError for a balance plane that the rotor lacks."""
    planes = config.identify.unbalance_planes
    require_nodes(inputs.rotor, "identify.unbalance_planes", planes)
    return response_equations(inputs.rotor, inputs.dataset, config.model.initial_stiffness, planes)


def prepared_response(config: Config, inputs: Inputs, setup: TrainingSetup) -> PreparedResponse:
    """The response problem of an experiment. Raises ConfigError for held-out runs that the data lack."""
    runs = inputs.dataset.runs
    for name in config.training.holdout_runs:
        if name not in runs:
            raise ConfigError(f"training.holdout_runs must name runs of the data ({', '.join(runs)}), but got '{name}'")
    held_out = np.array([runs.index(name) for name in config.training.holdout_runs], dtype=int)
    if len(held_out) == len(runs):
        raise ConfigError("training.holdout_runs must leave a run to train on, but it names all of them")
    equations = equations_of(config, inputs)
    data = MeasuredResponse(equations, inputs.dataset.displacement, config.stated_noise, inputs.dataset.subtracted)
    return prepare_response(data, inputs.known, setup, config.seed, held_out)


def fitted(config: Config, prepared: PreparedResponse, setup: TrainingSetup, progress: Progress | None) -> ResponseFit:
    """The fit that the configuration asks for."""
    return fit_response(prepared, setup, progress, config.loss.noise == "estimated", config.loss.robust)


@dataclass(frozen=True, eq=False)
class FitAccount:
    """What the fit leaves over. Deviations are in units of the readings' noise, complex."""

    summary: dict[str, object]
    bad_points: dict[str, list[Any]]
    inflation: float  # of the variances, where neighbouring speeds deviate together


def account_of(fit: ResponseFit, dataset: VibrationDataset) -> FitAccount:
    """Chi-square, whiteness, held-out speeds and runs, and the readings far off."""
    problem, prepared = fit.problem, fit.prepared
    plain = [
        np.asarray(d[0].numpy()) / np.sqrt(2.0 * w)
        for d, w in zip(problem.deviations(fit.free), fit.weights, strict=True)
    ]
    value, readings = chi_square(plain)
    used = problem.n_numbers
    correlation, significance = autocorrelation(plain)
    bad = _bad_points(fit, dataset, plain)
    summary: dict[str, object] = {
        "chi_square": {"value": value, "expected": readings - used / 2, "readings": readings, "numbers": used},
        "whiteness": {"autocorrelation": correlation, "over_its_deviation": significance},
        "bad_points": len(bad["run"]),
    }
    for name, other in (("held_out_speeds", prepared.held_out_speeds), ("held_out_runs", prepared.held_out_runs)):
        if other is not None:
            summary[name] = _held_out(fit, other)
    if not np.allclose(fit.factor, 1.0):
        summary["noise_factor"] = {
            f"node {node} {direction_name(angle)}": float(f)
            for (node, angle), f in zip(dataset.channels, fit.factor, strict=True)
        }
    return FitAccount(summary, bad, variance_inflation(correlation))


def _held_out(fit: ResponseFit, other: ResponseProblem) -> dict[str, float]:
    """Readings that were not fitted: their mean square over the noise (1 where all is well), the error in percent."""
    squares, count, errors, size = 0.0, 0, 0.0, 0.0
    for predicted, block in zip(other.predicted(fit.free), other.blocks, strict=True):
        measured, reached = block.measured[0].numpy(), predicted[0].numpy()
        noise = fit.prepared.data.deviation_of(reached, block.subtracted, fit.factor)
        squares += float((np.abs(reached - measured) ** 2 / noise**2).sum())
        count += measured.size
        errors += float((np.abs(reached - measured) ** 2).sum())
        size += float((np.abs(measured) ** 2).sum())
    return {"mean_square_over_noise": squares / count, "error_percent": 100.0 * float(np.sqrt(errors / size))}


def _bad_points(fit: ResponseFit, dataset: VibrationDataset, plain: list[np.ndarray]) -> dict[str, list[Any]]:
    speeds, columns = to_rpm(dataset.speeds[fit.prepared.keep]), _no_bad_points()
    for block, off in zip(fit.problem.blocks, plain, strict=True):
        for s, p, r in np.argwhere(np.abs(off) > BAD_POINT):
            node, angle = dataset.channels[p]
            row = (dataset.runs[block.runs[r]], speeds[s], node, direction_name(angle), float(np.abs(off[s, p, r])))
            for column, value in zip(columns.values(), row, strict=True):
                column.append(value)
    return columns


def _no_bad_points() -> dict[str, list[Any]]:
    """``bad_points.csv`` without a row: readings, and how many deviations they are off."""
    return {name: [] for name in ("run", "speed_rpm", "node", "direction", "deviations")}


def write_account(folder: Path, account: FitAccount | None, uncertainty: Uncertainty | None) -> list[Path]:
    """``bad_points.csv`` and ``residual_unbalance.csv`` (kg m), without a row where the loss says nothing of them.

    Raises StorageError.
    """
    bad_points = _no_bad_points() if account is None else account.bad_points
    found = np.zeros(0, dtype=complex) if uncertainty is None else uncertainty.residual_unbalance
    columns = {
        "node": [] if uncertainty is None else uncertainty.planes,
        "magnitude": np.abs(found),
        "phase_deg": np.degrees(np.angle(found)),
        "magnitude_std": [] if uncertainty is None else uncertainty.unbalance_deviation(),
    }
    return [write_table(folder / "bad_points.csv", bad_points), write_table(folder / "residual_unbalance.csv", columns)]
