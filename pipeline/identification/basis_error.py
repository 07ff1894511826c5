"""What the functions of the speed can't follow, and how much the deviations are wider for it.

The inverse of the information is the covariance of a model whose functions can follow the coefficients. Where they
can't (a kink, a feature that was dropped), the answer is biased, and its intervals are too narrow. So each unknown is
thought to deviate from its fitted function by local functions of the speed (cubic B-splines) with normal weights t of
one variance tau^2. The readings say how large it is: after the fit, the score of t is normal with the covariance
``S + S T S``, where S is the information of t beside the fitted weights z and ``T = diag(tau^2)``, and tau^2 has the
greatest likelihood (empirical Bayes; by MacKay's fixed point, 1992, since expectation maximisation hardly moves where
tau is small). Where the functions suffice, tau goes to zero and nothing is wider.

The error of z is then that of the noise and ``-H_zz^-1 H_zt t``, that of the deviation ``-t``; their mean square takes
the place of the covariance. An interval holds its share of the speeds on average, less beside a kink and more elsewhere
(Nychka 1988).

Legend: S speeds, A active unknowns, K features, L local functions, Z weights of the fit.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from pipeline.identification.blocks import Places
from pipeline.identification.evidence_prior import LAW_STANDS, chance_of_gain
from pipeline.identification.functions import evaluate_functions
from pipeline.identification.inputs import SPEED
from pipeline.identification.model import CoefficientModel
from pipeline.identification.problem import OutputError

if TYPE_CHECKING:
    import torch

N_LOCAL = 30
"""Chosen by five machines (studies/coverage/README.md): with 20 intervals are too wide for kinked coefficients, with 40
too narrow."""
N_SMOOTH = 8
"""Bearing laws alone are off by smooth functions of the speed."""
_SPEEDS_EACH = 2
"""At least so many speeds for a local function: fewer can't tell it from noise."""
_LEAST = 4  # cubic B-splines
_ROUNDS, _STILL = 100, 1e-2
_FIRST = 0.03**2
"""Deviation squared, of outputs: the logarithm of a coefficient, or its share of the coefficient's size."""
_SMALLEST = 1e-12


@dataclass(frozen=True, eq=False)
class MeanSquareError:
    """What the weights of features and local functions, (A, K + L), and all others are off by."""

    matrix: np.ndarray  # (Z + A L, Z + A L)
    places: Places  # of the blocks in it, local functions among the coefficients'
    fitted: np.ndarray  # (Z,) where the weights of the fit lie in it
    n_local: int  # L
    deviation: np.ndarray  # (A,) tau


