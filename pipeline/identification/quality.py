"""How well a fit explains its readings, be there a truth to compare with or not.

With the right model and the right noise the readings lie about the prediction by their noise: each complex one adds 1
to chi-square, less half of one for each number that was fitted, and neighbouring speeds deviate independently.

Legend: S speeds, P channels, R runs.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from pipeline.data.dataset import name_direction
from pipeline.identification.identified import IdentifiedModel
from pipeline.identification.output_error_fit import OutputErrorFit
from pipeline.identification.problem import OutputError
from pipeline.problem.condition_noise import NAMED
from pipeline.problem.measurement import Measurement
from pipeline.problem.residual import per_speed_least_squares

BAD_POINT = 4.0
"""Readings beyond so many deviations are listed: of good ones, one in ten million."""
MISMATCH = 0.05
"""Deviations less probable than this speak against the model: of a right one, they do so in one of twenty data sets."""
FAR_FROM_EXPECTED = 3.0
"""Chi-square beyond so many times what is expected speaks against the model or the stated noise."""


@dataclass(frozen=True)
class BadPoint:
    """A reading far off."""

    run: str
    speed: float  # rad/s
    node: int
    direction: str
    deviations: float  # how many standard deviations it lies from the fit
    operating: Mapping[str, float] = field(default_factory=dict)  # conditions, SI


@dataclass(frozen=True)
class Quality:
    """What a fit leaves over, by its own loss."""

    summary: Mapping[str, Any]  # part of metrics.json
    bad_points: tuple[BadPoint, ...] = field(default=())
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
    _, condition = per_speed_least_squares(measurement.residual)
    every = np.broadcast_to(condition, (len(equations.bearing_nodes), condition.shape[1]))
    return Quality(
        {
            "residual": {"mean_over_bearing_force": float(np.abs(equations.residual(impedance)).mean() / size)},
            "condition_number": {
                str(node): {"median": finite(np.median(c)), "max": finite(c.max())}
                for node, c in zip(equations.bearing_nodes, every, strict=True)
            },
        }
    )


def finite(value: float) -> float | None:
    """JSON has no infinity."""
    return float(value) if np.isfinite(value) else None


def output_error_quality(fit: OutputErrorFit) -> Quality:
    """Chi-square, whiteness, held-out speeds and runs, and the readings far off."""
    plain, inconsistent = _plain_deviations(fit), _list_inconsistent(fit)
    # What was not measured has a precision of zero.
    value, readings = chi_square(plain), sum(int((block != 0).sum()) for block in plain)
    parameters = fit.problem.model_parameters(fit.weights)[0]
    # What the data do not tell of a weight its prior does: it takes no reading away.
    by_prior = np.einsum("zy,yz->z", fit.covariance(), fit.problem.prior.information().numpy())
    used = fit.problem.n_fitted - float(by_prior.sum())
    correlation, significance = autocorrelation(plain)
    bad = () if fit.problem.measurement.drift else _bad_points(fit, plain)
    summary: dict[str, object] = {
        "chi_square": {"value": value, "expected": readings - used / 2, "readings": readings, "numbers": used},
        "whiteness": {"autocorrelation": correlation, "over_its_deviation": significance},
        "bad_points": len(bad),
    }
    if fit.problem.measurement.drift:
        summary["inconsistent_runs"] = inconsistent
    # With levels, the model's own error is common to all conditions: its size and order are no draws of a noise.
    levels = bool(fit.problem.measurement.drift)
    stated = np.allclose(fit.factor, 1.0) and not levels
    square = 2 * value + float(parameters.square().sum())
    # A guess of a law's number is no reading: that it was off speaks against nothing.
    told_before = by_prior[: fit.problem.places.numbers.stop].sum()
    freedom = 2 * readings + len(parameters) - fit.problem.n_fitted + told_before
    summary["mismatch"] = mismatch(square if stated else None, freedom, np.nan if levels else significance)
    summary |= {name: _held_out(fit, other) for name, other in fit.start.held_out.items()}
    if not np.allclose(fit.factor, 1.0):
        channels = fit.start.measurement.dataset.channels
        summary["noise_factor"] = {
            f"node {node} {name_direction(angle)}": float(f)
            for (node, angle), f in zip(channels, fit.factor, strict=True)
        }
    estimated = not np.allclose(fit.factor, 1.0)
    return Quality({"fit": summary}, bad, measure_inflation(summary, estimated))


def measure_inflation(fit: Mapping[str, Any], estimated: bool) -> float:
    """How much larger the variances are than the fit says: by its deviations' size (Birge 1932) and their correlation.

    Correlated deviations of the stated size are noise that wanders; larger ones are a model that does not fit. Where
    the noise is ``estimated``, their size is in it already.
    """
    square, whiteness = fit["chi_square"], fit["whiteness"]
    correlated = variance_inflation(whiteness["autocorrelation"])
    if estimated:
        return correlated
    ratio = max(1.0, square["value"] / max(square["expected"], 1.0))
    white = whiteness["over_its_deviation"] < _SIGNIFICANT
    return float(ratio if white or ratio > SMALL_MISFIT else ratio * correlated)


SMALL_MISFIT = 1.5
"""Chi-square over what is expected: what is left over is then below the noise, and the bands are wider by it."""
_SIGNIFICANT = 1.645
"""Deviations of a normal value, on one side, that 5 of 100 exceed."""


def mismatch(square: float | None, freedom: float, whiteness: float) -> dict[str, float | None]:
    """Probabilities of what was found, or of worse, if the model and the stated noise are right.

    Args:
        square: sum of the squared deviations of unit variance, those of the priors included; None where the noise was
            estimated from the deviations themselves, so that their size says nothing.
        freedom: how many there are, less the numbers fitted.
        whiteness: correlation of neighbouring speeds over its standard deviation.

    Returns:
        ``chi_square`` and ``whiteness``, each from its own distribution (chi-square and normal), and ``probability``:
        the smallest, times their number (Bonferroni), so that a right model comes below 0.05 in at most 5 of 100 data
        sets.
    """
    from scipy.stats import chi2, norm

    by_size = None if square is None or not np.isfinite(square) else float(chi2.sf(square, freedom))
    by_order = float(norm.sf(whiteness)) if np.isfinite(whiteness) else None
    every = [p for p in (by_size, by_order) if p is not None]
    probability = min(1.0, len(every) * min(every)) if every else None
    return {"chi_square": by_size, "whiteness": by_order, "probability": probability}


def _list_inconsistent(fit: OutputErrorFit) -> list[str]:
    """Runs that are conditions of their own, and do not belong to the others."""
    data, drift = fit.problem.measurement.dataset, fit.problem.measurement.drift
    return [run for run, w in zip(data.runs, drift.weights, strict=bool(drift)) if w < NAMED]


def _plain_deviations(fit: OutputErrorFit) -> list[np.ndarray]:
    """(S, P, R) of each block, in units of the readings' noise, complex, without Huber's shares.

    Noise in levels is estimated from the runs that belong to each other: the others are not among them.
    """
    drift = fit.problem.measurement.drift
    kept = np.flatnonzero(drift.weights >= NAMED) if drift else slice(None)
    import torch

    readings = fit.problem.readings
    pairs = zip(readings.precision, fit.shares, strict=True)
    whole = replace(readings, precision=tuple(every / torch.as_tensor(share).sqrt() for every, share in pairs))
    with np.errstate(all="ignore"):  # of a fit that ran away
        every = replace(fit.problem, readings=whole).deviations(fit.weights)
        return [np.asarray(deviation[0].numpy())[..., kept] / np.sqrt(2.0) for deviation in every]


def _held_out(fit: OutputErrorFit, other: OutputError) -> dict[str, float]:
    """Readings that were not fitted: their mean square over the noise (1 where all is well), the error in percent."""
    squares, errors, size = 0.0, 0.0, 0.0
    other = other.update(fit.weights)
    for b, predicted in enumerate(other.predicted(fit.weights)):
        measured, reached = other.readings.measured[b][0].numpy(), predicted[0].numpy()
        noise = other.readings.deviation(b, reached, fit.factor)
        off = np.abs(reached - measured) ** 2 * other.readings.present(b).numpy()
        squares += float((off / noise**2).sum())
        errors += float(off.sum())
        size += float((np.abs(measured) ** 2).sum())
    count = other.measurement.dataset.n_readings
    return {"mean_square_over_noise": squares / count, "error_percent": 100.0 * float(np.sqrt(errors / size))}


def _bad_points(fit: OutputErrorFit, plain: list[np.ndarray]) -> tuple[BadPoint, ...]:
    dataset, points = fit.problem.measurement.dataset, []
    for runs, off in zip(fit.problem.readings.runs, plain, strict=True):
        for s, p, r in np.argwhere(np.abs(off) > BAD_POINT):
            node, angle = dataset.channels[p]
            run, size = dataset.runs[runs[r]], float(np.abs(off[s, p, r]))
            beside = {name: float(values[s]) for name, values in dataset.operating.items()}
            points.append(BadPoint(run, float(dataset.speeds[s]), node, name_direction(angle), size, beside))
    return tuple(points)


def chi_square(deviations: Sequence[np.ndarray]) -> float:
    """Sum of the squared deviations over their root mean square, complex."""
    return float(sum((np.abs(d) ** 2).sum() for d in deviations))


def autocorrelation(deviations: Sequence[np.ndarray]) -> tuple[float, float]:
    """Correlation of complex deviations (S, P, R) at neighbouring speeds, and that over its standard deviation.

    White deviations have a value about zero with the variance of one over twice the number of neighbours.
    """
    products = sum(float((d[:-1] * d[1:].conj()).real.sum()) for d in deviations)
    power = sum(float((np.abs(d) ** 2).sum()) for d in deviations)
    neighbours = sum(int(((d[:-1] != 0) & (d[1:] != 0)).sum()) for d in deviations)  # zero where nothing was measured
    if power == 0 or neighbours == 0:
        return 0.0, 0.0
    value = products / power
    return value, value * float(np.sqrt(2 * neighbours))


def variance_inflation(correlation: float) -> float:
    """How much larger the variance of a mean is where neighbours correlate (first-order autoregression); 1 or more.

    Windows of a run-up that overlap, and a model that is a little off, make neighbouring speeds deviate together: they
    then are worth fewer readings than they are.
    """
    bounded = min(max(correlation, 0.0), _STRONGEST)
    return (1 + bounded) / (1 - bounded)


_STRONGEST = 0.99
