"""Influence coefficients with a baseline of their own, and with a law of the weights where the data ask for it.

A condition shows y = b + B z with z = U + a U |U|: one complex ``a`` says by how much a heavy weight does more or less
than in proportion, and by which angle. The fit is generalised least squares with the levels of
:mod:`pipeline.problem.noise_levels`, robust against single bad conditions. For a given ``a`` all entries of y have one
design, so that b and B need no covariance (Zellner 1962); ``a`` follows by Gauss-Newton from what the design leaves.

With heavy weights conditions may be less like each other than with light ones. The covariance of a condition is g N
with g = 1 + k sum |U_n|^2, N that of a condition without weights. One k is fitted by the likelihood of a multivariate
Student t, whose tail is fitted with it, so that a few gross conditions are not taken for growth. It is restricted by
the coefficients (REML, Patterson and Thompson 1971). Twice the gain in the logarithm of the likelihood is held against
a chi-square. Without growth, k is zero in half of all data, so that of many conditions the chance would be half of that
(Self and Liang 1987); the whole makes up for there being few.

Legend: C conditions, N planes, Q = 1 + N, D = S P (speeds times channels).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from pipeline.balance.linear_vibration import LinearVibration
from pipeline.data.conditions import Conditions
from pipeline.errors import DataError, IdentifiabilityError
from pipeline.problem.noise_levels import (
    FULL,
    NoiseLevels,
    estimate_noise_levels,
    fit_tail,
    leave_one_out,
    solve_weighted,
)


@dataclass(frozen=True, eq=False, kw_only=True)
class Influence(LinearVibration):
    """A fitted model y = b + B (U + a U |U|)."""

    coefficients: np.ndarray  # (Q, D) complex: the baseline, m, and the influence of each plane, m/(kg m)
    law: complex  # a, 1/(kg m); 0 for proportional weights
    spread: np.ndarray  # (Q, Q) complex: covariance of the coefficients, in units of the noise's
    shift: np.ndarray  # (Q, D) by which the coefficients move with the law, for each unit of a
    weights: np.ndarray  # (C,) of the conditions in the fit: small for a bad one, and where the drift is large
    growth: float  # of the covariance of conditions, 1/(kg m)^2; 0 where it is the same for all weights
    law_variance: float = 0.0  # of a, 1/(kg m)^2
    law_chance: float | None = None  # that proportional weights would look as curved; None where it was not asked
    growth_chance: float | None = None  # that drift without growth would show as much; None where it was not asked

    def predict(self, unbalance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Mean (C, D) m and its covariance (C, D, D) m^2 for weights (C, N) kg m.

        By how much more conditions with these weights drift than one without any is part of the covariance.
        """
        unbalance = np.atleast_2d(unbalance)
        design = design_of(unbalance, self.law)
        leverage = np.einsum("cq,qr,cr->c", design, self.spread, design.conj()).real
        grown = inflation(unbalance, self.growth) - 1
        covariance = leverage[:, None, None] * self.noise.covariance(np.ones(1))
        covariance = covariance + grown[:, None, None] * self.noise.condition
        if self.law_variance:
            bent = bend(unbalance) @ self.coefficients[1:] - design @ self.shift
            covariance = covariance + self.law_variance * bent[:, :, None] * bent[:, None].conj()
        return design @ self.coefficients, covariance

    def influence_at(self, unbalance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Derivative (D, N) m/(kg m) by the weights at ``unbalance`` (N,), and the baseline (D,) m."""
        return differentiate(self.coefficients, self.law, unbalance)


def bend(unbalance: np.ndarray) -> np.ndarray:
    """U |U|, (kg m)^2."""
    return np.asarray(unbalance * abs(unbalance))


def design_of(unbalance: np.ndarray, law: complex = 0.0) -> np.ndarray:
    """(C, Q) complex: ones, and the weights as they act."""
    return np.column_stack([np.ones(len(unbalance)), unbalance + law * bend(unbalance)])


def differentiate(rows: np.ndarray, law: complex, unbalance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Derivative (D, N) by the weights at ``unbalance`` (N,) and the baseline (D,), of ``rows`` (Q, D) of a design.

    A curved law is no analytic function: this is the part that turns with the weights; the other is smaller by the
    factor a |U| / 2.
    """
    return rows[1:].T * (1 + 1.5 * law * np.abs(np.asarray(unbalance))), rows[0]


def fit_influence(
    conditions: Conditions,
    law: bool | None = None,
    robust: bool = True,
    growth: float | None = None,
    evidence: float = 0.01,
) -> Influence:
    """Fit b, B and, where ``law`` is true, a; None takes the law where these conditions give evidence for it.

    ``growth`` is that of the drift with the weights, 1/(kg m)^2; None takes it where these give evidence for it.
    ``evidence`` is the chance with which proportional weights are taken for curved ones, and steady drift for one that
    grows with them. Raises IdentifiabilityError where there are fewer conditions than coefficients, or where the
    weights can't be told apart.
    """
    require_apart(conditions)
    fitted = _fit(conditions, 0.0, robust)
    if not judges(fitted):
        return fitted
    chosen = _choose(conditions, fitted, robust, law, evidence)
    if growth is None and chosen.noise.freedom >= FULL * len(chosen.noise.condition):
        growth, chance = fit_growth(
            conditions.vectors, design_of(conditions.unbalance, chosen.law), conditions.unbalance
        )
        growth = growth if chance < evidence else 0.0
        chosen = replace(chosen, growth_chance=chance)
    if growth:
        fitted = replace(_fit(conditions, 0.0, robust, growth), growth_chance=chosen.growth_chance)
        chosen = _choose(conditions, fitted, robust, law, evidence)
    size, noise = len(chosen.noise.condition), chosen.noise
    if noise.freedom < FULL * size:
        return chosen
    # The tail that the left-out conditions show, of which there are enough.
    tail, stretch = fit_tail(distances(conditions, chosen), size, noise.freedom)
    return replace(chosen, noise=replace(noise, tail=tail, stretch=stretch))


def require_apart(conditions: Conditions) -> None:
    """Raise IdentifiabilityError where these weights do not determine influence coefficients, and DataError where a
    condition was not read at every speed.
    """
    if not conditions.complete:
        raise DataError(
            "influence coefficients must come from conditions that were read at the same speeds, but some were not: "
            "leave these conditions or speeds out, or identify the machine (stage=train), which needs no common speeds"
        )
    design = design_of(conditions.unbalance)
    scale = abs(design).max(0)
    if np.linalg.matrix_rank(design / np.where(scale > 0, scale, 1)) < design.shape[1]:
        raise IdentifiabilityError(
            f"influence coefficients of {len(conditions.planes)} planes must come from conditions with weights that "
            f"differ in every plane, but {len(conditions.names)} conditions ({', '.join(conditions.names[:4])}) do not "
            "tell them apart: add a trial weight in each plane alone"
        )


def distances(conditions: Conditions, model: Influence) -> np.ndarray:
    """(C,) squared distances T^2 of the conditions of a fit from the model of the others."""
    design = design_of(conditions.unbalance, model.law)
    inflated = inflation(conditions.unbalance, model.growth)
    leverage = np.einsum("cq,qr,cr->c", design, model.spread, design.conj()).real / inflated
    left = float(len(design) - design.shape[1])
    residual = (conditions.vectors - design @ model.coefficients) / np.sqrt(inflated)[:, None]
    return leave_one_out(residual, leverage, model.weights * inflated, left)


def _choose(conditions: Conditions, fitted: Influence, robust: bool, law: bool | None, evidence: float) -> Influence:
    """The fit with a law of the weights where it is asked for or these conditions give evidence of it."""
    if law is False:
        return fitted
    curved = _bend(conditions, fitted, robust)
    if law or (curved.law_chance or 0.0) < evidence:
        return curved
    return replace(fitted, law_chance=curved.law_chance)


def judges(model: Influence) -> bool:
    """Whether the noise has degrees of freedom enough to judge by."""
    return model.noise.freedom > model.noise.condition.shape[0]


def _bend(conditions: Conditions, start: Influence, robust: bool, steps: int = 50) -> Influence:
    """The fit with a law of the weights, from the one without."""
    from scipy import stats

    model = start
    for _ in range(steps):
        step, variance = _step(conditions, model)
        model = _fit(conditions, model.law + step, robust, model.growth)
        if abs(step) ** 2 < 1e-6 * variance:
            break
    variance = _step(conditions, model)[1]
    size, free = len(model.noise.condition), model.noise.freedom
    left = free - size + 1
    chance = float(stats.f.sf(abs(model.law) ** 2 / variance * left / free, 2, 2 * left))
    bent = bend(conditions.unbalance) @ model.coefficients[1:]
    shift = solve_weighted(bent, design_of(conditions.unbalance, model.law), model.weights)
    return replace(model, law_variance=variance, law_chance=chance, shift=shift, growth_chance=start.growth_chance)


def _step(conditions: Conditions, model: Influence) -> tuple[complex, float]:
    """The Gauss-Newton step of a, and its variance."""
    design = design_of(conditions.unbalance, model.law)
    bent = bend(conditions.unbalance) @ model.coefficients[1:]
    projected = bent - design @ solve_weighted(bent, design, model.weights)
    residual = conditions.vectors - design @ model.coefficients
    whitened = np.linalg.solve(model.noise.covariance(conditions.counts), projected[..., None])[..., 0]  # (C, D)
    power = float((model.weights * (projected.conj() * whitened).sum(1).real).sum())
    return complex((model.weights * (whitened.conj() * residual).sum(1)).sum() / power), 1 / power


def _fit(conditions: Conditions, law: complex, robust: bool, growth: float = 0.0) -> Influence:
    """The fit with a given law of the weights and growth of the drift."""
    design = design_of(conditions.unbalance, law)
    if len(design) <= design.shape[1]:
        # Nothing tells the drift: all entries count alike, and no interval is finite.
        levels = equal_levels(conditions, float((abs(conditions.vectors) ** 2).mean()), 0.0)
        return solve_influence(conditions, levels, np.ones(len(design)), law, growth)
    # The scatter of records is divided with the drift: it is far smaller.
    inflated = inflation(conditions.unbalance, growth)
    root = 1 / np.sqrt(inflated)
    alike = replace(conditions, displacement=conditions.displacement * root[:, None, None])
    levels, weights = estimate_noise_levels(alike, design * root[:, None], robust=robust)
    return solve_influence(conditions, levels, weights / inflated, law, growth)


def equal_levels(conditions: Conditions, power: float, freedom: float) -> NoiseLevels:
    """Noise that is equal and independent in all entries, of the variance ``power`` m^2."""
    level = np.eye(conditions.vectors.shape[1]) * power + 0j
    return NoiseLevels(np.zeros_like(conditions.record_covariance), level, freedom)


def solve_influence(
    conditions: Conditions, noise: NoiseLevels, weights: np.ndarray, law: complex = 0.0, growth: float = 0.0
) -> Influence:
    """The coefficients by least squares with these ``weights`` (C,) of the conditions."""
    design = design_of(conditions.unbalance, law)
    return Influence(
        speeds=conditions.speeds,
        channels=conditions.channels,
        planes=conditions.planes,
        noise=noise,
        coefficients=solve_weighted(conditions.vectors, design, weights),
        law=law,
        spread=np.linalg.inv((design.conj().T * weights) @ design),
        shift=np.zeros((design.shape[1], conditions.vectors.shape[1]), dtype=complex),
        weights=weights,
        growth=growth,
    )


# --- drift that grows with the weights ---------------------------------------------------------------


def inflation(unbalance: np.ndarray, growth: float) -> np.ndarray:
    """(C,) how many times the covariance without weights conditions with (C, N) kg m have; growth in 1/(kg m)^2."""
    return np.asarray(1 + growth * (abs(unbalance) ** 2).sum(-1))


def fit_growth(vectors: np.ndarray, design: np.ndarray, unbalance: np.ndarray) -> tuple[float, float]:
    """k in 1/(kg m)^2, and the chance that drift without growth would show as much of it.

    ``vectors`` (C, D) m are linear in the ``design`` (C, Q); ``unbalance`` (C, N) is in kg m. Thirteen values of k are
    tried beside zero, from 0.03 to 30 for weights of the mean square of the conditions'.
    """
    from scipy import stats

    if not unbalance.any():
        return 0.0, 1.0
    tried = np.concatenate([[0.0], np.logspace(-1.5, 1.5, 13)]) * (1 / np.mean((abs(unbalance) ** 2).sum(1)))
    likelihoods = _likelihood(vectors, design, np.array([inflation(unbalance, k) for k in tried]))
    best = int(np.argmax(likelihoods))
    gain = likelihoods[best] - likelihoods[0]
    return float(tried[best]), float(stats.chi2.sf(2 * gain, 1))


def _likelihood(
    vectors: np.ndarray,
    design: np.ndarray,
    inflated: np.ndarray,
    tails: tuple[float, ...] = (1.0, 2.0, 4.0, 8.0, 16.0, 1e6),
    steps: int = 60,
    tolerance: float = 1e-4,
) -> np.ndarray:
    """(G,) logarithms of the restricted likelihood of each ``inflated`` (G, C), at the best tail, but for a constant.

    By expectation and maximisation, for all G times T ``tails`` (complex degrees of freedom) at once.
    """
    from scipy import special

    root = 1 / np.sqrt(inflated)[:, None, :, None]
    scale = np.sqrt((abs(design) ** 2).mean(0))
    scaled, columns = vectors * root, design / scale * root  # (G, 1, C, .)
    (n, q), size = design.shape, vectors.shape[1]
    tail = np.array(tails)[None, :, None]
    weights = np.ones((len(inflated), len(tails), n))
    for _ in range(steps):
        turned = (columns.conj() * weights[..., None]).swapaxes(-1, -2)  # (G, T, Q, C)
        gram = turned @ columns
        residual = scaled - columns @ np.linalg.solve(gram, turned @ scaled)
        scatter = (residual * weights[..., None]).swapaxes(-1, -2) @ residual.conj() / (n - q)
        whitened = np.linalg.solve(scatter, residual.swapaxes(-1, -2)).swapaxes(-1, -2)
        squared = (residual.conj() * whitened).sum(-1).real
        previous, weights = weights, (tail + size) / (tail + squared)
        if abs(weights - previous).max() < tolerance:
            break
    density = special.gammaln(tail + size) - special.gammaln(tail) - size * np.log(tail)
    density = density - (tail + size) * np.log1p(squared / tail) - size * np.log(inflated)[:, None]
    volume = (n - q) * np.linalg.slogdet(scatter)[1] + size * np.linalg.slogdet(gram)[1]
    return np.asarray((density.sum(-1) - volume).max(1))
