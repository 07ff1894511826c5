"""Physical model and influence coefficients together: what the first can't follow is a correction with a prior.

The rest of the physical prediction is R = A d + E over the design A = [1, U], with each column of unit size. The
correction d has the covariance lambda times that of the noise E, one lambda for the baseline and one for the weights,
which have the greatest marginal likelihood of the training conditions (empirical Bayes; MacKay 1992). Where they tell
nothing against the physical model, lambda is zero and the blend is that model; with many conditions and large lambda it
goes over into influence coefficients.

Legend: C conditions, N planes, Q = 1 + N, D = S P.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np

from pipeline.balance.consistency import find_contradictions
from pipeline.balance.influence import Influence, design_of
from pipeline.balance.linear_vibration import LinearVibration
from pipeline.data.conditions import Conditions
from pipeline.errors import IdentifiabilityError
from pipeline.problem.noise_levels import NoiseLevels


@dataclass(frozen=True, eq=False, kw_only=True)
class Blend(LinearVibration):
    """A physical model and its correction."""

    physical: LinearVibration
    correction: Influence  # of what the physical model can't follow; its noise is that of the blend
    sizes: tuple[float, float]  # lambda of the baseline and of the weights

    def predict(self, unbalance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Mean (C, D) m, and its covariance (C, D, D) m^2, for weights (C, N) kg m."""
        rest, covariance = self.correction.predict(unbalance)
        return self.physical.predict(unbalance)[0] + rest, covariance

    def influence_at(self, unbalance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Derivative (D, N) m/(kg m) by the weights at ``unbalance`` (N,), and the baseline (D,) m."""
        (slope, baseline), (steeper, shift) = (m.influence_at(unbalance) for m in (self.physical, self.correction))
        return slope + steeper, baseline + shift


def blend_with_influence(physical: LinearVibration, sound: Conditions) -> Blend:
    """The blend, with the noise of the influence coefficients where the conditions suffice to estimate it."""
    try:
        _, influence = find_contradictions(sound)
        return blend(physical, sound, influence.noise, influence.weights, influence.growth)
    except IdentifiabilityError:  # too few to judge one by the others
        return blend(physical, sound, physical.noise, np.ones(len(sound.names)))


def blend(
    physical: LinearVibration,
    conditions: Conditions,
    noise: NoiseLevels,
    weights: np.ndarray,
    growth: float = 0.0,
    decades: int = 4,
) -> Blend:
    """Correct the ``physical`` model by the conditions that it was fitted to, of this ``noise``.

    ``weights`` (C,) are about 1, and small for a condition that does not belong to the others, or that drifts more:
    ``growth`` is that of the drift with the weights, 1/(kg m)^2. Zero is tried for each lambda, and values up to so
    many ``decades`` about 1, three a decade.
    """
    design = design_of(conditions.unbalance)
    size = np.sqrt((np.abs(design) ** 2).mean(axis=0))
    scale = np.where(size > 0, size, 1.0)
    scaled = design / scale * np.sqrt(weights)[:, None]
    rest = (conditions.vectors - physical.predict(conditions.unbalance)[0]) * np.sqrt(weights)[:, None]
    root = np.linalg.cholesky(noise.covariance(np.array([np.mean(conditions.counts)]))[0])
    white = np.linalg.solve(root, rest.T).T  # (C, D)
    tried = np.concatenate([[0.0], np.logspace(-decades, decades, 6 * decades + 1)])
    sizes = max(itertools.product(tried, tried), key=lambda pair: _evidence(scaled, white, pair))
    prior = _columns(sizes, design.shape[1])
    inner = np.eye(len(prior)) + np.diag(prior) @ scaled.conj().T @ scaled
    spread = np.linalg.solve(inner, np.diag(prior).astype(complex))
    coefficients = spread @ scaled.conj().T @ rest / scale[:, None]
    correction = Influence(
        speeds=physical.speeds,
        channels=physical.channels,
        planes=physical.planes,
        noise=noise,
        coefficients=coefficients,
        law=0j,
        spread=spread / scale[:, None] / scale,
        shift=np.zeros_like(coefficients),
        weights=weights,
        growth=growth,
    )
    return Blend(
        speeds=physical.speeds,
        channels=physical.channels,
        planes=physical.planes,
        noise=noise,
        physical=physical,
        correction=correction,
        sizes=sizes,
    )


def _columns(sizes: tuple[float, float], count: int) -> np.ndarray:
    """(Q,) lambda of each column."""
    return np.array([sizes[0], *[sizes[1]] * (count - 1)])


def _evidence(scaled: np.ndarray, white: np.ndarray, sizes: tuple[float, float]) -> float:
    """Logarithm of the marginal likelihood of whitened rests (C, D), without what does not depend on the sizes."""
    covariance = np.eye(len(scaled)) + (scaled * _columns(sizes, scaled.shape[1])) @ scaled.conj().T
    _, logarithm = np.linalg.slogdet(covariance)
    square = float((white.conj() * np.linalg.solve(covariance, white)).sum().real)
    return -square - white.shape[1] * float(logarithm)
