"""How well a model predicts conditions that it has not seen, and reads their weights from their vibration.

The forward error is that of the response, a record less the baseline condition at the same speed: its norm over the
channels over the response's, a record at a time; the median in a condition, then over conditions. R^2 is that of all
real and imaginary parts about their means.

Legend: C conditions, R records, S speeds, P channels, N planes, D = S P.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pipeline.balance.influence import design_of
from pipeline.balance.linear_vibration import LinearVibration
from pipeline.balance.unbalance import estimate_unbalance
from pipeline.data.conditions import Conditions

LOADED = 6e-6
"""kg m from which on a plane counts as loaded."""
PHASED = 24e-6
"""kg m from which on the angle of a weight is scored."""
_TOLERANCE = 1e-9
_DRAWS = 400
_ALIKE = 12


@dataclass(frozen=True, eq=False)
class Forward:
    """Predicted records of tested conditions."""

    names: tuple[str, ...]  # R, the condition of each record
    response: np.ndarray  # (R, S, P) complex, m: measured, less the baseline condition
    error: np.ndarray  # (R, S, P): predicted less measured
    half_width: np.ndarray  # (R, S, P) of the 95 % interval of a record's parts, m


@dataclass(frozen=True, eq=False)
class Inverse:
    """Weights read from the vibration of tested conditions."""

    names: tuple[str, ...]  # C
    true: np.ndarray  # (C, N) complex, kg m
    read: np.ndarray  # (C, N)
    half_width: np.ndarray  # (C, N) of the 95 % interval of the parts, kg m
    magnitude: np.ndarray  # (C, N, 2) interval, kg m
    angle: np.ndarray  # (C, N) half of the interval, rad


def predict_records(
    model: LinearVibration, tested: Conditions, records: Sequence[np.ndarray], baseline: np.ndarray
) -> Forward:
    """``records`` are those of each tested condition, (records, S, P) m; ``baseline`` (S, P) m is the mean of the
    condition that the response is counted from."""
    shape = tested.displacement.shape[1:]
    mean, noise = model.predict(tested.unbalance)
    variance = np.einsum("cii->ci", noise + model.noise.covariance(np.ones(len(mean)))).real
    width = model.noise.half_width(variance)
    counts, measured = [len(record) for record in records], np.concatenate(records)
    return Forward(
        tuple(np.repeat(np.array(tested.names, dtype=object), counts)),
        measured - baseline,
        np.repeat(mean.reshape(-1, *shape), counts, axis=0) - measured,
        np.repeat(width.reshape(-1, *shape), counts, axis=0),
    )


def read_weights(model: LinearVibration, tested: Conditions) -> Inverse:
    """From the means of the conditions' records."""
    estimates = [
        estimate_unbalance(model, vector, int(count))
        for vector, count in zip(tested.vectors, tested.counts, strict=True)
    ]
    return Inverse(
        tested.names,
        tested.unbalance,
        np.array([estimate.value for estimate in estimates]),
        np.array([estimate.half_width() for estimate in estimates]),
        np.array([estimate.magnitude_interval() for estimate in estimates]),
        np.array([estimate.angle_half_width() for estimate in estimates]),
    )


def score_forward(parts: Sequence[Forward], without: Sequence[str] = ()) -> dict[str, float]:
    """Scores of all parts, ``without`` these conditions."""
    names = np.array([name for fold in parts for name in fold.names], dtype=object)
    kept = ~np.isin(names, list(without))
    response, error, width = (
        np.concatenate([getattr(fold, name) for fold in parts])[kept] for name in ("response", "error", "half_width")
    )
    names = names[kept]
    size = np.maximum(np.linalg.norm(response, axis=2), np.finfo(float).tiny)
    relative = np.linalg.norm(error, axis=2) / size  # (R, S)
    medians = [np.median(relative[names == name]) for name in dict.fromkeys(names)]
    inside = np.stack([abs(error.real) <= width, abs(error.imag) <= width])
    return {
        "median_relative_error": float(np.median(medians)),
        "r2": _r2(error, response),
        **({"coverage": float(inside.mean())} if np.isfinite(width).all() else {}),
        "conditions": len(medians),
    }


