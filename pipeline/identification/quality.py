"""How well a fit explains its readings, be there a truth to compare with or not.

With the right model and the right noise the readings lie about the prediction by their noise: each complex one adds 1
to chi-square, less half of one for each number that was fitted, and neighbouring speeds deviate independently.

Legend: S speeds, P channels, R runs.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from pipeline.data.dataset import name_direction
from pipeline.data.sensors import FLOORS, NO_FLOOR
from pipeline.identification.identified import IdentifiedModel
from pipeline.identification.noise_estimate import autocorrelation, measure_whiteness
from pipeline.identification.output_error_fit import OutputErrorFit
from pipeline.identification.problem import OutputError
from pipeline.problem.condition_noise import NAMED
from pipeline.problem.identifiability import judge_identifiability
from pipeline.problem.measurement import Measurement

MISMATCH = 0.05
"""Deviations less probable than this speak against the model: of a right one, they do so in one of twenty data sets."""
FAR_FROM_EXPECTED = 3.0
"""Chi-square beyond so many times what is expected speaks against the model or the stated noise."""


@dataclass(frozen=True)
class Quality:
    """What a fit leaves over, by its own loss."""

    summary: Mapping[str, Any]  # part of metrics.json
    bad_points: tuple[Mapping[str, Any], ...] = ()  # readings far off, see list_bad_points
    inflation: float = 1.0  # of the variances, by the deviations' size and their correlation over the speed

    @property
    def misfit(self) -> float | None:
        """Chi-square over what is expected; None for a loss that knows of no noise."""
        square = self.summary.get("fit", {}).get("chi_square")
        return None if square is None else square["value"] / square["expected"]


def residual_quality(measurement: Measurement, identified: IdentifiedModel) -> Quality:
    """The residual over the bearing force, and the condition number of each bearing."""
    equations = measurement.equations
    impedance = identified.table(measurement.known).impedance(measurement.dataset.frequencies)
    size = np.abs(equations.free_residual).mean()
    reports = judge_identifiability(equations, measurement.residual, constant=False)
    return Quality(
        {
            "residual": {"mean_over_bearing_force": float(np.abs(equations.residual(impedance)).mean() / size)},
            "condition_number": {
                str(node): {"median": finite(np.median(report.condition)), "max": finite(report.condition.max())}
                for report in reports
                for node in report.nodes
            },
        }
    )


def finite(value: float) -> float | None:
    """JSON has no infinity."""
    return float(value) if np.isfinite(value) else None


def output_error_quality(fit: OutputErrorFit) -> Quality:
    """Chi-square, whiteness, held-out speeds and runs, and the readings far off."""
    plain, drift = _plain_deviations(fit), fit.problem.measurement.drift
    # What was not measured has a precision of zero.
    value, readings = (
        sum(float((np.abs(block) ** 2).sum()) for block in plain),
        sum(int((block != 0).sum()) for block in plain),
    )
    parameters = fit.problem.model_parameters(fit.weights)[0]
    # What the data do not tell of a weight its prior does: it takes no reading away.
    by_prior = np.einsum("zy,yz->z", fit.covariance(), fit.problem.prior.information.numpy())
    used = fit.problem.n_fitted - float(by_prior.sum())
    correlation, significance = autocorrelation(plain)
    bad = () if drift else list_bad_points(fit, plain)
    summary: dict[str, object] = {
        "chi_square": {"value": value, "expected": readings - used / 2, "readings": readings, "numbers": used},
        "whiteness": {
            "autocorrelation": correlation,
            "over_its_deviation": significance,
            "probability": measure_whiteness(plain),
        },
        "bad_points": len(bad),
    }
    if fit.problem.readings.correlation > 0:
        summary["noise_correlation"] = fit.problem.readings.correlation
    if drift:  # runs that are conditions of their own, and do not belong to the others
        runs = zip(fit.problem.measurement.dataset.runs, drift.weights, strict=True)
        summary["inconsistent_runs"] = [run for run, weight in runs if weight < NAMED]
    estimated = not np.allclose(fit.factor, 1.0)
    data = fit.problem.measurement.dataset
    # Complex readings of runs that repeat an earlier run of the same fit: at the same frequencies, as a block has.
    again = [runs[i] for runs in fit.problem.readings.runs for i, _ in data.find_repeats(runs)] if estimated else []
    repeated = int(data.present[:, again].sum()) * len(data.channels)
    # A guess of a law's number is no reading: that it was off speaks against nothing.
    told_before = by_prior[: fit.problem.places.numbers.stop].sum()
    # What repeats differ by is the noise itself: the rest is what the model leaves over.
    square = 2 * (value - repeated) + float(parameters.square().sum())
    freedom = 2 * (readings - repeated) + len(parameters) - fit.problem.n_fitted + told_before
    # With levels, the model's own error is common to all conditions: its size and order are no draws of a noise.
    sized = (not estimated or repeated > 0) and not drift
    summary["mismatch"] = mismatch(
        square if sized else None, freedom, np.nan if drift else significance, repeated if estimated else np.inf
    )
    summary |= {name: _held_out(fit, other) for name, other in fit.start.held_out.items()}
    if estimated:
        names = fit.start.measurement.dataset.channel_names
        summary["noise_factor"] = dict(zip(names, fit.factor.tolist(), strict=True))
        noise, size = fit.problem.measurement.noise, float(np.median(fit.factor))
        if not fit.problem.measurement.dataset.noise.any():
            # The constant part, of the channel whose floor is largest.
            largest = np.hypot([noise.additive, 0.0, 0.0], np.max(noise.floors or [NO_FLOOR], axis=0))
            floors = zip(FLOORS, (size * largest).tolist(), strict=True)
            parts = {key: scale * floor for (key, _, scale), floor in floors if floor}
            summary["noise"] = parts | {"multiplicative": size * noise.multiplicative}
    return Quality({"fit": summary}, bad, measure_inflation(summary, estimated and not repeated))


def measure_inflation(
    fit: Mapping[str, Any],
    estimated: bool,
    small: float = 1.5,
    significant: float = 1.645,
    strongest: float = 0.99,
) -> float:
    """How much larger the variances are than the fit says: by its deviations' size (Birge 1932) and their correlation.

    Correlated deviations of the stated size are noise that wanders; larger ones are a model that does not fit. Where
    the noise is ``estimated`` from the deviations themselves, their size is in it already.

    Windows of a run-up that overlap, and a model that is a little off, make neighbouring speeds deviate together: they
    then are worth fewer readings than they are, as the mean of a first-order autoregression says.

    Args:
        small: chi-square over what is expected, up to which what is left over is below the noise.
        significant: of a normal value, on one side, which 5 of 100 exceed.
        strongest: correlations count as this one at most.
    """
    square, whiteness = fit["chi_square"], fit["whiteness"]
    bounded = min(max(whiteness["autocorrelation"], 0.0), strongest)
    correlated = (1 + bounded) / (1 - bounded)  # 1 or more
    if estimated:
        return float(correlated)
    ratio = max(1.0, square["value"] / max(square["expected"], 1.0))
    white = whiteness["over_its_deviation"] < significant
    return float(ratio if white or ratio > small else ratio * correlated)


def mismatch(
    square: float | None, freedom: float, whiteness: float, repeated: float = np.inf
) -> dict[str, float | None]:
    """Probabilities of what was found, or of worse, if the model and the noise are right.

    Args:
        square: sum of the squared deviations of unit variance, those of the priors included; None where the noise was
            estimated from the deviations themselves, so that their size says nothing.
        freedom: how many there are, less the numbers fitted.
        whiteness: correlation of neighbouring speeds over its standard deviation.
        repeated: complex readings that the noise was estimated from; infinite where it is stated. A median of n
            exponential values is as good as the mean of 0.48 n.

    Returns:
        ``chi_square`` and ``whiteness``, each from its own distribution (chi-square, or F against repeats, and
        normal), and ``probability``: the smallest, times their number (Bonferroni), so that a right model comes below
        0.05 in at most 5 of 100 data sets.
    """
    from scipy.special import chdtrc, fdtrc, ndtr

    by_size = None
    if square is not None and np.isfinite(square) and freedom > 0:
        by_size = float(chdtrc(freedom, square))
        if np.isfinite(repeated):
            by_size = float(fdtrc(freedom, 2 * np.log(2.0) ** 2 * repeated, square / freedom))
    by_order = float(ndtr(-whiteness)) if np.isfinite(whiteness) else None
    every = [p for p in (by_size, by_order) if p is not None]
    probability = min(1.0, len(every) * min(every)) if every else None
    return {"chi_square": by_size, "whiteness": by_order, "probability": probability}


def _plain_deviations(fit: OutputErrorFit) -> list[np.ndarray]:
    """(S, P, R) of each block, in units of the readings' noise, complex, without Huber's shares.

    Noise in levels is estimated from the runs that belong to each other: the others are not among them.
    """
    drift = fit.problem.measurement.drift
    kept = np.flatnonzero(drift.weights >= NAMED) if drift else slice(None)
    import torch

    readings = fit.problem.readings
    roots = [torch.as_tensor(share).sqrt() for share in readings.shares]
    precision = tuple(every / root for every, root in zip(readings.precision, roots, strict=True))
    records = tuple(every / root for every, root in zip(readings.records, roots, strict=False))
    whole = replace(readings, precision=precision, records=records)
    with np.errstate(all="ignore"):  # of a fit that ran away
        every = replace(fit.problem, readings=whole).deviations(fit.weights)
        return [np.asarray(deviation[0].numpy())[..., kept] / np.sqrt(2.0) for deviation in every]


def _held_out(fit: OutputErrorFit, other: OutputError) -> dict[str, float | None]:
    """Readings that were not fitted: their mean square over the noise (1 where all is well), the error in percent.

    None where the coefficients leave all bounds there: functions that speeds do not hold may do anything.
    """
    other = other.update(fit.weights)
    measurement = replace(other.measurement, noise=fit.problem.measurement.noise)
    read = other.displacement(fit.weights)
    data = measurement.dataset
    with np.errstate(over="ignore", invalid="ignore"):
        noise = measurement.deviation_of(read, measurement.baseline, fit.factor)
        off = np.abs(read - data.displacement) ** 2 * data.present[:, None]
        square, error = (off / noise**2).sum() / data.n_readings, off.sum() / (np.abs(data.displacement) ** 2).sum()
    return {"mean_square_over_noise": finite(square), "error_percent": finite(100.0 * np.sqrt(error))}


def list_bad_points(
    fit: OutputErrorFit, plain: Sequence[np.ndarray], beyond: float = 4.0
) -> tuple[Mapping[str, Any], ...]:
    """Readings ``beyond`` so many deviations: of good ones, one in ten million.

    Each has its ``run``, ``speed`` (rad/s), ``node``, ``direction``, the ``deviations`` that it lies from the fit, and
    its ``operating`` conditions (SI) by name.
    """
    data = fit.problem.measurement.dataset
    return tuple(
        {
            "run": data.runs[runs[r]],
            "speed": float(data.speeds[s]),
            "node": data.channels[p][0],
            "direction": name_direction(data.channels[p][1]),
            "deviations": float(np.abs(off[s, p, r])),
            "operating": {name: float(values[s]) for name, values in data.operating.items()},
        }
        for runs, off in zip(fit.problem.readings.runs, plain, strict=True)
        for s, p, r in np.argwhere(np.abs(off) > beyond)
    )
