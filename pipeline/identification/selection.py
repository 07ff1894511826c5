"""How many features each unknown gets, and how large those may be that correct bearing laws: the data say so.

A model with few features can't follow the coefficients, one with many follows the noise. The features are nested,
from smooth to wavy, and more of them must lower Akaike's criterion: chi-square falls by more than 2 for each further
weight (Akaike 1974; a superfluous one lowers it by 1 on average). So less noise keeps more of them, and no truth is
needed. A tie goes to fewer features: what a criterion differs by from one processor to another decides nothing.

A network that corrects bearing laws, or a trend of several inputs, keeps all features. It is a sum of them whose
weights are normal about zero: a Gaussian process of variance sigma^2 over the data (each feature has its share of it:
the wavy ones little). sigma is that of the greatest likelihood (empirical Bayes; by MacKay's fixed point, 1992), and
the same for all coefficients of a bearing: a law that is off in one of them is off in all, and one by one some would
come out as exactly right, with bands that are too narrow. Where the law is right sigma goes to zero and nothing is
corrected; its size is the evidence against the law. Where nobody measured, the correction is zero, and uncertain by
sigma.

Legend: G starts, M members, S operating points, A active unknowns, K features, Z weights.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from pipeline.config.identification import LevenbergMarquardtConfig
from pipeline.identification.blocks import Basis
from pipeline.identification.linear_start import robust_start
from pipeline.identification.optimizers import levenberg_marquardt, until_still
from pipeline.identification.problem import OutputError
from pipeline.problem.ranking import count_alike, find_distinct
from pipeline.problem.slopes import invert_root

if TYPE_CHECKING:
    import torch

    from pipeline.identification.output_error_start import OutputErrorStart

AKAIKE = 2.0
TIE = 0.01
"""Criteria closer than this are equal: between processors they differ by 1e-7, between the best two choices by 0.3."""


def drop_features(
    problem: OutputError, weights: torch.Tensor, covariance: np.ndarray
) -> tuple[OutputError, torch.Tensor]:
    """The problem with the features that Akaike's criterion keeps, and the weights (1, 1, Z) to go on from.

    ``weights`` (1, 1, Z) are the minimum with all features, ``covariance`` (Z, Z) that of it. Chi-square is taken as
    quadratic there: fixing weight i at zero adds z_i^2 / C_ii and moves the others.
    """
    import torch

    n_active, count = problem.kept.shape
    value, spread, criterion = weights[0, 0].numpy(), covariance, 0.0
    best = (criterion, count, value)
    for order in range(count - 1, problem.basis.n_trend - 1, -1):
        for i in np.arange(n_active) * count + order:
            criterion += value[i] ** 2 / spread[i, i] - AKAIKE
            gain = spread[:, i] / spread[i, i]
            value = value - gain * value[i]
            spread = spread - np.outer(gain, spread[i])
        if criterion < best[0] + TIE:
            best = (min(criterion, best[0]), order, value)
    kept = (torch.arange(count) < best[1]).repeat(n_active, 1)
    chosen = replace(problem, kept=kept)
    return chosen, torch.where(chosen.fitted(), torch.as_tensor(best[2]), 0.0)[None, None]


def add_features(
    start: OutputErrorStart, config: LevenbergMarquardtConfig, look_ahead: int = 3, nearly: float = 1e-5
) -> tuple[OutputError, torch.Tensor, tuple[int, int]]:
    """The problem with as many features as count, and its best minimum (1, 1, Z), where there is no linear start; how
    many starts were fitted, and how many of them ended there.

    From several guesses constants are fitted first, then feature by feature is added: far from the answer, many at once
    would follow one speed here and another there. What a filter made of each speed is tried with every number of
    features. It ends when Akaike's criterion, of the minima themselves, has not fallen for ``look_ahead`` features.
    Where the likelihood says how large the features are, it ends at the trend, and keeps all. The search of an order
    ends with a step that lowers no loss by the share ``nearly``: the fit itself goes on from there.
    """
    import torch

    problem, starts = start.problem, start.weights
    count = problem.features.shape[-1]
    weights, before, best = problem.with_features(starts, 1), 1, (float("inf"), 1, starts[:1], 0)
    led = list(range(len(starts)))  # where each start is among the weights
    last = problem.basis.n_trend if start.by_evidence else count
    for order in dict.fromkeys([1, *range(problem.basis.n_trend, last + 1)]):
        limited = problem.truncated(order)
        tried = problem.truncated(before).with_features(weights, order)
        tried = torch.cat([tried, *(revive(limited, each[None]) for each in tried)])
        rough = [] if start.filtered is None else [robust_start(limited, start.filtered)]
        tried = torch.cat([*rough, tried])
        tried = levenberg_marquardt(limited, tried, config, until_still(nearly), by_diagonal=True)
        losses = limited.loss(tried)[:, 0].nan_to_num(float("inf")).tolist()
        kept = find_distinct(losses)
        weights, before = tried[kept], order
        ends = [losses[i + len(rough)] for i in led]
        led = [max((k for k, i in enumerate(kept) if losses[i] <= end), default=0) for end in ends]
        criterion = min(losses) ** 2 * limited.readings.size + AKAIKE * limited.n_fitted
        if criterion < best[0] - TIE:  # a tie stays with fewer
            alike = count_alike([min(losses), *ends, *losses[: len(rough)]]) - 1
            best = (criterion, order, limited.with_features(weights[:1], count), alike)
        elif order >= best[1] + look_ahead:
            break
    reached = (len(starts) + len(rough), best[3])
    if start.by_evidence:
        return problem, best[2], reached
    chosen = (torch.arange(count) < best[1]).repeat(len(problem.active), 1)
    return replace(problem, kept=chosen), best[2], reached


def revive(problem: OutputError, weights: torch.Tensor, collapsed: float = 0.02) -> torch.Tensor:
    """(0 or 1, 1, Z) the weights (1, 1, Z) with collapsed unknowns put back to their guess; none is collapsed: 0.

    What must be positive is an exponential: once it has all but vanished, below the fraction ``collapsed`` of its
    guess, nothing draws it back.
    """
    import torch

    values, active = problem.unknowns(weights)[0][0].abs().median(dim=0).values, problem.active  # (A,)
    positive = torch.tensor([problem.basis.model.positive[u] for _, u in active])
    gone = positive & (values < collapsed * torch.stack([problem.scale[m, 0, u] for m, u in active]))
    if not gone.any():
        return weights[:0]
    revived, outer = weights.clone(), problem.places.coefficients
    revived[..., outer] = (weights[0, 0, outer].unflatten(-1, (len(active), -1)) * ~gone[:, None]).flatten()
    return revived


# --- how large corrections are ---------------------------------------------------------------------------


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
    import torch

    basis, place = problem.basis, torch.arange(problem.basis.n_features)
    beyond = (place == len(place) - 1) & basis.model.fades
    sized = (place >= basis.n_trend) & ~beyond
    squares = basis.weights[[m for m, _ in problem.active]].square().sum(1)  # (A, K)
    # The squared size of a feature over the data, for weights of equal variance.
    share = torch.where(sized, squares.reciprocal(), 0.0)
    precision = share.sum(1, keepdim=True) / (share * problem.features.shape[1])
    return torch.where(sized, precision, beyond.to(precision.dtype))


def with_sigma(problem: OutputError, sigma: np.ndarray | float = 0.1) -> OutputError:
    """The problem with a correction of ``sigma`` (A,), outputs: one of 0.1 changes a coefficient by ten percent."""
    import torch

    return replace(
        problem, precision=unit_precision(problem) / torch.as_tensor(sigma, dtype=torch.float64)[..., None] ** 2
    )


def weigh_by_evidence(problem: OutputError, weights: torch.Tensor) -> tuple[OutputError, torch.Tensor]:
    """The problem with sigma of the greatest likelihood, and the weights (1, 1, Z) to go on from.

    Bearing laws stay as they are unless that is more likely by far: by as much as one right law in twenty would show.
    """
    import torch

    evidence = _expand(problem, weights)
    sigma = evidence.maximise()
    if problem.basis.model.fades and evidence.is_chance(sigma, len({m for m, _ in problem.active})):
        left = replace(problem, kept=torch.zeros_like(problem.kept))
        return left, torch.where(left.fitted(), weights, torch.zeros_like(weights))
    return with_sigma(problem, sigma), weights


class Evidence(NamedTuple):
    """A likelihood that is quadratic in the weights: ``right' z - z' data z / 2``, other priors included.

    The first A K weights are normal about zero, with precisions ``unit / sigma^2``; sigma is to be found.
    """

    data: np.ndarray  # (Z, Z)
    right: np.ndarray  # (Z,)
    unit: np.ndarray  # (A, K) precisions for a sigma of one
    alike: np.ndarray  # (A, A) one for unknowns that have the same sigma, such as those of a bearing
    sigma: np.ndarray  # (A,) at hand

    def posterior(self, sigma: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Mean (Z,) of the weights for a ``sigma`` (A,), and a root (Z, Z) of their covariance ``root' root``."""
        root = invert_root(self.data + np.diag(self.precision(sigma)))
        return root.T @ (root @ self.right), root

    def precision(self, sigma: np.ndarray) -> np.ndarray:
        """(Z,) of the weights; zero for those behind the first."""
        return np.pad((self.unit / sigma[:, None] ** 2).ravel(), (0, len(self.right) - self.unit.size))

    def maximise(
        self,
        rounds: int = 60,
        still: float = 1e-2,
        smallest: float = 1e-4,
        largest: float = 1e3,
        tiny: float = 1e-12,
    ) -> np.ndarray:
        """(A,) sigma of the greatest likelihood, by MacKay's fixed point, until it changes by the share ``still``.

        A correction of a hundredth of a percent, the ``smallest``, is none. The ``largest`` is far beyond any: where
        readings tell nothing of a coefficient, the ratio of two roundings is no size.
        """
        sigma, unit = self.sigma, self.unit
        pace, before = np.ones_like(sigma), np.zeros_like(sigma)
        for _ in range(rounds):
            mean, root = self.posterior(sigma)
            # How many of an unknown's weights the readings determine.
            told = (1.0 - (self.precision(sigma) * (root**2).sum(0))[: unit.size]) * (unit.ravel() > 0)
            squares = (mean[: unit.size] ** 2 * unit.ravel()).reshape(unit.shape).sum(axis=1)
            told = told.reshape(unit.shape).sum(axis=1)
            likelier = np.sqrt(self.alike @ squares / np.maximum(self.alike @ told, tiny))
            step = np.log(np.clip(likelier, smallest, largest) / sigma)
            if (np.abs(step) < still).all():
                break
            # A size that vanishes loses the same share each round: steps that go on the same way double.
            pace = np.where(step * before > 0, 2 * pace, 1.0)
            sigma, before = np.clip(sigma * np.exp(pace * step), smallest, largest), step
        return sigma

    def is_chance(self, sigma: np.ndarray, count: int) -> bool:
        """Whether weights of no size show this ``sigma`` (A,) as likely, where ``count`` variances are free.

        Each of them is then zero or not by even odds, and gains chi-square (Self and Liang 1987).
        """
        from scipy.special import comb, gammaincc

        freedom, gain = np.arange(1, count + 1), max(self._gain(sigma), 0.0)
        return float((comb(count, freedom) * gammaincc(freedom / 2, gain)).sum() / 2.0**count) > LAW_STANDS

    def _gain(self, sigma: np.ndarray) -> float:
        """How much the logarithm of the likelihood, over all weights, rises from a sigma of zero to this one."""
        size, precision = self.unit.size, self.precision(sigma)
        whole, rest = self.data + np.diag(precision), self.data[size:, size:]
        both = 0.0
        for sign, matrix, right in ((1.0, whole, self.right), (-1.0, rest, self.right[size:])):
            scale = 1 / np.sqrt(np.diag(matrix))
            scaled = matrix * scale[:, None] * scale
            quadratic = (right * scale) @ np.linalg.solve(scaled, right * scale)
            both += sign * 0.5 * (quadratic - np.linalg.slogdet(scaled)[1] + 2 * np.log(scale).sum())
        return float(both + 0.5 * np.log(precision[:size]).sum())


def _expand(problem: OutputError, weights: torch.Tensor) -> Evidence:
    """The likelihood of a correction's weights about the minimum ``weights`` (1, 1, Z)."""
    unit, outer = unit_precision(problem).numpy(), problem.places.n_coefficients
    gradient, matrix = (array[0, 0].numpy() for array in problem.normal(weights))
    precision = (problem.precision * problem.kept).flatten().numpy()
    # At the minimum ``matrix z = matrix at - gradient``, whatever the precisions of the correction.
    right = matrix @ weights[0, 0].numpy() - gradient
    data = matrix - np.diag(np.pad(precision, (0, len(matrix) - outer)))
    bearing = np.array([m for m, _ in problem.active])
    sigma = np.sqrt(unit[:, -1] / precision.reshape(unit.shape)[:, -1])
    return Evidence(data, right, unit, (bearing[:, None] == bearing).astype(float), sigma)