def score_inverse(parts: Sequence[Inverse], without: Sequence[str] = ()) -> dict[str, float]:
    """Scores of all parts, ``without`` these conditions; errors of loaded planes in kg m and degrees."""
    kept = ~np.isin(np.array([name for fold in parts for name in fold.names], dtype=object), list(without))
    true, read, width, magnitude, angle = (
        np.concatenate([getattr(fold, name) for fold in parts])[kept]
        for name in ("true", "read", "half_width", "magnitude", "angle")
    )
    loaded, phased = (abs(true) >= limit * (1 - _TOLERANCE) for limit in (LOADED, PHASED))
    some = abs(true) > 0
    turned = abs(np.angle(read / np.where(some, true, 1)))
    error = read - true
    inside = np.stack([abs(error.real) <= width, abs(error.imag) <= width])
    low, high = magnitude[..., 0], magnitude[..., 1]
    scores = {
        "magnitude_error": float(abs(abs(read) - abs(true))[loaded].mean()),
        "r2": _r2(error, true),
        "conditions": len(true),
    }
    if phased.any():
        scores["angle_error_deg"] = float(np.degrees(turned[phased].mean()))
    if np.isfinite(width).all():
        scores["coverage"] = float(inside.mean())
        scores["magnitude_coverage"] = float(((low <= abs(true) * (1 + _TOLERANCE)) & (abs(true) <= high)).mean())
        scores["angle_coverage"] = float((turned <= angle)[some].mean())
    return scores


def _r2(error: np.ndarray, values: np.ndarray) -> float:
    return float(1 - (abs(error) ** 2).sum() / (abs(values - values.mean(0)) ** 2).sum())


def floor_of_drift(
    kept: Conditions,
    residual: np.ndarray,
    tested: Conditions,
    baseline: np.ndarray,
    rng: np.random.Generator,
    calibration: Conditions | None = None,
) -> dict[str, list[float]]:
    """What a model that is exactly right would score on conditions that drift: 5, 50 and 95 % of :data:`_DRAWS` draws.

    Drifts are those of the conditions ``kept``, ``residual`` (K, D) m, corrected for the degrees of freedom of their
    fit; each tested one gets that of a condition with about as much weight, turned by an angle of its own. ``baseline``
    (S, P) m is that of the response. With a ``calibration``, of as many conditions as there are influence coefficients,
    the predictions carry its drift, too.
    """
    response = tested.displacement - baseline
    levers = None
    if calibration is not None:
        levers = design_of(tested.unbalance) @ np.linalg.inv(design_of(calibration.unbalance))
    total = abs(kept.unbalance).sum(1)
    errors, r2 = [], []
    for _ in range(_DRAWS):
        error = _draw(residual, total, tested, rng)
        if calibration is not None:
            error = error - levers @ _draw(residual, total, calibration, rng)
        error = error.reshape(response.shape)
        errors.append(np.median(np.linalg.norm(error, axis=2) / np.linalg.norm(response, axis=2)))
        r2.append(_r2(error, response))
    quantiles = (0.05, 0.5, 0.95)
    return {
        "median_relative_error": [float(q) for q in np.quantile(errors, quantiles)],
        "r2": [float(q) for q in np.quantile(r2, quantiles)],
    }


def _draw(residual: np.ndarray, total: np.ndarray, conditions: Conditions, rng: np.random.Generator) -> np.ndarray:
    """(C, D) m drifts for conditions, from those of the :data:`_ALIKE` whose ``total`` weight (K,) is nearest."""
    near = np.argsort(abs(total - abs(conditions.unbalance).sum(1)[:, None]), axis=1)[:, :_ALIKE]
    chosen = near[np.arange(len(near)), rng.integers(near.shape[1], size=len(near))]
    return np.asarray(residual[chosen] * np.exp(2j * np.pi * rng.random((len(near), 1))))
