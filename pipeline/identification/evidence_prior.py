"""How large a network is that corrects bearing laws, or a trend of several inputs: the data say so, for each bearing.

It is a sum of features whose weights are normal about zero: a Gaussian process of variance sigma^2 over the data (each
feature has its share of it: the wavy ones little). sigma is that of the greatest likelihood (empirical Bayes; by
MacKay's fixed point, 1992), and the same for all coefficients of a bearing: a law that is off in one of them is off in
all, and one by one some would come out as exactly right, with bands that are too narrow. Where the law is right sigma
goes to zero and nothing is corrected; its size is the evidence against the law. Where nobody measured, the correction
is zero, and uncertain by sigma.

Legend: M members, S operating points, A active unknowns, K features, Z weights.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from pipeline.identification.basis import Basis
from pipeline.identification.information import invert
from pipeline.identification.problem import OutputError

if TYPE_CHECKING:
    import torch

_FIRST = 0.1
"""sigma of the start: an output of 0.1 changes a coefficient by ten percent."""
_SMALLEST = 1e-4
"""A correction of a hundredth of a percent is none."""
_ROUNDS, _STILL, _TINY = 60, 1e-2, 1e-12
LAW_STANDS = 0.05
"""Above this probability of as large a gain by chance a law is not corrected."""


def add_beyond(basis: Basis) -> Basis:
    """The basis with one more function: what nobody measured, which is zero at the data and one far from them."""
    import torch

    beyond = torch.zeros_like(basis.weights[..., :1])
    beyond[:, -2] = 1.0  # the output layer's own input for it, before the bias
    return replace(basis, weights=torch.cat([basis.weights, beyond], dim=-1), n_trend=0)


def unit_precision(problem: OutputError) -> torch.Tensor:
    """(A, K) precisions of the weights for a sigma of one."""
    to_features, free = problem.basis.weights[[m for m, _ in problem.active]], problem.basis.n_trend  # (A, F, K)
    share = (
        to_features.square().sum(1).reciprocal()
    )  # squared size of a feature over the data, for weights of equal variance
    share[:, :free] = 0.0
    if problem.basis.model.fades:
        share[:, -1] = 0.0
    precision = share.sum(1, keepdim=True) / (share * problem.features.shape[1])
    precision[:, :free] = 0.0
    if problem.basis.model.fades:
        precision[:, -1] = 1.0
    return precision


def with_sigma(problem: OutputError, sigma: np.ndarray | None = None) -> OutputError:
    """The problem with a correction of ``sigma`` (A,), outputs; that of the start where none is given."""
    import torch

    every = torch.full((len(problem.active),), _FIRST) if sigma is None else torch.as_tensor(sigma)
    return replace(problem, precision=unit_precision(problem) / every.to(torch.float64)[:, None] ** 2)


def weigh_by_evidence(problem: OutputError, weights: torch.Tensor) -> tuple[OutputError, torch.Tensor]:
    """The problem with sigma of the greatest likelihood, and the weights (1, 1, Z) to go on from.

    Bearing laws stay as they are unless that is more likely by far: by as much as one right law in twenty would show.
    """
    import torch

    evidence = _expand(problem, weights)
    sigma = _likeliest_sigma(evidence)
    n_bearings = len({m for m, _ in problem.active})
    if problem.basis.model.fades and chance_of_gain(2 * _gain(evidence, sigma), n_bearings) > LAW_STANDS:
        kept = torch.zeros_like(problem.kept)
        left = replace(problem, kept=kept)
        return left, torch.where(left.fitted(), weights, torch.zeros_like(weights))
    return with_sigma(problem, sigma), weights


class _Evidence(NamedTuple):
    """The readings' likelihood, quadratic in the weights: ``right' z - z' data z / 2``, other priors included."""

    data: np.ndarray  # (Z, Z)
    right: np.ndarray  # (Z,)
    unit: np.ndarray  # (A, K) precisions of the correction's weights for a sigma of one
    alike: np.ndarray  # (A, A) one for unknowns of the same bearing: these have the same sigma
    sigma: np.ndarray  # (A,) at hand

    def posterior(self, sigma: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Mean (Z,) and covariance (Z, Z) of the weights for a ``sigma`` (A,)."""
        import torch

        spread = invert(torch.as_tensor(self.data + np.diag(self.precision(sigma))))
        return spread @ self.right, spread

    def precision(self, sigma: np.ndarray) -> np.ndarray:
        """(Z,) of the correction's weights; zero for the others."""
        return np.pad((self.unit / sigma[:, None] ** 2).ravel(), (0, len(self.right) - self.unit.size))


def _expand(problem: OutputError, weights: torch.Tensor) -> _Evidence:
    """The likelihood about the minimum ``weights`` (1, 1, Z)."""
    unit, outer = unit_precision(problem).numpy(), problem.places.n_coefficients
    gradient, matrix = (array[0, 0].numpy() for array in problem.normal(weights))
    precision = (problem.precision * problem.kept).flatten().numpy()
    # At the minimum ``matrix z = matrix at - gradient``, whatever the precisions of the correction.
    right = matrix @ weights[0, 0].numpy() - gradient
    data = matrix - np.diag(np.pad(precision, (0, len(matrix) - outer)))
    bearing = np.array([m for m, _ in problem.active])
    sigma = np.sqrt(unit[:, -1] / precision.reshape(unit.shape)[:, -1])
    return _Evidence(data, right, unit, (bearing[:, None] == bearing).astype(float), sigma)


def _likeliest_sigma(evidence: _Evidence) -> np.ndarray:
    """(A,) by MacKay's fixed point."""
    sigma, unit = evidence.sigma, evidence.unit
    for _ in range(_ROUNDS):
        mean, spread = evidence.posterior(sigma)
        # How many of an unknown's weights the readings determine.
        free = unit.ravel() > 0
        told = (1.0 - (evidence.precision(sigma) * np.diag(spread))[: unit.size]) * free
        squares = (mean[: unit.size] ** 2 * unit.ravel()).reshape(unit.shape).sum(axis=1)
        told = told.reshape(unit.shape).sum(axis=1)
        likelier = np.sqrt(evidence.alike @ squares / np.maximum(evidence.alike @ told, _TINY))
        likelier = np.maximum(likelier, _SMALLEST)
        still = bool((np.abs(np.log(likelier / sigma)) < _STILL).all())
        sigma = likelier
        if still:
            break
    return sigma


def _gain(evidence: _Evidence, sigma: np.ndarray) -> float:
    """How much the logarithm of the likelihood, over all weights, rises from no correction to that of ``sigma``."""
    size, precision = evidence.unit.size, evidence.precision(sigma)
    whole, rest = evidence.data + np.diag(precision), evidence.data[size:, size:]
    both = 0.0
    for sign, matrix, right in ((1.0, whole, evidence.right), (-1.0, rest, evidence.right[size:])):
        scale = 1 / np.sqrt(np.diag(matrix))
        scaled = matrix * scale[:, None] * scale
        quadratic = (right * scale) @ np.linalg.solve(scaled, right * scale)
        both += sign * 0.5 * (quadratic - np.linalg.slogdet(scaled)[1] + 2 * np.log(scale).sum())
    return float(both + 0.5 * np.log(precision[:size]).sum())


def chance_of_gain(square: float, count: int) -> float:
    """How likely twice such a gain is where nothing is to be corrected: each of ``count`` variances is then zero or not
    by even odds, and gains chi-square (Self and Liang 1987).
    """
    from scipy.special import comb, gammaincc

    freedom = np.arange(1, count + 1)
    return float((comb(count, freedom) * gammaincc(freedom / 2, max(square, 0.0) / 2)).sum() / 2.0**count)
