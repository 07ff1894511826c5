"""How well a fit explains its readings where there is no truth to compare with.

With the right model and the right noise the readings lie about the prediction by their noise: each complex one adds 1
to chi-square, less half of one for each number that was fitted, and neighbouring speeds deviate independently.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np


def chi_square(deviations: Sequence[np.ndarray]) -> tuple[float, int]:
    """Sum of the squared deviations over their root mean square, complex, and how many there are."""
    return float(sum((np.abs(d) ** 2).sum() for d in deviations)), int(sum(d.size for d in deviations))


def autocorrelation(deviations: Sequence[np.ndarray]) -> tuple[float, float]:
    """Correlation of complex deviations (S, P, R) at neighbouring speeds, and that over its standard deviation.

    White deviations have a value about zero with the variance of one over twice the number of neighbours.
    """
    products = sum(float((d[:-1] * d[1:].conj()).real.sum()) for d in deviations)
    power = sum(float((np.abs(d) ** 2).sum()) for d in deviations)
    neighbours = sum(d[:-1].size for d in deviations)
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


def within(errors: np.ndarray, deviation: np.ndarray) -> np.ndarray:
    """Percent (over the last axis) of errors inside the nominal 95 % interval, 1.96 standard deviations."""
    return np.asarray(100.0 * (np.abs(errors) <= NOMINAL_95 * deviation).mean(axis=-1))


NOMINAL_95 = 1.959964
