"""The answer that a population of bearings makes most likely: a tempered search over what kinds of bearings there are.

Each choice of a family for every bearing (:mod:`pipeline.laws.population`) is a prior of functions of the one problem.
For each, the problem is solved from the prior's mean and from draws, with readings that count little at first; in
coordinates in which the prior has unit variance. Choices count by their evidence (Laplace's approximation, in which the
volume counts in half), with the noise as large as the best of them leaves it. Where several are likely, what they
differ by is part of the covariance.

Legend: G choices and starts, B bearings, K nodes, A active unknowns, Z weights, Y numbers of unit variance.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from pipeline.config.identification import LevenbergMarquardtConfig
from pipeline.errors import ConfigError
from pipeline.identification.blocks import Prior
from pipeline.identification.noise_estimate import estimate_correlation, reshape_noise
from pipeline.identification.optimizers import LeastSquares, levenberg_marquardt, until_still
from pipeline.identification.problem import OutputError, output_error
from pipeline.impedance import list_places
from pipeline.laws.population import FamilyPrior, make_priors
from pipeline.problem.measurement import Measurement
from pipeline.rotor.weight import estimate_journals, find_static_loads

if TYPE_CHECKING:
    import torch


@dataclass(frozen=True, eq=False)
class Choices:
    """Families of the bearings, and what they make of the coefficients' weights before the data: ``mean + root y``."""

    priors: tuple[tuple[FamilyPrior, ...], ...]  # G of B
    mean: torch.Tensor  # (G, A K)
    root: torch.Tensor  # (G, A K, Y)

    def select(self, at: Sequence[int]) -> Choices:
        """Those at these places."""
        index = list(at)
        return Choices(tuple(self.priors[i] for i in index), self.mean[index], self.root[index])

    def join(self, more: Choices) -> Choices:
        """These, and then ``more`` of them."""
        import torch

        return Choices(self.priors + more.priors, torch.cat([self.mean, more.mean]), torch.cat([self.root, more.root]))

    def beside(self, families: tuple[str, ...]) -> Choices:
        """Those that differ from ``families`` at one bearing."""
        differ = [sum(a != b for a, b in zip(others, families, strict=True)) for others in self.families]
        return self.select([i for i, count in enumerate(differ) if count == 1])

    @property
    def families(self) -> tuple[tuple[str, ...], ...]:
        """Names of the families."""
        return tuple(tuple(prior.family for prior in several) for several in self.priors)

    def functions(self) -> Prior:
        """The prior of the first choice as whitened rows."""
        import torch

        root = torch.block_diag(*(torch.as_tensor(prior.root) for prior in self.priors[0]))
        rows = torch.linalg.solve_triangular(root, torch.eye(len(root), dtype=root.dtype), upper=False)
        return Prior(rows, rows @ self.mean[0])


def list_choices(
    measurement: Measurement, families: Sequence[str], nodes: np.ndarray, most: int = 36, negligible: float = 1e-3
) -> Choices:
    """Every choice of the ``families`` over the bearings, at nodes (K,) rad/s; the same family for all bearings where
    that were more than ``most``. Directions whose deviation is ``negligible`` are left out.

    Raises ConfigError for bearings that share coefficients, ties between these, and direct ones that are known.
    """
    import torch

    rotor, unknowns = measurement.rotor, measurement.unknowns
    if unknowns.shared or (np.abs(unknowns.expansion).sum(axis=1) > 1).any():
        raise ConfigError(
            "a population of bearings must have identify.shared=false and identify.structure=none, since each bearing "
            "and direction has coordinates of its own: leave these out, or choose model=network_fluid_film"
        )
    priors = []
    for m, (load, diameter) in enumerate(zip(find_static_loads(rotor), estimate_journals(rotor), strict=True)):
        coordinates = list_places([unknowns.names[u] for member, u in unknowns.active if member == m])
        made = make_priors(families, nodes, float(load), float(diameter))
        priors.append([prior.select(coordinates) for prior in made])
    every: list[tuple[FamilyPrior, ...]] = list(itertools.product(*priors))
    if len(every) > most:
        every = list(zip(*priors, strict=True))
    axes = {prior: _axes(prior, negligible) for prior in itertools.chain(*priors)}
    count = max(root.shape[1] for root in axes.values())
    wide = {prior: torch.nn.functional.pad(root, (0, count - root.shape[1])) for prior, root in axes.items()}
    return Choices(
        tuple(every),
        torch.stack([torch.as_tensor(np.concatenate([prior.mean for prior in several])) for several in every]),
        torch.stack([torch.block_diag(*(wide[prior] for prior in several)) for several in every]),
    )


def _axes(prior: FamilyPrior, negligible: float) -> torch.Tensor:
    """(.., n) principal axes of a prior, each as long as its deviation."""
    import torch

    left, deviations, _ = np.linalg.svd(prior.root)
    kept = deviations > negligible
    return torch.as_tensor(left[:, kept] * deviations[kept])


