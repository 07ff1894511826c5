"""What the answer is off by beside noise: what the functions of the speed can't follow, and tolerances not fitted.

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

Readings that a tolerance would change as no weight can leave it less room. It is as if all tolerances u (of unit
variance) were fitted with the weights z: with the information ``H`` of both, u has the covariance
``(1 + H_uu - H_uz H_zz^-1 H_zu)^-1`` and a mean, and z moves by ``-H_zz^-1 H_zu u``.

Legend: S speeds, A active unknowns, K features, L local functions, Z weights of the fit, T tolerances, kinds of which
are named in :data:`pipeline.parameters.model.USUAL`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from pipeline.identification.inputs import SPEED, evaluate_functions
from pipeline.identification.model import CoefficientModel
from pipeline.identification.problem import OutputError
from pipeline.identification.readings import sensor_model
from pipeline.identification.selection import Evidence
from pipeline.parameters.model import USUAL

if TYPE_CHECKING:
    import torch


@dataclass(frozen=True, eq=False)
class MeanSquareError:
    """What the weights of features and local functions, (A, K + L), and all others are off by."""

    matrix: np.ndarray  # (Z + A L, Z + A L)
    fitted: np.ndarray  # (Z,) where the weights of the fit lie in it
    n_local: int  # L


def count_local(
    model: CoefficientModel, n_speeds: int, n_local: int = 30, n_smooth: int = 8, speeds_each: int = 2
) -> int:
    """L, for so many different speeds; constants have none, as they are constants by assumption.

    ``n_local`` was chosen by five machines (studies/coverage/README.md): with 20 intervals are too wide for kinked
    coefficients, with 40 too narrow. Bearing laws alone are off by ``n_smooth`` smooth functions. Fewer than
    ``speeds_each`` for a local function can't tell it from noise, and cubic B-splines are four or more.
    """
    most = n_local // len(model.inputs) if model.hidden or model.functions else n_smooth
    count = min(most, n_speeds // speeds_each)
    return 0 if model.hidden is None or count < 4 else count * len(model.inputs)


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


def measure_error(problem: OutputError, weights: torch.Tensor) -> MeanSquareError:
    """The mean square error at the minimum ``weights`` (1, 1, Z): of the noise, and of what no function follows."""
    points, covariance = problem.measurement.dataset.points, problem.covariance(weights)[0]
    count = count_local(problem.basis.model, len(np.unique(points[SPEED])))
    if not count:
        return noise_alone(problem, covariance)
    n_active = len(problem.kept)
    gradient, matrix, local = _expand(problem, weights, evaluate_local(problem.basis.model, points, count))
    by_fit = covariance @ matrix[np.ix_(~local, local)]  # (Z, A L): how the fitted weights follow the local ones
    information = matrix[np.ix_(local, local)] - matrix[np.ix_(local, ~local)] @ by_fit
    score = -(gradient[local] - by_fit.T @ gradient[~local])
    # Beside a coefficient that ran off at most speeds, what is left of its functions is rounding.
    told = np.diag(information) > 0
    information, score = information * np.outer(told, told), score * told
    # tau is a deviation of outputs, the logarithm of a coefficient or its share of the coefficient's size.
    evidence = Evidence(information, score, np.ones((n_active, count)), np.eye(n_active), np.full(n_active, 0.03))
    tau = evidence.maximise(rounds=100, still=5e-4, smallest=1e-6)
    if problem.law.laws and evidence.is_chance(tau, n_active):  # a right law's; curves never are quite right
        return noise_alone(problem, covariance)
    mean, root = evidence.posterior(tau)
    moment = root.T @ root + np.outer(mean, mean)
    error = np.zeros_like(matrix)
    error[np.ix_(~local, ~local)] = covariance + by_fit @ moment @ by_fit.T
    error[np.ix_(~local, local)] = by_fit @ moment
    error[np.ix_(local, ~local)] = (by_fit @ moment).T
    error[np.ix_(local, local)] = moment
    return MeanSquareError(error, np.flatnonzero(~local), count)


def noise_alone(problem: OutputError, covariance: np.ndarray) -> MeanSquareError:
    """The error where nothing but the ``covariance`` (Z, Z) is known of it."""
    return MeanSquareError(covariance, np.arange(problem.places.size), 0)


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


# --- tolerances ------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Unfitted:
    """What is known of the tolerances after the fit, and how the weights follow them."""

    kinds: np.ndarray  # (T,) places of the kinds in USUAL
    moves: np.ndarray  # (Z + A L, T) of the weights by one deviation of each
    second: np.ndarray  # (T, T) mean square of the tolerances, in their deviations

    def covariance(self) -> np.ndarray:
        """(Z + A L, Z + A L) mean square of what they move."""
        return np.asarray(self.moves @ self.second @ self.moves.T)

    def select(self, name: str) -> Unfitted:
        """Those of one kind."""
        chosen = self.kinds == list(USUAL).index(name)
        return Unfitted(self.kinds[chosen], self.moves[:, chosen], self.second[np.ix_(chosen, chosen)])

    @property
    def names(self) -> list[str]:
        """Their kinds, each once."""
        return [name for k, name in enumerate(USUAL) if (self.kinds == k).any()]


def none_unfitted(size: int) -> Unfitted:
    """No tolerance but those among the ``size`` fitted weights."""
    return Unfitted(np.zeros(0, dtype=np.int64), np.zeros((size, 0)), np.zeros((0, 0)))


def widen(problem: OutputError, weights: torch.Tensor) -> tuple[OutputError, torch.Tensor]:
    """The problem with the tolerances among the model parameters, and its weights (1, 1, Z + T)."""
    import torch

    measurement, tolerances = problem.measurement, problem.measurement.tolerances
    if not tolerances:
        return problem, weights
    among = replace(measurement, parameters=(*measurement.parameters, *tolerances), tolerances=())
    return replace(problem, sensors=sensor_model(among)), torch.nn.functional.pad(weights, (0, len(tolerances)))


def measure_tolerances(problem: OutputError, weights: torch.Tensor, places: np.ndarray, size: int) -> Unfitted:
    """What the tolerances of the measurement do at the minimum ``weights`` (1, 1, Z).

    Args:
        places: (Z,) where the weights lie among the ``size`` ones of the answer.
    """
    tolerances, count = problem.measurement.tolerances, problem.places.size
    kinds = np.array([list(USUAL).index(tolerance.kind) for tolerance in tolerances], dtype=np.int64)
    moves = np.zeros((size, len(tolerances)))
    if not tolerances:
        return none_unfitted(size)
    wider, padded = widen(problem, weights)
    gradient, matrix = (array[0, 0].numpy() for array in wider.normal(padded))
    identity = np.eye(len(tolerances))
    by_fit = problem.covariance(weights)[0] @ matrix[:count, count:]
    room = matrix[count:, count:] - identity - matrix[count:, :count] @ by_fit  # the prior is in the matrix
    score = by_fit.T @ gradient[:count] - gradient[count:]
    spread = np.linalg.inv(identity + room)
    mean = spread @ score
    moves[places] = -by_fit
    return Unfitted(kinds, moves, spread + np.outer(mean, mean))
