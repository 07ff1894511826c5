"""What speaks for an answer and against it, gathered from the fit and its readings: never from modelled coefficients.

Legend: S speeds, P channels, R runs, B bearings. SI units.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from pipeline.data.noise import NOMINAL_95
from pipeline.identification.identified import IdentifiedModel
from pipeline.identification.uncertainty import Uncertainty
from pipeline.problem.measurement import Measurement
from pipeline.rotor.bearing_table import BearingTable
from pipeline.trust.linearised import LinearisedFit, linearise, name_channels
from pipeline.twin.superposition import superpose_with_noise


@dataclass(frozen=True, eq=False, kw_only=True)
class Evidence:
    """Everything that a verdict rests on."""

    answer: BearingTable
    identified: np.ndarray  # (B, 8) mask of the coefficients that were identified
    deviation: np.ndarray  # (B, S, 8) of the answer, N/m and N s/m: of noise, misfit and functions, and of tolerances
    by_fit: np.ndarray  # (B, S, 8) the same without tolerances
    tolerances: Mapping[str, np.ndarray]  # kind -> (B, S, 8) of each kind of tolerances by itself
    moves: Mapping[
        str, tuple[np.ndarray, np.ndarray]
    ]  # run or probe left out -> (B, S, 8) move, and what noise explains
    fit: Mapping[str, Any]  # of training.json
    estimated_noise: bool
    ljung_box: float | None  # probability of such residuals over the speed if they are white
    predicted: Mapping[str, float]  # run -> mean square error predicted from the other runs, over the noise
    superposed: Mapping[str, float]  # run -> mean square error by superposition of the others, over the noise
    priors: Mapping[str, tuple[float, float]]  # model parameter -> value and deviation after the fit, in prior ones
    growth: float  # largest real part of an eigenvalue, 1/s; positive is unstable
    unstable_rpm: float | None  # the lowest speed at which it is
    outcome: str  # of the training

    @property
    def band(self) -> np.ndarray:
        """(B, S, 8) half the 95 % interval."""
        return np.asarray(NOMINAL_95 * self.deviation)

    @property
    def misfit(self) -> float:
        """Chi-square over what is expected of it."""
        square = self.fit["chi_square"]
        return float(square["value"] / max(square["expected"], 1.0))

    @property
    def noise_factor(self) -> float:
        """Noise that the fit found over the stated one, median over the channels; 1 where it is not estimated."""
        return float(np.median(list(self.fit.get("noise_factor", {"": 1.0}).values())))

    @property
    def misfit_of_stated_noise(self) -> float:
        """Mean square of what the fit leaves over, over the stated noise."""
        return self.misfit * self.noise_factor**2


def gather(
    measurement: Measurement,
    identified: IdentifiedModel,
    uncertainty: Uncertainty,
    fit: Mapping[str, Any],
    fitted: np.ndarray,
    estimated_noise: bool,
    outcome: str,
) -> tuple[Evidence, LinearisedFit]:
    """The evidence of a fit that weighs its readings by their noise.

    Args:
        measurement: at the fitted model parameters.
        fit: what ``training.json`` has under this name.
        fitted: (S, P, R) mask of the readings that were fitted.
    """
    names = name_channels(measurement)
    factor = np.array([fit.get("noise_factor", {}).get(name, 1.0) for name in names])
    linear = linearise(measurement, identified, uncertainty, fitted, factor)
    answer = identified.table(measurement.updated_known)
    growth, unstable = find_growth(measurement, answer)
    unfitted = uncertainty.unfitted

    def deviate(covariance: np.ndarray | None = None) -> np.ndarray:
        return uncertainty.deviation(identified, answer.speeds, answer.operating, covariance)

    runs = measurement.dataset.runs
    used = [r for r in range(len(runs)) if fitted[..., r].any()]
    several, pairs = len(used) > 1, fitted.shape[1] > 2 * len(answer.nodes) - 1
    masks = {f"run {runs[r]}": _of_run(fitted, r) for r in used if several}
    return Evidence(
        answer=answer,
        identified=measurement.unknowns.identified,
        deviation=deviate(),
        by_fit=deviate(uncertainty.without_tolerances),
        tolerances={name: deviate(unfitted.select(name).covariance()) for name in unfitted.names},
        moves={
            name: linear.leave_out(mask)
            for name, mask in (
                masks | {f"probe {n}": _of_probe(fitted, p) for p, n in enumerate(names) if pairs}
            ).items()
        },
        fit=fit,
        estimated_noise=estimated_noise,
        ljung_box=ljung_box(linear.residual, fitted),
        predicted={name.removeprefix("run "): linear.predict_without(mask) for name, mask in masks.items()},
        superposed=compare_superposed(measurement, factor),
        priors=_list_priors(measurement, uncertainty),
        growth=growth,
        unstable_rpm=unstable,
        outcome=outcome,
    ), linear


def _of_run(fitted: np.ndarray, run: int) -> np.ndarray:
    mask = np.zeros_like(fitted)
    mask[..., run] = fitted[..., run]
    return mask


def _of_probe(fitted: np.ndarray, probe: int) -> np.ndarray:
    mask = np.zeros_like(fitted)
    mask[:, probe] = fitted[:, probe]
    return mask


def find_growth(measurement: Measurement, answer: BearingTable) -> tuple[float, float | None]:
    """Largest growth of the identified machine, 1/s, and the lowest speed (rpm) at which it is unstable, if any."""
    from pipeline.data.vibration_files import to_rpm
    from pipeline.twin.modes import find_modes

    keep = np.unique(np.linspace(0, len(answer.speeds) - 1, _MOST_SPEEDS).round().astype(int))
    growth = find_modes(measurement.updated_rotor, answer.at(keep)).growth
    unstable = to_rpm(answer.speeds[keep])[growth > 0]
    return float(growth.max()), float(unstable[0]) if len(unstable) else None


_MOST_SPEEDS = 40


def ljung_box(residual: np.ndarray, fitted: np.ndarray) -> float | None:
    """Probability of the autocorrelations over the speed, or of larger ones, if the residuals are white.

    ``n (n + 2) sum_k r_k^2 / (n - k)`` of real and imaginary part of each channel and run, up to the lag min(10,
    n / 5), is chi-square (Ljung and Box 1978, Biometrika 65). Sums of independent series add.
    """
    from scipy.stats import chi2

    total, freedom = 0.0, 0
    for p, r in np.ndindex(residual.shape[1:]):
        series = residual[fitted[:, p, r], p, r]
        n = len(series)
        lags = min(10, n // 5)
        if lags < 1:
            continue
        for component in (series.real, series.imag):
            centred = component - component.mean()
            power = float(centred @ centred)
            if power > 0:
                shares = [float(centred[k:] @ centred[:-k]) / power for k in range(1, lags + 1)]
                total += n * (n + 2) * sum(share**2 / (n - k) for k, share in enumerate(shares, 1))
                freedom += lags
    return float(chi2.sf(total, freedom)) if freedom else None


def compare_superposed(measurement: Measurement, factor: np.ndarray) -> dict[str, float]:
    """Run -> mean square of what superposition of the others leaves over, over its noise; runs with an answer alone.

    Weights are those that the fit found. No bearing model is in it: 1 is a linear machine with right weights.
    """
    from pipeline.problem.force_parameters import update_excitations

    data = measurement.dataset
    if measurement.parameters:
        data = update_excitations(data, measurement.parameters, measurement.parameter_values)
    noise = measurement.deviation_of(data.displacement, measurement.baseline, factor)
    free = bool(measurement.unknowns.planes) or any(parameter.kind == "bow" for parameter in measurement.parameters)
    whole = data.present.all(axis=1)  # points that every run was measured at
    squares = {}
    for r, run in enumerate(data.runs):
        others = [o for o in range(len(data.runs)) if o != r]
        told = superpose_with_noise(data, others, data.excitation_of(r), data.frequencies[:, r], free, noise)
        if told is not None:
            summed, spread = told
            off = np.abs(summed - data.displacement[..., r]) ** 2 / (spread**2 + noise[..., r] ** 2)
            if off[whole].size:
                squares[run] = float(off[whole].mean())
    return squares


def _list_priors(measurement: Measurement, uncertainty: Uncertainty) -> dict[str, tuple[float, float]]:
    spread: Sequence[float] = uncertainty.parameter_deviation().tolist()
    every = zip(measurement.parameters, uncertainty.parameters.tolist(), spread, strict=True)
    return {parameter.name: (value, deviation) for parameter, value, deviation in every}