def count_local(model: CoefficientModel, n_speeds: int) -> int:
    """L, for so many different speeds; constants have none, as they are constants by assumption."""
    most = N_LOCAL // len(model.inputs) if model.hidden or model.functions else N_SMOOTH
    count = min(most, n_speeds // _SPEEDS_EACH)
    return 0 if model.hidden is None or count < _LEAST else count * len(model.inputs)


def evaluate_local(model: CoefficientModel, points: Mapping[str, np.ndarray], count: int) -> np.ndarray:
    """(S, L) local functions at ``points`` (name -> (S,)), evenly spaced over the trained range of the speed.

    Beside each function of the speed there is one that grows with each operating condition: what is not followed at
    one temperature may be another at the next, and more so beyond them.
    """
    speeds = points[SPEED]
    if not count:
        return np.zeros((len(speeds), 0))
    low, high = model.ranges[model.inputs.index(SPEED)]
    others = [i for i, name in enumerate(model.inputs) if name != SPEED]
    each = count // len(model.inputs)
    by_speed = evaluate_functions("b_spline", each, 2 * (speeds - low) / (high - low) - 1)
    scaled = model.scaled_inputs(points).numpy()
    return np.concatenate([by_speed, *(by_speed * scaled[:, [i]] for i in others)], axis=1)


def measure_error(problem: OutputError, weights: torch.Tensor, covariance: np.ndarray) -> MeanSquareError:
    """The mean square error at the minimum ``weights`` (1, 1, Z); ``covariance`` (Z, Z) is that of the noise alone."""
    points = problem.measurement.dataset.points
    count = count_local(problem.basis.model, len(np.unique(points[SPEED])))
    n_active = len(problem.kept)
    if not count:
        return MeanSquareError(covariance, problem.places, np.arange(problem.size), 0, np.zeros(n_active))
    gradient, matrix, local = _expand(problem, weights, evaluate_local(problem.basis.model, points, count))
    by_fit = covariance @ matrix[np.ix_(~local, local)]  # (Z, A L): how the fitted weights follow the local ones
    information = matrix[np.ix_(local, local)] - matrix[np.ix_(local, ~local)] @ by_fit
    score = -(gradient[local] - by_fit.T @ gradient[~local])
    variance, moment = _maximise_likelihood(information, score, n_active)
    if problem.measurement.laws is not None and _is_chance(information, score, variance):
        return MeanSquareError(covariance, problem.places, np.arange(problem.size), 0, np.zeros(n_active))
    error = np.zeros_like(matrix)
    error[np.ix_(~local, ~local)] = covariance + by_fit @ moment @ by_fit.T
    error[np.ix_(~local, local)] = by_fit @ moment
    error[np.ix_(local, ~local)] = (by_fit @ moment).T
    error[np.ix_(local, local)] = moment
    wider = replace(problem.places, n_coefficients=problem.places.n_coefficients + n_active * count)
    return MeanSquareError(error, wider, np.flatnonzero(~local), count, np.sqrt(variance))


def _expand(
    problem: OutputError, weights: torch.Tensor, functions: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Gradient, information and mask of the local weights, of features and local functions together."""
    import torch

    (n_active, n_features), count = problem.kept.shape, functions.shape[-1]
    added = torch.as_tensor(functions).expand(len(problem.features), *functions.shape)
    wider = replace(
        problem,
        features=torch.cat([problem.features, added], dim=-1),
        kept=torch.cat([problem.kept, torch.ones(n_active, count, dtype=torch.bool)], dim=1),
        precision=torch.nn.functional.pad(problem.precision, (0, count)),
    )
    gradient, matrix = wider.normal(problem.with_features(weights, n_features + count))
    is_local = np.arange(n_features + count) >= n_features
    local = np.concatenate([np.tile(is_local, n_active), np.zeros(problem.places.n_rest, dtype=bool)])
    return gradient[0, 0].numpy(), matrix[0, 0].numpy(), local


def _maximise_likelihood(information: np.ndarray, score: np.ndarray, n_active: int) -> tuple[np.ndarray, np.ndarray]:
    """(A,) tau^2 and (A L, A L) mean square of the local weights after the data, from their ``information`` (A L, A L)
    and ``score`` (A L,) at zero.
    """
    count = len(score) // n_active
    variance = np.full(n_active, _FIRST)
    for _ in range(_ROUNDS):
        spread, mean = _follow(information, score, variance)
        # How many of an unknown's local weights the readings determine.
        told = count - np.diag(spread).reshape(n_active, count).sum(axis=1) / variance
        squares = (mean**2).reshape(n_active, count).sum(axis=1)
        likelier = np.maximum(squares / np.maximum(told, _SMALLEST), _SMALLEST)
        still = bool((np.abs(np.log(likelier / variance)) < _STILL).all())
        variance = likelier
        if still:
            break
    spread, mean = _follow(information, score, variance)
    return variance, spread + np.outer(mean, mean)


def _is_chance(information: np.ndarray, score: np.ndarray, variance: np.ndarray) -> bool:
    """Whether a right law shows local functions of the ``variance`` (A,) as likely; curves never are quite right."""
    every_variance = np.repeat(variance, len(score) // len(variance))
    size = np.sqrt(every_variance)
    scaled = np.eye(len(score)) + size[:, None] * information * size  # of determinant |T| |T^-1 + S|
    scaled_score = size * score
    gain = scaled_score @ np.linalg.solve(scaled, scaled_score) - np.linalg.slogdet(scaled)[1]
    return chance_of_gain(gain, len(variance)) > LAW_STANDS


def _follow(information: np.ndarray, score: np.ndarray, variance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Covariance (A L, A L) and mean (A L,) of the local weights after the data, for tau^2 (A,)."""
    spread = np.linalg.inv(information + np.diag(np.repeat(1 / variance, len(score) // len(variance))))
    return spread, spread @ score
