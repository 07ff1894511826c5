"""The fit by the output error: Levenberg-Marquardt, weights from the noise, and as many features as the data determine.

The deviation of a reading follows from the predicted amplitude, not from the measured one, whose noise would bias the
fit; so weights and coefficients are found in turn. Readings far off (bad points) count less (Huber 1964).

Legend: S speeds, P channels, R runs, M members, U unknowns, Z free numbers.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from pipeline.config.identification import LevenbergMarquardtConfig
from pipeline.identification.feature_choice import AKAIKE, TIE, features_that_count
from pipeline.identification.optimizers import levenberg_marquardt, until_still
from pipeline.identification.outcome import Outcome
from pipeline.identification.response_preparation import PreparedResponse, robust_start
from pipeline.identification.response_problem import ResponseProblem
from pipeline.identification.training import Progress, TrainedBatch, TrainingSetup, run_training

if TYPE_CHECKING:
    import torch

HUBER = 2.5
"""Readings beyond so many deviations (complex) count less; of good ones that is one in five hundred."""
BAD_POINT = 4.0
"""Readings beyond so many deviations are listed: of good ones, one in ten million."""
_ROUNDS = 8
_SETTLED = 1e-3
_CHOICE = 1
"""The round after which superfluous features are dropped: the weights are nearly right by then."""
_NO_WORSE = 2.0
"""So many times the loss before, dropping them may raise it to."""


@dataclass(frozen=True, eq=False)
class ResponseFit:
    """The answer, and its account."""

    prepared: PreparedResponse
    batch: TrainedBatch
    problem: ResponseProblem  # with the final weights
    weights: tuple[np.ndarray, ...]  # Huber's, (S, P, R of the block)
    factor: np.ndarray  # (P,) deviation of each channel over the stated one
    outcome: Outcome
    history: tuple[dict[str, float | str], ...]
    steps: int
    seconds: float

    @property
    def free(self) -> torch.Tensor:
        """(1, 1, Z)."""
        return self.batch.parameters

    def covariance(self) -> np.ndarray:
        """(Z, Z) of the free vector: the inverse of the information, the Cramer-Rao bound of the parametrisation."""
        return covariance(self.problem, self.free)[0]

    def residual_unbalance(self) -> np.ndarray:
        """(N,) complex, kg m."""
        return np.asarray(self.problem.unbalance(self.free)[0].numpy())


def covariance(problem: ResponseProblem, free: torch.Tensor, precision: float = 0.0) -> np.ndarray:
    """(G, Z, Z) inverse of the information at the free vectors (G, 1, Z); zero for numbers that are not fitted.

    ``precision`` of the numbers beforehand keeps finite what the data leave open.
    """
    import torch

    _, normal = problem.normal(free)
    matrix = normal[:, 0] + precision * torch.eye(problem.size, dtype=free.dtype)
    size = matrix.diagonal(dim1=-2, dim2=-1).clamp(min=1e-300).sqrt()
    scaled = matrix / size[:, :, None] / size[:, None, :]
    values, vectors = torch.linalg.eigh(scaled)
    values = values.clamp(min=float(np.finfo(float).eps) * 10)
    inverse = (vectors / values[:, None, :]) @ vectors.mT
    fitted = problem.fitted().to(free.dtype)
    return np.asarray((inverse * (fitted / size)[:, :, None] * (fitted / size)[:, None, :]).numpy())


def unknown_deviation(problem: ResponseProblem, free: torch.Tensor, precision: float = 0.0) -> np.ndarray:
    """(G, S, A) standard deviation of the active unknowns at the free vectors (G, 1, Z), see :func:`covariance`."""
    spread, count = covariance(problem, free, precision), problem.features.shape[-1]
    _, slope = problem.unknowns(free)
    parts = []
    for a, (m, _) in enumerate(problem.active):
        own, part = problem.features[m].numpy(), slice(a * count, (a + 1) * count)
        parts.append(np.sqrt(np.einsum("sk,gkl,sl->gs", own, spread[:, part, part], own, optimize=True)))
    return np.stack(parts, axis=-1) * np.abs(slope.numpy())


def fit_response(
    prepared: PreparedResponse,
    setup: TrainingSetup,
    progress: Progress | None = None,
    estimate_noise: bool = False,
    robust: bool = True,
) -> ResponseFit:
    """Fit, weigh the readings anew, and fit again until the weights stay. Ctrl-C ends it with the best state so far."""
    problem, free = prepared.problem, prepared.start
    if prepared.from_guess:
        problem, free = grown(prepared, setup.optimizer.levenberg_marquardt)
    factor = np.ones(prepared.data.displacement.shape[1])
    history: list[dict[str, float | str]] = []
    steps, seconds = 0, 0.0
    for turn in range(_ROUNDS):
        training = replace(prepared.training, train=problem)
        batch = run_training(training, free, setup, progress)
        free = batch.parameters
        history += [dict(row) | {"step": steps + int(row["step"])} for row in batch.history]
        steps, seconds = steps + batch.steps, seconds + batch.seconds
        if batch.outcomes[0] is Outcome.INTERRUPTED:
            weights = tuple(np.ones(block.weight.shape[1:]) for block in problem.blocks)
            break
        if estimate_noise:
            repeated = repeated_factor(prepared, problem, free)
            factor = estimated_factor(prepared, problem, free, factor) if repeated is None else repeated
        before = problem
        problem, weights = reweighted(prepared, problem, free, factor, robust)
        if turn == _CHOICE and not prepared.from_guess:
            chosen, start = features_that_count(problem, free, covariance(problem, free)[0])
            # The choice takes the minimum for quadratic: where there is none yet, it may lead anywhere, or to NaN.
            if float(chosen.loss(start)) <= _NO_WORSE * float(problem.loss(free)):
                problem, free = chosen, start
        changes = [
            float((new.weight / old.weight).log().abs().max())
            for new, old in zip(problem.blocks, before.blocks, strict=True)
        ]
        if turn > _CHOICE and max(changes) < _SETTLED:
            break
    return ResponseFit(prepared, batch, problem, weights, factor, batch.outcomes[0], tuple(history), steps, seconds)


def grown(prepared: PreparedResponse, config: LevenbergMarquardtConfig) -> tuple[ResponseProblem, torch.Tensor]:
    """The problem with as many features as count, and its best minimum (1, 1, Z), where there is no linear start.

    From several guesses constants are fitted first, then feature by feature is added: far from the answer, many at once
    would follow one speed here and another there. What a filter made of each speed is tried with every number of
    features. It ends when Akaike's criterion, of the minima themselves, has not fallen for some features.
    """
    import torch

    problem, starts = prepared.problem, prepared.start
    count = problem.features.shape[-1]
    free, before, best = problem.with_features(starts, 1), 1, (float("inf"), 1, starts[:1])
    for order in dict.fromkeys([1, *range(problem.basis.n_trend, count + 1)]):
        limited = problem.truncated(order)
        tried = problem.truncated(before).with_features(free, order)
        tried = torch.cat([tried, *(limited.revived(one[None]) for one in tried)])
        if prepared.rough is not None:
            tried = torch.cat([robust_start(limited, prepared.rough), tried])
        tried = levenberg_marquardt(limited, tried, config, until_still(_NEARLY), by_diagonal=True)
        losses = limited.loss(tried)[:, 0].nan_to_num(float("inf"))
        free, before = tried[_distinct(losses.tolist())], order
        criterion = float(losses.min()) ** 2 * limited.n_rows + AKAIKE * limited.n_numbers
        if criterion < best[0] - TIE:  # a tie stays with fewer
            best = (criterion, order, limited.with_features(free[:1], count))
        elif order >= best[1] + _LOOK_AHEAD:
            break
    kept = (torch.arange(count) < best[1]).repeat(len(problem.active), 1)
    return replace(problem, kept=kept), best[2]


def _distinct(losses: list[float]) -> list[int]:
    """The best few that lie in valleys of their own, the best first; of equals the one that was given first."""
    kept: list[int] = []
    rest = sorted(range(len(losses)), key=lambda i: losses[i])
    while rest and len(kept) < _KEPT_STARTS:
        lowest = losses[rest[0]]
        kept.append(min(i for i in rest if losses[i] <= lowest * (1 + _EQUAL)))
        rest = [i for i in rest if losses[i] > lowest * (1 + _SAME_VALLEY)]
    return kept


_KEPT_STARTS, _SAME_VALLEY, _EQUAL = 3, 1e-2, 1e-6
_LOOK_AHEAD = 3
_NEARLY = 1e-5
"""Share of the loss below which a step ends the search of a size: the fit itself goes on from there."""


def reweighted(
    prepared: PreparedResponse, problem: ResponseProblem, free: torch.Tensor, factor: np.ndarray, robust: bool
) -> tuple[ResponseProblem, tuple[np.ndarray, ...]]:
    """Weights from the predicted amplitudes and, if ``robust``, Huber's for readings far off."""
    import torch

    blocks, shares = [], []
    for block, predicted in zip(problem.blocks, problem.predicted(free), strict=True):
        deviation = torch.as_tensor(prepared.data.deviation_of(predicted.numpy(), block.subtracted, factor))
        off = (predicted - block.measured).abs() / deviation
        share = (HUBER / off.clamp(min=HUBER)) if robust else torch.ones_like(off)
        blocks.append(replace(block, weight=np.sqrt(2.0) / deviation * share.sqrt()))
        shares.append(share[0].numpy())
    return replace(problem, blocks=tuple(blocks)), tuple(shares)


