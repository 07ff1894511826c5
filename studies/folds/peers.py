"""Influence coefficients that learn a machine's vibration from conditions with known weights, with one signature."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from pipeline.balance.fitted import find_contradictions
from pipeline.balance.influence import (
    Influence,
    design_of,
    equal_levels,
    fit_influence,
    require_apart,
    solve_influence,
)
from pipeline.balance.linear_vibration import LinearVibration
from pipeline.data.conditions import Conditions
from pipeline.errors import IdentifiabilityError

Peer = Callable[[Conditions, np.ndarray], LinearVibration]
"""Learns from conditions, and predicts at the speeds (S,) rad/s. Raises IdentifiabilityError for what it can't."""


def influence_peers(calibration: tuple[str, ...], rate: float) -> dict[str, Peer]:
    """Influence coefficients: from the ``calibration`` alone, by ordinary least squares, and robust with their noise.

    The last leaves out the conditions of the training part that contradict their labels, at the false alarms ``rate``.
    """

    def plain(train: Conditions, speeds: np.ndarray) -> LinearVibration:
        """The calibration alone, as equal and independent readings."""
        _require_same(train, speeds)
        kept = [c for c, name in enumerate(train.names) if name in calibration]
        if len(kept) < 1 + len(train.planes):
            raise IdentifiabilityError(
                f"the fixed calibration must be in the training part ({', '.join(calibration)}), but {len(kept)} of "
                "them are: leave this method out of the split"
            )
        return fit_independent(train.of(kept))

    def least_squares(train: Conditions, speeds: np.ndarray) -> LinearVibration:
        _require_same(train, speeds)
        return fit_independent(train)

    def robust(train: Conditions, speeds: np.ndarray) -> LinearVibration:
        _require_same(train, speeds)
        try:
            return find_contradictions(train, rate)[1]
        except IdentifiabilityError:  # too few to judge one by the others
            return fit_influence(train)

    return {"influence_plain": plain, "influence_least_squares": least_squares, "influence": robust}


def _require_same(train: Conditions, speeds: np.ndarray) -> None:
    if not np.array_equal(train.speeds, speeds):
        raise IdentifiabilityError(
            "influence coefficients must be measured at the speeds that they predict, but these were not: use a "
            "physical model, or measure there"
        )


def fit_independent(conditions: Conditions) -> Influence:
    """Ordinary least squares: the noise of all entries is taken as equal and independent.

    Raises IdentifiabilityError where the weights can't be told apart.
    """
    require_apart(conditions)
    vectors, design = conditions.vectors, design_of(conditions.unbalance)
    left = len(design) - design.shape[1]
    guess = equal_levels(conditions, float((abs(vectors) ** 2).mean()), 0.0)
    model = solve_influence(conditions, guess, np.ones(len(design)))
    if left <= 0:
        return model
    rest = (abs(vectors - design @ model.coefficients) ** 2).sum() / (left * vectors.shape[1])
    return replace(model, noise=equal_levels(conditions, float(rest), float(left)))
