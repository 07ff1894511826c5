"""What speaks for an answer and against it, gathered from the fit and its readings: never from modelled coefficients.

Legend: S speeds, P channels, R runs, B bearings. SI units.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from pipeline.data.operating import space_evenly
from pipeline.data.sensors import NOMINAL_95
from pipeline.identification.identified import IdentifiedModel
from pipeline.identification.uncertainty import Uncertainty
from pipeline.problem.measurement import Measurement
from pipeline.rotor.bearing_table import BearingTable
from pipeline.trust.linearised import LinearisedFit, linearise
from pipeline.trust.misfit import Misfit, measure_misfit
from pipeline.twin.prediction import find_shares


class Growth(NamedTuple):
    """The largest real part of an eigenvalue, 1/s, at the first speed at which it is told from zero, or of all speeds;
    positive is unstable."""

    largest_growth: float
    largest_growth_std: float
    unstable_from_rpm: float | None  # the lowest speed at which it is told from zero


@dataclass(frozen=True, eq=False, kw_only=True)
class Evidence:
    """Everything that a verdict rests on."""

    answer: BearingTable  # with deviations of noise, misfit and functions, and of tolerances
    by_fit: np.ndarray  # (B, S, 8) the same without tolerances, N/m and N s/m
    tolerances: Mapping[str, np.ndarray]  # kind -> (B, S, 8) of each kind of tolerances by itself
    moves: Mapping[
        str, tuple[np.ndarray, np.ndarray]
    ]  # run or probe left out -> (B, S, 8) move, and what noise explains
    fit: Mapping[str, Any]  # of training.json
    misfit: Misfit
    predicted: Mapping[str, float]  # run -> mean square error predicted from the other runs, over the noise
    superposed: Mapping[str, float]  # run -> mean square error by superposition of the others, over the noise
    priors: Mapping[str, float]  # model parameter -> value after the fit, in prior deviations
    departures: Mapping[str, float]  # coefficient -> how far it came from what known_within states, in its deviations
    growth: Growth
    lacking: tuple[float, str] | None  # a mode that the model lacks, rad/s, and the probes that show it, in words
    outcome: str  # of the training

    @property
    def band(self) -> np.ndarray:
        """(B, S, 8) half the 95 % interval."""
        return np.asarray(NOMINAL_95 * self.answer.spread)


def gather(
    measurement: Measurement,
    uncertainty: Uncertainty,
    fit: Mapping[str, Any],
    fitted: np.ndarray,
    outcome: str,
) -> tuple[Evidence, LinearisedFit]:
    """The evidence of a fit that weighs its readings by their noise.

    Args:
        measurement: at the fitted model parameters.
        fit: what ``training.json`` has under this name.
        fitted: (S, P, R) mask of the readings that were fitted.
    """
    names = measurement.dataset.channel_names
    factor = np.array([fit["noise_factor"][name] for name in names]) if "noise_factor" in fit else np.ones(len(names))
    linear = linearise(measurement, uncertainty, fitted, factor, fit.get("noise_correlation", 0.0))
    answer, unfitted = uncertainty.identified.table(measurement.updated_known), uncertainty.unfitted

    def deviate(covariance: np.ndarray) -> np.ndarray:
        spread = uncertainty.deviation(answer.speeds, answer.operating, covariance)
        lost = np.isnan(spread) & measurement.unknowns.identified[:, None]  # of coefficients that ran away
        return np.where(lost, np.inf, spread)

    runs, misfit = measurement.dataset.runs, measure_misfit(fit)
    used = [r for r in range(len(runs)) if fitted[..., r].any()]
    several, pairs = len(used) > 1, fitted.shape[1] > 2 * len(answer.nodes) - 1
    every_run = {f"run {runs[r]}": fitted & (np.arange(len(runs)) == r) for r in used if several}
    every_probe = {
        f"probe {name}": fitted & (np.arange(len(names)) == p)[:, None] for p, name in enumerate(names) if pairs
    }
    of_runs, of_probes = (
        {name: left for name, mask in masks.items() if (left := linear.leave_out(mask))}
        for masks in (every_run, every_probe)
    )
    return Evidence(
        answer=replace(answer, deviation=deviate(uncertainty.covariance), by="by this fit"),
        by_fit=deviate(uncertainty.without_tolerances),
        tolerances={name: deviate(unfitted.select(name).covariance()) for name in unfitted.names},
        moves={name: (move, explained) for name, (move, explained, _) in (of_runs | of_probes).items()},
        fit=fit,
        misfit=misfit,
        predicted={name.removeprefix("run "): square for name, (_, _, square) in of_runs.items()},
        superposed=compare_superposed(measurement, factor),
        priors=dict(
            zip((p.name for p in measurement.parameters), map(float, uncertainty.parameters.tolist()), strict=True)
        ),
        departures=find_departures(measurement, uncertainty.identified, answer),
        growth=find_growth(measurement, answer, uncertainty),
        lacking=None
        if misfit.explained()
        else find_missing_mode(measurement, answer, uncertainty.residual_unbalance, fitted),
        outcome=outcome,
    ), linear


def find_departures(measurement: Measurement, identified: IdentifiedModel, answer: BearingTable) -> dict[str, float]:
    """How far each coefficient came from what ``known_within`` states, in its deviations: by the mean over the speeds,
    as :attr:`OutputError.prior` counts it. Empty where it states nothing of the outputs.
    """
    guess, unknowns = measurement.guess, measurement.unknowns
    if not guess.within or measurement.laws or identified.model.parametrisation == "impedance":
        return {}
    over = unknowns.leading(answer.values) / guess.sizes(unknowns)[:, None]
    logarithms = np.log(np.maximum(np.abs(over), np.finfo(float).tiny)) / np.log(guess.within)
    off = np.where(identified.model.positive, logarithms, over / guess.within).mean(axis=1)
    nodes, names = measurement.rotor.bearing_nodes, unknowns.names
    return {f"{names[u]} at node {nodes[m]}": float(off[m, u]) for m, u in unknowns.active}


def find_growth(
    measurement: Measurement,
    answer: BearingTable,
    uncertainty: Uncertainty,
    most_speeds: int = 40,
) -> Growth:
    """The growth of the identified machine, at ``most_speeds`` of its speeds."""
    from pipeline.data.vibration_files import to_rpm
    from pipeline.twin.mode_deviations import deviate_modes
    from pipeline.twin.modes import Stability, find_modes, judge_growth

    keep = space_evenly(len(answer.speeds), most_speeds)
    bearings, growing = answer.at(keep), measurement.select(keep)
    modes = find_modes(measurement.updated_rotor, bearings, count=0)  # the growth alone is asked
    deviation = deviate_modes(modes, growing, bearings, uncertainty).growth
    pairs = zip(modes.growth.tolist(), deviation.tolist(), strict=True)
    unstable = [s for s, pair in enumerate(pairs) if judge_growth(*pair) is Stability.UNSTABLE]
    s = unstable[0] if unstable else int(modes.growth.argmax())
    return Growth(modes.growth[s].item(), deviation[s].item(), to_rpm(bearings.speeds)[s].item() if unstable else None)


def find_missing_mode(
    measurement: Measurement,
    answer: BearingTable,
    unbalance: np.ndarray,
    fitted: np.ndarray,
    prominent: float = 3.0,
    apart: float = 0.1,
    most_damped: float = 2.0,
    fewest: int = 16,
) -> tuple[float, str] | None:
    """A mode that the readings show and the model lacks: its frequency in rad/s, and the probes that show it.

    What the fit leaves over, with its residual ``unbalance`` (N,), peaks there: ``prominent`` times as high as on
    either side, in all runs together, and lies ``apart``, a share of its frequency, from all modes of the identified
    machine of a logarithmic decrement below ``most_damped``. Runs of fewer than ``fewest`` speeds are not asked.
    """
    from scipy.signal import find_peaks

    from pipeline.twin.modes import find_modes

    data, asked = measurement.dataset, np.asarray(np.any(fitted, axis=1))  # (S, R)
    runs = [r for r in range(len(data.runs)) if asked[:, r].sum() >= fewest]
    if not runs:
        return None
    left = np.abs(data.displacement - measurement.response.predict(answer, unbalance))
    lines = [data.frequencies[asked[:, r], r] for r in runs]
    grid = np.geomspace(min(w.min() for w in lines), max(w.max() for w in lines), 200)
    square = np.zeros((len(grid), len(data.channels)))
    for r, w in zip(runs, lines, strict=True):
        order = np.argsort(w)
        each = np.stack([np.interp(grid, w[order], column[order]) for column in left[asked[:, r], :, r].T], axis=1)
        square += (each / np.median(each)) ** 2
    height = np.log(np.column_stack([square.sum(axis=1), square])) / 2  # of all probes together, and of each
    modes = find_modes(measurement.updated_rotor, answer, count=12)
    ringing = np.where(modes.logarithmic_decrement < most_damped, modes.frequency, np.inf)
    peaks, shape = find_peaks(height[:, 0], prominence=np.log(prominent))
    has = [ringing[np.abs(answer.speeds - w).argmin()] for w in grid[peaks]]  # at the speed nearest to each peak
    lacking = [k for k, w in enumerate(grid[peaks]) if np.nanmin(np.abs(has[k] / w - 1), initial=np.inf) > apart]
    if not lacking:
        return None
    at = int(peaks[max(lacking, key=lambda k: float(shape["prominences"][k]))])
    names, near = data.channel_names, np.abs(grid / grid[at] - 1) < 2 * apart
    rises = np.ptp(height[near, 1:], axis=0)
    shown = [name for name, rise in zip(names, rises, strict=True) if rise > np.log(prominent)]
    return float(grid[at]), "all probes" if len(shown) == len(names) else ", ".join(shown)


def compare_superposed(measurement: Measurement, factor: np.ndarray) -> dict[str, float]:
    """Run -> mean square of what superposition of the others leaves over, over its noise; runs with an answer alone.

    Weights are those that the fit found. No bearing model is in it: 1 is a linear machine with right weights.
    """
    data = measurement.as_stated().dataset
    noise = measurement.deviation_of(data.displacement, measurement.baseline, factor)
    free = bool(measurement.unknowns.planes) or any(parameter.kind == "bow" for parameter in measurement.parameters)
    whole = data.present.all(axis=1)  # points that every run was measured at
    squares = {}
    for r, run in enumerate(data.runs):
        others = [o for o in range(len(data.runs)) if o != r]
        shares = find_shares(data, others, data.excitation_of(r), data.frequencies[:, r], free)
        if shares is not None and whole.any():
            variance = noise**2 @ np.abs(shares) ** 2 + noise[..., r] ** 2
            off = np.abs(data.displacement @ shares - data.displacement[..., r]) ** 2 / variance
            squares[run] = float(off[whole].mean())
    return squares
