"""What can be predicted without a bearing model: superposition of the runs, and interpolation over the speed.

A linear machine answers a sum of excitations by the sum of its answers. An excitation in the span of the measured runs
is predicted at the probes by influence coefficients alone (as in balancing), whatever the bearings are; a model earns
its place where that has no answer: a plane without a run, a node without a probe, a speed that was not run.

Legend: S speeds, P channels, R runs.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from pipeline.config.identification import TrainingConfig
from pipeline.data.dataset import Excitation, VibrationDataset
from pipeline.data.operating import name_state, split_states
from pipeline.identification.held_out import held_out_conditions, held_out_range, held_out_runs, held_out_speeds
from pipeline.identification.quality import finite
from pipeline.problem.measurement import Measurement
from pipeline.rotor.bearing_table import BearingTable


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


@dataclass(frozen=True)
class HeldOut:
    """A run, or speeds, that no fit saw: what the model and what a method without one make of it, in percent."""

    run: str | None  # None where speeds of all fitted runs were held out
    speeds: np.ndarray  # rad/s
    together: bool  # the speeds are a whole range, not one here and there
    model: float | None  # None where the coefficients leave all bounds
    rival: float | None  # of influence coefficients for a run, of interpolation for speeds; None without an answer
    state: str = ""  # the operating conditions that were held out as a whole


def compare_held_out(
    measurement: Measurement, bearings: BearingTable, unbalance: np.ndarray | None, training: TrainingConfig
) -> list[HeldOut]:
    """Each held-out run beside influence coefficients, held-out speeds beside interpolation of the fitted runs.

    ``measurement`` is at the fitted model parameters, ``bearings`` and the residual ``unbalance`` (N,) kg m are fitted.
    """
    dataset = measurement.dataset
    predicted = np.where(dataset.present[:, None], measurement.response.predict(bearings, unbalance), 0.0)
    measured, out = dataset.displacement, held_out_runs(measurement, training)
    fitted = np.setdiff1d(np.arange(len(dataset.runs)), out)
    compared = []
    for r in out:
        acting, planes = dataset.excitation_of(int(r)), measurement.unknowns.planes
        shares = find_shares(dataset, fitted.tolist(), acting, dataset.frequencies[:, r], bool(planes))
        beside = dataset.present[:, r] & dataset.present[:, fitted].all(axis=1)
        told = shares is not None and beside.any()
        error = error_percent((measured @ shares)[beside], measured[beside, :, r]) if told else None
        model = _model_error(predicted[..., r], measured[..., r])
        compared.append(HeldOut(dataset.runs[r], dataset.speeds, True, model, error))
    every = held_out_speeds(len(dataset.speeds), training.holdout_every)
    together = held_out_range(dataset.speeds, training)
    away = held_out_conditions(dataset.operating, training, len(dataset.speeds))
    known = ~every & ~together & ~away
    state = name_state({name: values[away] for name, values in dataset.operating.items()}) if away.any() else ""
    for mask in (every & ~together & ~away, together & ~away, away):
        if not mask.any():
            continue
        whole, aim, left = mask is away, measured[mask][..., fitted], known | mask
        drawn = None if whole else interpolate_response(dataset.at(left).of_runs(fitted), known[left])
        error = None if drawn is None else error_percent(drawn, aim)
        model = _model_error(predicted[mask][..., fitted], aim)
        in_a_row = whole or bool((mask & together).any())
        compared.append(HeldOut(None, dataset.speeds[mask], in_a_row, model, error, state if whole else ""))
    return compared


def error_percent(predicted: np.ndarray, measured: np.ndarray) -> float:
    """Root mean square of the difference over that of the measurement."""
    return float(100 * np.linalg.norm(predicted - measured) / np.linalg.norm(measured))


def _model_error(predicted: np.ndarray, measured: np.ndarray) -> float | None:
    """:func:`error_percent`; None where no number was predicted."""
    with np.errstate(over="ignore", invalid="ignore"):
        return finite(error_percent(predicted, measured))
