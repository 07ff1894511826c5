"""Drift that grows with the weights: conditions with heavy weights are less like each other than light ones.

The covariance of a condition is g N with g = 1 + k sum |U_n|^2, N that of a condition without weights. One k is fitted
by the likelihood of a multivariate Student t, whose tail is fitted with it, so that a few gross conditions are not
taken for growth. It is restricted by the coefficients (REML, Patterson and Thompson 1971). Twice the gain in the
logarithm of the likelihood is held against a chi-square. Without growth, k is zero in half of all data, so that of many
conditions the chance would be half of that (Self and Liang 1987); the whole makes up for there being few.

Legend: C conditions, N planes, Q columns of the design, D entries of a vector.
"""

from __future__ import annotations

import numpy as np


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
