"""What predicts vibration from weights, by the name of the method: influence coefficients, physical model, blend.

The blend is both together: what the physical model can't follow is a correction with a prior.
The rest of the physical prediction is R = A d + E over the design A = [1, U], with each column of unit size. The
correction d has the covariance lambda times that of the noise E, one lambda for the baseline and one for the weights,
which have the greatest marginal likelihood of the training conditions (empirical Bayes; MacKay 1992). Where they tell
nothing against the physical model, lambda is zero and the blend is that model; with many conditions and large lambda it
goes over into influence coefficients.

Conditions that contradict their labels are found from the vibration alone at a stated rate of false alarms. The squared
distance T^2 of each condition from the model of the others is held against a scaled F distribution whose tail the
others show (Hotelling's for Gaussian conditions). The farthest is left out and the rest is fitted again, so that one
gross case does not mask others: what was left out up to the last significant step is named (Rosner 1983). A chance is
that of the farthest of all conditions (Bonferroni).

Legend: C conditions, N planes, Q = 1 + N, D = S P (speeds times channels).
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from pipeline.balance.influence import Influence, design_of, distances, fit_influence
from pipeline.balance.linear_vibration import LinearVibration
from pipeline.balance.physical import Physical
from pipeline.data.conditions import Conditions
from pipeline.errors import ConfigError, IdentifiabilityError, nearest
from pipeline.problem.noise_levels import NoiseLevels, fit_tail


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
    typical = noise.covariance(np.array([np.mean(conditions.counts)]))[0]
    white = np.linalg.solve(np.linalg.cholesky(typical), rest.T).T  # (C, D)
    tried = np.concatenate([[0.0], np.logspace(-decades, decades, 6 * decades + 1)])
    sizes = max(itertools.product(tried, tried), key=lambda pair: _evidence(scaled, white, pair))
    prior = np.repeat(sizes, (1, design.shape[1] - 1))
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


def _evidence(scaled: np.ndarray, white: np.ndarray, sizes: tuple[float, float]) -> float:
    """Logarithm of the marginal likelihood of whitened rests (C, D), without what does not depend on the sizes."""
    covariance = np.eye(len(scaled)) + (scaled * np.repeat(sizes, (1, scaled.shape[1] - 1))) @ scaled.conj().T
    _, logarithm = np.linalg.slogdet(covariance)
    square = float((white.conj() * np.linalg.solve(covariance, white)).sum().real)
    return -square - white.shape[1] * float(logarithm)


def find_contradictions(
    conditions: Conditions, rate: float = 0.01, law: bool | None = None, most: float = 0.2
) -> tuple[dict[str, float], Influence]:
    """The conditions that contradict their labels, gross ones first, and the model of the others.

    With each name comes the chance that consistent conditions have one as far off, in all of them together. ``rate`` is
    the chance to name any where none contradicts, ``most`` the share that may be named: a model can't say which half is
    right. Raises IdentifiabilityError where the conditions are too few to judge one by the others.
    """
    from scipy import stats

    size, n = conditions.vectors.shape[1], len(conditions.names)
    columns = 1 + len(conditions.planes)
    if n - columns - 1 < size + 2:
        raise IdentifiabilityError(
            f"a condition can be judged by more than {size + columns + 2} others (the entries of a vector, and the "
            f"columns of the model), but there are {n}: measure more conditions, or use fewer probes or speeds"
        )
    left, named = list(range(n)), 0
    removed: list[int] = []
    chances: list[float] = []
    growth = fit_influence(conditions, law=law).growth  # robust: gross conditions are not taken for growth
    squared = distances(conditions, fit_influence(conditions, law=law, robust=False, growth=growth))
    while len(removed) < int(most * n) and len(left) - columns - 2 >= size + 2:
        far, among = int(np.argmax(squared)), len(left)
        gross = float(squared[far])
        removed.append(left.pop(far))
        others = conditions.of(left)
        squared = distances(others, fit_influence(others, law=law, robust=False, growth=growth))
        tail, stretch = fit_tail(squared, size, float(len(left) - columns - 1), max(gross, float(squared.max())))
        chances.append(float(min(1.0, among * stats.f.sf(gross / (stretch * size), 2 * size, 2 * tail))))
        if chances[-1] < rate:
            named = len(removed)
    contradictions = {conditions.names[c]: min(chances[k:named]) for k, c in enumerate(removed[:named])}
    return contradictions, fit_influence(conditions.without(contradictions), law=law)


@dataclass(frozen=True, eq=False)
class Fitted:
    """The experiment's conditions, and what is fitted to those that do not contradict their labels: by method, each
    fitted when it is first asked for. Mistakes in what a user asks need none."""

    conditions: Conditions
    physical: Physical | None

    @cached_property
    def judged(self) -> tuple[Mapping[str, float], Influence]:
        """The conditions that contradict their labels, with their chances, and influence coefficients of the others."""
        try:
            return find_contradictions(self.conditions)
        except IdentifiabilityError:  # too few conditions to judge one by the others
            return {}, fit_influence(self.conditions)

    @cached_property
    def sound(self) -> Conditions:
        """The conditions that do not contradict their labels."""
        return self.conditions.without(self.judged[0])

    @cached_property
    def models(self) -> Mapping[str, LinearVibration]:
        """The model of each method."""
        physical = self.physical
        model = {"physical": physical, "blend": blend_with_influence(physical, self.sound)} if physical else {}
        return {"influence": self.judged[1], **model}

    def can_leave_out(self, method: str) -> bool:
        """Whether the method is fitted anew without each condition: quickly done, and of enough conditions."""
        return method == "influence" and len(self.sound.names) > len(self.sound.planes) + 3

    def leave_each_out(self, method: str) -> list[LinearVibration]:
        """The model of a method for each of the experiment's conditions: influence coefficients that it is no part of.

        With too few conditions to leave one out, and for other methods, it is the one that there is.
        """
        left_out = self.sound.names if self.can_leave_out(method) else ()
        return [
            fit_influence(self.sound.without([name])) if name in left_out else self.models[method]
            for name in self.conditions.names
        ]

    def pick(self, wanted: str | None, key: str) -> str:
        """The method that is asked for at ``key``, or the first. Raises ConfigError for one that there is not."""
        methods = ("influence", "physical", "blend") if self.physical else ("influence",)
        method = wanted or methods[0]
        if method not in methods:
            raise ConfigError(f"{key} must be a method with a fit, but got '{method}': {nearest(method, methods)}")
        return method
