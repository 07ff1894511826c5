"""The answer that a population of bearings makes most likely: a tempered search over what kinds of bearings there are.

Each choice of a family for every bearing (:mod:`pipeline.laws.population`) is a prior of functions of the one problem.
For each, the problem is solved from the prior's mean and from draws, with readings that count little at first; in
coordinates in which the prior has unit variance. Choices count by their evidence (Laplace's approximation, in which the
volume counts in half), with the noise as large as the best of them leaves it. Where several are likely, what they
differ by is part of the covariance, and so is what the middle of a posterior and its peak differ by.

Legend: G choices and starts, B bearings, K nodes, A active unknowns, Z weights, Y numbers of unit variance.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from pipeline.data.operating import space_evenly
from pipeline.identification.families import Choices, Whitened
from pipeline.identification.noise_estimate import estimate_correlation, reshape_noise
from pipeline.identification.problem import OutputError, output_error
from pipeline.problem.ranking import rank

if TYPE_CHECKING:
    import torch


@dataclass(frozen=True, eq=False)
class Searched:
    """The answer of the likeliest choice, and those of others that are likely, too."""

    choices: Choices  # of the peaks, the best first, and then of their middles
    weights: torch.Tensor  # (G, 1, Z)
    covariance: torch.Tensor  # (G, Z, Z) of each by itself
    shares: np.ndarray  # (G,) of the evidence, with the sum one
    problem: OutputError  # without a prior of functions, at the noise as it is stated
    precision: float  # of the readings, over that: as much as the best leaves

    @property
    def kinds(self) -> dict[tuple[str, ...], float]:
        """The kinds of the bearings with their shares of the evidence, the likeliest first."""
        shares: dict[tuple[str, ...], float] = {}
        for kinds, share in zip(self.choices.families, self.shares.tolist(), strict=True):
            shares[kinds] = shares.get(kinds, 0.0) + share
        return {kinds: shares[kinds] for kinds in rank(shares)}

    def mix(self, covariance: np.ndarray, beyond: float = 0.05, reach: float = 0.5) -> np.ndarray:
        """(Z, Z) mean square of what is off: the best answer by its ``covariance``, others with what they differ by.

        A 95 % band must hold an answer whose share is ``beyond`` 5 %, which a mean square need not: such a one counts
        by ``reach`` at least, for which the band of a normal distribution ends 1.4 times as far away as it lies.
        """
        off = (self.weights - self.weights[:1])[:, 0].numpy()
        each = np.concatenate([covariance[None], self.covariance[1:].numpy()])
        held = np.maximum(self.shares, reach * np.minimum(1.0, (self.shares / beyond) ** 2))
        return np.asarray(np.einsum("gz,gy,g->zy", off, off, held) + np.einsum("gzy,g->zy", each, self.shares))


def search(
    problem: OutputError,
    choices: Choices,
    seed: int = 0,
    kept: int = 6,
    most_exact: float = 10.0,
    small: float = 0.05,
    coarse: float = 0.5,
    negligible: float = 0.01,
    again: bool = True,
) -> Searched:
    """The minima of the likely choices, at the noise that the best of them leaves, a tenth (``most_exact``) of the
    stated one at least. Directions of the priors whose deviation is ``small`` are left out at first, and so are
    tolerances of runs; where that leaves the readings farther off than noise over ``coarse``, no choice stays dropped.

    Where the best leaves deviations that wander over the speed, or whose floor beside their share is another than the
    stated one, the search is repeated (``again``) with such a noise.
    """
    import torch

    stated, (rough, parameters) = problem, _simplify(problem)
    firm = choices.select(choices.firm)  # ground that yields is tried beside the best of these
    main = firm.root.norm(dim=1).amax(dim=0) > small
    started, y = _descend(Whitened(rough, replace(firm, root=firm.root[..., main])), seed)
    likely = choices.select([choices.families.index(families) for families in started.choices.families])
    whitened = Whitened(problem, likely)
    # What the simpler problem lacks is as it was before the data.
    kept_rest = torch.ones(problem.places.n_rest - len(parameters), dtype=torch.bool)
    lifted = torch.zeros(len(y), 1, whitened.size, dtype=y.dtype)
    lifted[..., torch.cat([main, kept_rest, parameters])] = y
    explained = _noise(whitened, lifted)
    lifted = whitened.minimise(lifted, 1e-2, steps=8)  # evidence is that of minima
    problem, whitened, y = _settle(problem, whitened, lifted, kept, most_exact)
    if explained < coarse:  # the simpler problem could not tell which choices to drop
        problem, whitened, y = _settle(problem, *_take_up(whitened, choices, y), kept, most_exact)
    problem, whitened, y = look_beside(problem, whitened, choices, y, kept, most_exact)
    # To first order about one answer, another may explain readings that it does not: twice the logarithm of a posterior
    # was up to 150 too large, and a minimum about one answer could lie at another, whose minimum lay at the first.
    whitened = replace(whitened, problem=replace(problem, exact=True))
    for _ in range(2):  # the size of the noise is that of the exact minima
        precision = min(_noise(whitened, y), most_exact)
        scaled = replace(whitened, problem=whitened.problem.scaled(precision))
        y = scaled.minimise(y, 1e-4, steps=20)
    whitened, y, evidence = _rank(scaled, y, kept)
    problem = problem.update(whitened.weights(y)[:1])
    if again:
        best, at = replace(whitened.problem, functions=whitened.choices.functions()), whitened.weights(y)[:1]
        best = reshape_noise(best, at)
        noise, (correlation, _) = best.measurement.noise, estimate_correlation(best, at)
        if correlation > 0 or noise != problem.measurement.noise:
            changed = stated.with_noise(noise, stated.readings.measured).correlated(correlation)
            return search(changed, choices, seed, kept, most_exact, small, coarse, negligible, again=False)
    likely = (evidence > evidence[0] + np.log(negligible)).nonzero()[:, 0]
    return _add_middles(problem, whitened.at(likely), y[likely], precision)


def _add_middles(
    problem: OutputError, whitened: Whitened, y: torch.Tensor, precision: float, least: float = 0.05
) -> Searched:
    """What is searched, from the likely peaks ``y``, with the middles of their posteriors behind them: of choices whose
    share of the evidence is at ``least`` that.
    """
    import torch

    by_choice = whitened.evidence(y).softmax(0)
    counted = (by_choice >= least).nonzero()[:, 0]
    middles = torch.cat([find_middle(whitened.at(g), y[g]) for g in counted[:, None]])
    each = whitened.at(counted)
    within = (each.evidence(middles, counted=1.0) - each.evidence(y[counted], counted=1.0)).sigmoid()
    middle_shares = by_choice[counted] * within
    shares = torch.cat([by_choice.index_add(0, counted, -middle_shares), middle_shares])
    whitened = replace(whitened, choices=whitened.choices.join(each.choices))
    y = torch.cat([y, middles])
    root = whitened.carry(torch.eye(problem.places.size, dtype=y.dtype).expand(len(y), -1, -1))  # (G, Z, Y')
    covariance = root @ torch.linalg.inv(whitened.normal(y)[1][:, 0]) @ root.mT
    return Searched(whitened.choices, whitened.weights(y), covariance, shares.numpy(), problem, precision)


def find_middle(
    whitened: Whitened, y: torch.Tensor, turns: int = 8, usual: float = 0.5, least: float = 0.02, still: float = 0.05
) -> torch.Tensor:
    """The middle (1, 1, Y') of the posterior of one choice, from its peak ``y``.

    The peak of a density depends on the coordinates: it lies where they crowd. A rolling bearing makes the same bends
    of its compliance with smaller ones of the logarithm of its stiffness where it is softer, so the peak lies at soft
    ones, up to six deviations away from the middle. In coordinates of equal information everywhere it would lie where
    half the squares and the logarithm of the volume's root together are least (Druilhet and Marin 2007); for one number
    that is the median. From turn to turn the prior asks for a share of what balances their slopes, the ``usual`` one or
    less, as long as their sum falls, by ``still`` or more.
    """
    import torch

    asked, share = torch.zeros_like(y), usual
    height = -float(whitened.evidence(y, counted=1.0))
    for _ in range(turns):
        tried = asked + share * (whitened.balance(y) - asked)
        ahead = replace(whitened, asked=tried).minimise(y, 1e-6, steps=40)
        fallen = height + float(whitened.evidence(ahead, counted=1.0))
        if fallen > 0:
            asked, y, height, share = tried, ahead, height - fallen, min(1.5 * share, usual)
        else:
            share /= 3
        if 0 < fallen < still or share < least:
            break
    return y


def _settle(
    problem: OutputError, whitened: Whitened, y: torch.Tensor, kept: int, most_exact: float, turns: int = 5
) -> tuple[OutputError, Whitened, torch.Tensor]:
    """The ``problem`` with baseline and rotor as the best answer has them, and the likeliest minima, at the noise that
    the best of them leaves, once that changes by less than a tenth.

    To first order about what is stated, products of tolerances (gain and angle of a probe) would be missing: on one
    drawn machine a wrong kind of bearing then had 180 times the evidence of the real one.
    """
    share = np.inf
    for _ in range(turns):
        whitened, y, _ = _rank(whitened, y, kept)
        problem = problem.with_baseline(whitened.weights(y)[:1]).update(whitened.weights(y)[:1])
        before, share = share, min(_noise(replace(whitened, problem=problem), y), most_exact)
        whitened = replace(whitened, problem=problem.scaled(share))
        y = whitened.minimise(y, 1e-4, steps=20)
        if abs(share / before - 1) < 0.1:
            break
    return problem, whitened, y


def _take_up(whitened: Whitened, choices: Choices, y: torch.Tensor) -> tuple[Whitened, torch.Tensor]:
    """Those that are left, and then all ``choices``, each from where it is nearest to the best of them."""
    import torch

    n_weights, identity = whitened.problem.places.n_coefficients, torch.eye(choices.root.shape[-1], dtype=y.dtype)
    best = whitened.weights(y)[:1]
    off = best[:, 0, :n_weights, None] - choices.mean[..., None]
    nearest = torch.linalg.solve(choices.root.mT @ choices.root + 0.01 * identity, choices.root.mT @ off)
    starts = torch.cat([nearest.mT, best[..., n_weights:].expand(len(off), -1, -1)], dim=-1)
    every = replace(whitened, choices=whitened.choices.join(choices))
    return every, torch.cat([y, replace(whitened, choices=choices).minimise(starts, 1e-3, steps=12)])


def look_beside(
    problem: OutputError,
    whitened: Whitened,
    choices: Choices,
    y: torch.Tensor,
    kept: int,
    most_exact: float,
    turns: int = 5,
) -> tuple[OutputError, Whitened, torch.Tensor]:
    """The ``problem`` and the likeliest minima, once no choice is likelier that differs from the best at one bearing:
    the simpler problem may have dropped it. The rotor is solved at the best.
    """
    whitened, y, _ = _rank(whitened, y, kept)
    tried: set[tuple[str, ...]] = set()
    for _ in range(turns):
        best = whitened.choices.families[0]
        beside = choices.beside(best)
        # Two of about the same evidence take turns at being the best, with the rotor solved at one or the other.
        if best in tried or not beside.families:
            break
        tried.add(best)
        whitened, y, _ = _rank(*_take_up(whitened, beside, y), kept)
        whitened, y, _ = _rank(whitened, whitened.minimise(y, 1e-4, steps=40), kept)
        if whitened.choices.families[0] == best:
            break
        problem, whitened, y = _settle(problem, whitened, y, kept, most_exact)
        whitened, y, _ = _rank(whitened, y, kept)
    return problem.update(whitened.weights(y)[:1]), whitened, y


def _simplify(problem: OutputError, speeds: int = 40) -> tuple[OutputError, torch.Tensor]:
    """The problem of a few ``speeds`` that knows no tolerances of probes, weights and runs; (T,) parameters it has."""
    import torch

    measurement = problem.measurement
    kept = [parameter.row.scope != "run" for parameter in measurement.parameters]
    count = len(measurement.dataset.speeds)
    few = space_evenly(count, speeds)
    parameters = [replace(parameter, value=0.0) for parameter in itertools.compress(measurement.parameters, kept)]
    simpler = replace(measurement, parameters=tuple(parameters), solved=measurement.response)
    made = output_error(simpler.select(few), problem.basis, problem.plane_scale)
    return made.correlated(problem.readings.correlation ** (count / len(few))), torch.tensor(kept, dtype=torch.bool)


def _noise(whitened: Whitened, y: torch.Tensor) -> float:
    """What the precision is to be multiplied by, for the first choice to leave as much as is expected."""
    import torch

    problem, first, y = whitened.problem, replace(whitened, choices=whitened.choices.select([0])), y[:1]
    square = float(problem.rows(first.weights(y)).square().sum())
    told = y.shape[-1] - float(torch.linalg.inv(first.normal(y)[1][0, 0]).diagonal().sum())
    return float(np.sqrt(max(problem.readings.size - told, 1.0) / square))


def _descend(
    whitened: Whitened,
    seed: int,
    draws: int = 2,
    stages: Sequence[tuple[float, int, int]] = ((0.003, 8, 48), (0.05, 12, 32), (1.0, 20, 16)),
) -> tuple[Whitened, torch.Tensor]:
    """Minima of the likeliest choices, from each prior's mean and so many ``draws``.

    The ``stages`` are shares of the readings' weight, their most steps, and how many starts stay after them.
    """
    import torch

    n_choices, generator = len(whitened.choices.families), torch.Generator().manual_seed(seed)
    starts = replace(whitened, choices=whitened.choices.select([*range(n_choices)] * (1 + draws)))
    y = 0.7 * torch.randn(n_choices * (1 + draws), 1, starts.size, generator=generator, dtype=torch.float64)
    y[:n_choices] = 0.0
    y[..., starts.size - starts.problem.places.n_rest :] = 0.0
    for share, steps, most in stages:
        if share == 1.0:  # what the problem can't explain is noise, too
            share = min(share, _noise(starts, y) ** 2)
        tempered = replace(starts, problem=whitened.problem.scaled(share**0.5))
        tempered, y, _ = _rank(tempered, tempered.minimise(y, 1e-2, steps), most)
        starts = replace(starts, choices=tempered.choices)
    return starts, y


def _rank(
    whitened: Whitened, y: torch.Tensor, most: int, equal: float = 0.3
) -> tuple[Whitened, torch.Tensor, torch.Tensor]:
    """The likeliest minima, the best first, and their evidence; of a choice those of ``equal`` evidence are one."""
    evidence, families = whitened.evidence(y), whitened.choices.families
    order: list[int] = []
    for i in evidence.argsort(descending=True, stable=True).tolist():
        if len(order) < most and all(
            families[i] != families[j] or abs(float(evidence[i] - evidence[j])) > equal for j in order
        ):
            order.append(i)
    return replace(whitened, choices=whitened.choices.select(order)), y[order], evidence[order]
