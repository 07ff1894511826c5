"""Vibration that training never saw, from identified and modelled coefficients (paper, Figure 6) and without them.

Without a bearing model there are superposition of the runs and interpolation over the speed. A linear machine answers a
sum of excitations by the sum of its answers. An excitation in the span of the measured runs is predicted at the probes
by influence coefficients alone (as in balancing), whatever the bearings are; a model earns its place where that has no
answer: a plane without a run, a node without a probe, a speed that was not run.

Legend: S speeds, P channels, R runs.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from pipeline.config.identification import TrainingConfig
from pipeline.data.dataset import DIRECTIONS, Excitation, VibrationDataset
from pipeline.data.operating import name_state, split_states
from pipeline.data.simulate import solve_response
from pipeline.data.vibration_files import write_range
from pipeline.identification.held_out import held_out_conditions, held_out_range, held_out_runs, held_out_speeds
from pipeline.identification.quality import finite
from pipeline.identification.readings import read_answer
from pipeline.identification.uncertainty import Uncertainty
from pipeline.problem.measurement import Measurement
from pipeline.problem.reference_response import SolvedRotor
from pipeline.problem.response import derive_by_parameters, respond
from pipeline.problem.slopes import deviate
from pipeline.rotor.bearing_table import BearingTable
from pipeline.rotor.model import TRANSLATIONS, RotorModel, translation_dof


@dataclass(frozen=True, eq=False)
class PredictedVibration:
    """Displacement of one node over speed, complex zero-to-peak amplitudes of q(t) = Re(Q e^{jwt})."""

    node: int
    speeds: np.ndarray  # (S,) rad/s
    frequencies: np.ndarray  # (S,) rad/s of the vibration; those of an unbalance are the speeds
    displacement: np.ndarray  # (S, 2) complex, m, of x and y
    deviation: np.ndarray | None = None  # (S, 2) standard deviation of the amplitude, m, where it is known

    def error_percent(self, reference: PredictedVibration) -> np.ndarray:
        """(S, 2) |Q - Q_reference| / |Q_reference| in percent: amplitude and phase together."""
        return 100.0 * np.abs(self.displacement - reference.displacement) / np.abs(reference.displacement)


def predict(
    rotor: RotorModel,
    bearings: BearingTable,
    unbalances: tuple[Excitation, ...],
    node: int,
    frequencies: Sequence[float] | np.ndarray = (),
) -> PredictedVibration:
    """The response of ``node`` to ``unbalances`` (one run) at the speeds of ``bearings``; to forces at ``frequencies``
    (S,) rad/s of their own."""
    runs, w = (unbalances[0].run,), np.asarray(frequencies) if len(frequencies) else bearings.speeds
    response = solve_response(rotor, bearings, unbalances, runs, w[:, None])
    places = [translation_dof(node, direction) for direction in range(TRANSLATIONS)]
    return PredictedVibration(node, bearings.speeds, w, response[:, places, 0])


def add_deviation(
    predicted: PredictedVibration,
    measurement: Measurement,
    bearings: BearingTable,
    unbalances: tuple[Excitation, ...],
    uncertainty: Uncertainty,
) -> PredictedVibration:
    """The same with the deviation that the covariance of coefficients and model parameters implies, to first order.

    ``measurement`` is at the fitted model parameters. The prediction has no probes, and its weights are exact.
    """
    channels = tuple((predicted.node, angle) for angle in DIRECTIONS.values())
    runs = (unbalances[0].run,)
    shown, w = predicted.displacement[..., None], predicted.frequencies[:, None]
    dataset = VibrationDataset(bearings.speeds, runs, channels, shown, unbalances, w)
    stiffness = float(np.median(np.abs(bearings.values[..., 0])))
    # With exact probes and weights and a straight shaft: no probe shows this vibration.
    parameters = tuple(
        parameter if parameter.row.scope == "machine" else replace(parameter, deviation=0.0, place=0)
        for parameter in measurement.parameters
    )
    solved = SolvedRotor(measurement.rotor, dataset, stiffness, parameters=parameters)
    equations = solved.response
    by_coefficient = equations.sensitivity(bearings)[:, :, 0]  # (S, 2, B, 8)
    by_number = uncertainty.sensitivity(bearings.speeds, bearings.operating)  # (B, S, 8, A (K + L))
    slopes = np.einsum("sdbc,bscz->sdz", by_coefficient, by_number)
    for variation in solved.variations:  # of the one run; none without parameters
        change = equations.change(bearings, equations.blocks[0])
        response = respond(equations.blocks[0], change)
        by_model = derive_by_parameters(variation, response, change[None], None)[0, :, :, 0]  # (S, 2, T)
        by_model = by_model + np.einsum("sdbc,sbct->sdt", by_coefficient, measurement.known_variation)
        slopes = np.concatenate([slopes, by_model], axis=-1)
    direction = predicted.displacement.conj() / np.maximum(np.abs(predicted.displacement), np.finfo(float).tiny)
    in_phase = (direction[..., None] * slopes).real
    return replace(predicted, deviation=deviate(in_phase, uncertainty.machine_covariance))


def sample_motion(
    displacement: np.ndarray, speed: float, turns: float = 2.0, points: int = 400
) -> tuple[np.ndarray, np.ndarray]:
    """Times (T,) in s and displacements (T, 2) in m of x and y at ``speed`` (rad/s), from amplitudes (2,)."""
    time = np.linspace(0.0, turns * 2.0 * np.pi / speed, points)
    return time, np.real(displacement[None, :] * np.exp(1j * speed * time)[:, None])


# --- without a bearing model ----------------------------------------------------------------------


def find_shares(
    dataset: VibrationDataset,
    runs: Sequence[int],
    wanted: Sequence[Excitation],
    frequencies: np.ndarray,
    residual_unbalance: bool,
    within: float = 1e-9,
) -> np.ndarray | None:
    """(R,) complex, by how much each of the ``runs`` (indices) is in the ``wanted`` excitation.

    So much of their responses is its response. ``frequencies`` (S,) rad/s are those of the excitation. With a
    ``residual_unbalance``, which acts in every run, the shares must add up to 1. None where no sum of the runs is the
    excitation, of which a share ``within`` may be left over.
    """
    same = [r for r in runs if np.allclose(dataset.frequencies[:, r], frequencies, rtol=1e-9)]
    if not same:
        return None
    seen = [_amplitudes(dataset.excitation_of(r)) for r in same]
    aim = _amplitudes([replace(weight, run="") for weight in wanted])
    keys = list(dict.fromkeys(key for shares in (*seen, aim) for key in shares))
    matrix = np.array([[shares.get(key, 0.0) for shares in seen] for key in keys]).reshape(len(keys), len(same))
    right = np.array([aim.get(key, 0.0) for key in keys])
    size = np.array([max(abs(aim.get(key, 0.0)), *(abs(shares.get(key, 0.0)) for shares in seen)) for key in keys])
    matrix, right = matrix / size[:, None], right / size
    if residual_unbalance:
        matrix, right = np.concatenate([matrix, np.ones((1, len(same)))]), np.append(right, 1.0)
    shares = np.linalg.lstsq(matrix, right, rcond=None)[0]
    if np.linalg.norm(matrix @ shares - right) > within * np.linalg.norm(right):
        return None
    every = np.zeros(len(dataset.runs), dtype=complex)
    every[same] = shares
    return every


def _amplitudes(excitations: Sequence[Excitation]) -> dict[tuple[str, int, str], complex]:
    """Kind, node and whirl -> complex amplitude, kg m or N."""
    result: dict[tuple[str, int, str], complex] = {}
    for excitation in excitations:
        key = (excitation.kind, excitation.node, excitation.whirl)
        result[key] = result.get(key, 0.0) + excitation.magnitude * np.exp(1j * excitation.phase)
    return result


def interpolate_response(dataset: VibrationDataset, seen: np.ndarray) -> np.ndarray | None:
    """(S', P, R) complex, m: the readings at the points that ``seen`` (S,) leaves out, by cubic splines over the speed
    through the others of the same state; None where one of them lies outside the others, or a run is missing.
    """
    from scipy.interpolate import CubicSpline

    if not dataset.complete:
        return None
    drawn = np.zeros_like(dataset.displacement)
    for _, points in split_states(dataset.speeds, dataset.operating):
        known, asked = points[seen[points]], points[~seen[points]]
        if not len(asked):
            continue
        speeds = dataset.speeds
        if len(known) < 2 or speeds[asked[0]] < speeds[known[0]] or speeds[asked[-1]] > speeds[known[-1]]:
            return None
        drawn[asked] = CubicSpline(speeds[known], dataset.displacement[known])(speeds[asked])
    return None if seen.all() else drawn[~seen]


def compare_held_out(
    measurement: Measurement, bearings: BearingTable, unbalance: np.ndarray | None, training: TrainingConfig
) -> dict[str, dict[str, Any]]:
    """What no fit saw, by its name, as ``metrics.json`` has it: what the model makes of it, and a rival without one.

    ``model_error_percent`` is None where the coefficients leave all bounds. The ``rival`` is that of influence
    coefficients for a run, and interpolation of the fitted runs for speeds; its error is None where it has no answer.
    ``measurement`` is at the fitted model parameters, ``bearings`` and the residual ``unbalance`` (N,) kg m are fitted.
    """
    dataset = measurement.dataset
    predicted = np.where(dataset.present[:, None], read_answer(measurement, bearings, unbalance), 0.0)
    measured, out = dataset.displacement, held_out_runs(measurement, training)
    fitted = np.setdiff1d(np.arange(len(dataset.runs)), out)
    compared = {}
    for r in out:
        acting, planes = dataset.excitation_of(int(r)), measurement.unknowns.planes
        shares = find_shares(dataset, fitted.tolist(), acting, dataset.frequencies[:, r], bool(planes))
        beside = dataset.present[:, r] & dataset.present[:, fitted].all(axis=1)
        told = shares is not None and beside.any()
        error = error_percent((measured @ shares)[beside], measured[beside, :, r]) if told else None
        model = _model_error(predicted[..., r], measured[..., r])
        rival = {"rival": "influence coefficients", "rival_error_percent": error}
        compared[f"run {dataset.runs[r]}"] = {"model_error_percent": model, **rival}
    every = held_out_speeds(len(dataset.speeds), training.holdout_every)
    together = held_out_range(dataset.speeds, training)
    away = held_out_conditions(dataset.operating, training, len(dataset.speeds))
    known = ~every & ~together & ~away
    for mask, kind in ((every & ~together & ~away, ""), (together & ~away, "range of "), (away, "")):
        if not mask.any():
            continue
        whole, aim, left = mask is away, measured[mask][..., fitted], known | mask
        drawn = None if whole else interpolate_response(dataset.at(left).of_runs(fitted), known[left])
        error = None if drawn is None else error_percent(drawn, aim)
        model = _model_error(predicted[mask][..., fitted], aim)
        what = f"{kind}speeds, {write_range(dataset.speeds[mask])}"
        if whole:
            what = f"conditions, {name_state({name: values[away] for name, values in dataset.operating.items()})}"
        compared[what] = {"model_error_percent": model, "rival": "interpolation", "rival_error_percent": error}
    return compared


def error_percent(predicted: np.ndarray, measured: np.ndarray) -> float:
    """Root mean square of the difference over that of the measurement."""
    return float(100 * np.linalg.norm(predicted - measured) / np.linalg.norm(measured))


def _model_error(predicted: np.ndarray, measured: np.ndarray) -> float | None:
    """:func:`error_percent`; None where no number was predicted."""
    with np.errstate(over="ignore", invalid="ignore"):
        return finite(error_percent(predicted, measured))