def estimated_factor(
    prepared: PreparedResponse, problem: ResponseProblem, free: torch.Tensor, factor: np.ndarray
) -> np.ndarray:
    """(P,) deviation of each channel over the stated one, from the medians of what the fit leaves over.

    The squared modulus of circular noise has the median ln 2; the free numbers took their share of the rest.
    """
    left = []
    for block, predicted in zip(problem.blocks, problem.predicted(free), strict=True):
        stated = prepared.data.deviation_of(predicted[0].numpy(), block.subtracted, np.ones_like(factor))
        off = (predicted - block.measured).abs()[0].numpy() / stated
        left.append(np.moveaxis(off, 1, 0).reshape(off.shape[1], -1))
    squared = np.median(np.concatenate(left, axis=1) ** 2, axis=1) / np.log(2.0)
    rest = max(1.0 - problem.n_numbers / problem.n_rows, 0.05)
    return np.asarray(np.sqrt(squared / rest))


def repeated_factor(prepared: PreparedResponse, problem: ResponseProblem, free: torch.Tensor) -> np.ndarray | None:
    """(P,) as :func:`estimated_factor`, from runs of the same excitation; None where no run repeats another.

    What differs between them is noise whatever the model is: half the squared difference of two has their variance.
    """
    squares = []
    for block, predicted in zip(problem.blocks, problem.predicted(free), strict=True):
        forced, measured = block.forced_sensors.numpy(), block.measured[0].numpy()
        # All runs had the same baseline taken off: its noise cancels.
        read = predicted[0].numpy() + (0.0 if block.subtracted is None else block.subtracted)
        deviation = prepared.data.deviation_of(read, None, np.ones(measured.shape[1]))
        last: dict[bytes, int] = {}
        for r in range(measured.shape[-1]):
            before = last.get(key := forced[..., r].tobytes())
            if before is not None:
                squares.append(np.abs((measured[..., r] - measured[..., before]) / deviation[..., r]) ** 2 / 2)
            last[key] = r
    return np.sqrt(np.median(np.concatenate(squares), axis=0) / np.log(2.0)) if squares else None