@dataclass(frozen=True, eq=False)
class Whitened(LeastSquares):
    """A problem in numbers (G, 1, Y') of unit variance before the data: those of the choices, and all other weights."""

    problem: OutputError  # without a prior of functions
    choices: Choices

    @property
    def size(self) -> int:
        """Y'."""
        return int(self.choices.root.shape[-1]) + self.problem.places.n_rest

    def carry(self, by_weights: torch.Tensor) -> torch.Tensor:
        """Derivatives (G, .., Z) by the weights as those (G, .., Y') by the numbers."""
        import torch

        alone, rest = by_weights.tensor_split([self.problem.places.n_coefficients], dim=-1)
        return torch.cat([alone @ self.choices.root, rest], dim=-1)

    def weights(self, y: torch.Tensor) -> torch.Tensor:
        """(G, 1, Z)."""
        import torch

        alone, rest = y.tensor_split([self.choices.root.shape[-1]], dim=-1)
        return torch.cat([self.choices.mean[:, None] + alone @ self.choices.root.mT, rest], dim=-1)

    def rows(self, y: torch.Tensor, /) -> torch.Tensor:
        """(G, 1, rows), the numbers of the choices last."""
        import torch

        return torch.cat([self.problem.rows(self.weights(y)), y[..., : self.choices.root.shape[-1]]], dim=-1)

    def normal(self, y: torch.Tensor, /) -> tuple[torch.Tensor, torch.Tensor]:
        """Gradient (G, 1, Y') and information (G, 1, Y', Y')."""
        import torch

        gradient, matrix = self.problem.normal(self.weights(y))
        prior = (torch.arange(self.size) < self.choices.root.shape[-1]).to(y.dtype)  # one for numbers of the choices
        return self.carry(gradient) + prior * y, self.carry(self.carry(matrix[:, 0]).mT)[:, None] + torch.diag(prior)

    def level(self, squared: torch.Tensor, /) -> torch.Tensor:
        """(G, 1) root of the mean square of all rows."""
        return (squared / self.problem.readings.size).sqrt()

    def at(self, starts: torch.Tensor, /) -> Whitened:
        """That of some choices."""
        every = len(starts) == len(self.choices.priors)
        return self if every else replace(self, choices=self.choices.select(starts.tolist()))

    def minimise(self, y: torch.Tensor, still: float, steps: int = 25) -> torch.Tensor:
        """Where all choices end, once no step lowers a loss by the share ``still``."""
        section = LevenbergMarquardtConfig(steps=steps, patience=1, initial_damping=1e-3)
        return levenberg_marquardt(self, y, section, until_still(still), by_diagonal=True)

    def evidence(self, y: torch.Tensor, counted: float = 0.5) -> torch.Tensor:
        """(G,) logarithm of the evidence about minima, up to a constant; minus infinity where there is none.

        A family's evidence falls with the width of its prior, which was chosen, not measured: counted in full, narrow
        families win that explain less. The posterior at its peak knows no width, and favours families that say nothing.
        So the volume about the peak is ``counted`` in half, which is the geometric mean of both (studies/ordinary).
        """
        import torch

        volume = torch.linalg.slogdet(self.normal(y)[1][:, 0])[1]
        evidence: torch.Tensor = -(self.rows(y).square().sum(-1)[:, 0] + counted * volume) / 2
        return evidence.nan_to_num(-float("inf"), neginf=-float("inf"))


@dataclass(frozen=True, eq=False)
class Searched:
    """The most likely answer, and others that are likely, too."""

    choices: Choices  # the best first
    weights: torch.Tensor  # (G, 1, Z)
    covariance: torch.Tensor  # (G, Z, Z) of each by itself
    shares: np.ndarray  # (G,) of the evidence, with the sum one
    problem: OutputError  # without a prior of functions, at the noise as it is stated
    precision: float  # of the readings, over that: as much as the best leaves

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
    main = choices.root.norm(dim=1).amax(dim=0) > small
    started, y = _descend(Whitened(rough, replace(choices, root=choices.root[..., main])), seed)
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
    problem, whitened, y, evidence = look_beside(problem, whitened, choices, y, kept, most_exact)
    precision = min(_noise(replace(whitened, problem=problem), y), most_exact)
    if again:
        best, at = replace(whitened.problem, functions=whitened.choices.functions()), whitened.weights(y)[:1]
        best = reshape_noise(best, at)
        noise, (correlation, _) = best.measurement.noise, estimate_correlation(best, at)
        if correlation > 0 or noise != problem.measurement.noise:
            changed = stated.with_noise(noise, stated.readings.measured).correlated(correlation)
            return search(changed, choices, seed, kept, most_exact, small, coarse, again=False)
    shares = np.asarray((evidence - evidence[0]).exp())
    root = whitened.carry(torch.eye(problem.places.size, dtype=y.dtype).expand(len(y), -1, -1))  # (G, Z, Y')
    covariance = root @ torch.linalg.inv(whitened.normal(y)[1][:, 0]) @ root.mT
    return Searched(whitened.choices, whitened.weights(y), covariance, shares / shares.sum(), problem, precision)


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
) -> tuple[OutputError, Whitened, torch.Tensor, torch.Tensor]:
    """The ``problem``, the likeliest minima and their evidence, once no choice is likelier that differs from the best
    at one bearing: the simpler problem may have dropped it. The rotor is solved at the best.
    """
    whitened, y, evidence = _rank(whitened, y, kept)
    for _ in range(turns):
        best = whitened.choices.families[0]
        if not (beside := choices.beside(best)).families:
            break
        whitened, y, _ = _rank(*_take_up(whitened, beside, y), kept)
        whitened, y, evidence = _rank(whitened, whitened.minimise(y, 1e-4, steps=40), kept)
        if whitened.choices.families[0] == best:
            break
        problem, whitened, y = _settle(problem, whitened, y, kept, most_exact)
        whitened, y, evidence = _rank(whitened, y, kept)
    return problem.update(whitened.weights(y)[:1]), whitened, y, evidence


def _simplify(problem: OutputError, speeds: int = 40) -> tuple[OutputError, torch.Tensor]:
    """The problem of a few ``speeds`` that knows no tolerances of probes, weights and runs; (T,) parameters it has."""
    import torch

    measurement = problem.measurement
    kept = [parameter.row.scope != "run" for parameter in measurement.parameters]
    count = len(measurement.dataset.speeds)
    few = np.unique(np.linspace(0, count - 1, min(count, speeds)).round().astype(int))
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
