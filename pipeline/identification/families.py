"""Families of the bearings (:mod:`pipeline.laws.population`), and the one problem in numbers of unit variance before
the data.

Legend: G choices and starts, B bearings, K nodes, A active unknowns, Z weights, Y numbers of unit variance.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from operator import ne
from typing import TYPE_CHECKING

import numpy as np

from pipeline.config.identification import LevenbergMarquardtConfig
from pipeline.errors import ConfigError
from pipeline.identification.blocks import Prior
from pipeline.identification.optimizers import LeastSquares, levenberg_marquardt, until_still
from pipeline.identification.problem import OutputError
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
        """Those that differ from ``families`` at one bearing, or in the ground alone."""
        keys = [
            (any(prior.yields for prior in several), *(prior.family for prior in several)) for several in self.priors
        ]
        best = keys[self.families.index(families)]
        return self.select([i for i, key in enumerate(keys) if sum(map(ne, key, best)) == 1])

    @property
    def families(self) -> tuple[tuple[str, ...], ...]:
        """Names of the families."""
        return tuple(tuple(prior.name for prior in several) for several in self.priors)

    @property
    def firm(self) -> list[int]:
        """Places of those on ground that does not yield."""
        return [i for i, several in enumerate(self.priors) if not any(prior.yields for prior in several)]

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
    every: list[tuple[FamilyPrior, ...]] = []
    for yields in (False, True):
        priors = []
        for m, (load, diameter) in enumerate(zip(find_static_loads(rotor), estimate_journals(rotor), strict=True)):
            coordinates = list_places([unknowns.names[u] for member, u in unknowns.active if member == m])
            made = make_priors(families, nodes, float(load), float(diameter), yields=yields)
            priors.append([prior.select(coordinates) for prior in made])
        product = list(itertools.product(*priors))
        product = product if len(product) <= most else list(zip(*priors, strict=True))
        every += [several for several in product if any(prior.yields for prior in several) == yields]
    axes = {prior: _axes(prior, negligible) for prior in itertools.chain(*every)}
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
    asked: torch.Tensor | float = 0.0  # (1, 1, Y') the middle of the priors

    @property
    def size(self) -> int:
        """Y'."""
        return int(self.choices.root.shape[-1]) + self.problem.places.n_rest

    @property
    def middle(self) -> torch.Tensor:
        """(.., Y') the numbers that the priors ask for."""
        import torch

        return torch.zeros(self.size, dtype=torch.float64) + self.asked

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

        rows, count, middle = self.problem.rows(self.weights(y)), self.choices.root.shape[-1], self.middle
        end = rows.shape[-1] - len(self.problem.prior) + self.problem.places.size  # of the parameters' priors
        parameters = self.problem.places.n_parameters
        rows[..., end - parameters : end] -= middle[..., self.size - parameters :]
        return torch.cat([rows, (y - middle)[..., :count]], dim=-1)

    def normal(self, y: torch.Tensor, /) -> tuple[torch.Tensor, torch.Tensor]:
        """Gradient (G, 1, Y') and information (G, 1, Y', Y')."""
        import torch

        gradient, matrix = self.problem.normal(self.weights(y))
        prior = (torch.arange(self.size) < self.choices.root.shape[-1]).to(y.dtype)  # one for numbers of the choices
        information = self.carry(self.carry(matrix[:, 0]).mT)[:, None] + torch.diag(prior)
        return self.carry(gradient) + prior * y - self.middle, information

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

    def volume(self, y: torch.Tensor) -> torch.Tensor:
        """(G,) of the determinant of the information, the logarithm of its root: it falls as the answer gets vaguer."""
        import torch

        determinant: torch.Tensor = torch.linalg.slogdet(self.normal(y)[1][:, 0])[1]
        return determinant / 2

    def balance(self, y: torch.Tensor, held: float = 9.0) -> torch.Tensor:
        """(G, 1, Y') where priors must have the numbers for the minimum to lie where the volume has the slope of ``y``;
        zero for residual unbalance, which has none.

        Directions of which the readings tell more than ``held`` times the prior are left where they are, near enough:
        the slope there is that of a curved valley, and priors that ask for much lead away from it.
        """
        import torch

        with torch.enable_grad():
            free = y.detach().requires_grad_()
            information = self.normal(free)[1][:, 0]
            (slope,) = torch.autograd.grad(torch.linalg.slogdet(information)[1].sum() / 2, free)
        information = information.detach() + held * torch.eye(self.size, dtype=y.dtype)
        asked: torch.Tensor = -(1 + held) * torch.linalg.solve(information, slope.mT).mT
        count, parameters = self.choices.root.shape[-1], self.problem.places.n_parameters
        asked[..., count : self.size - parameters] = 0.0
        return asked

    def evidence(self, y: torch.Tensor, counted: float = 0.5) -> torch.Tensor:
        """(G,) logarithm of the evidence about minima, up to a constant; minus infinity where there is none.

        A family's evidence falls with the width of its prior, which was chosen, not measured: counted in full, narrow
        families win that explain less. The posterior at its peak knows no width, and favours families that say nothing.
        So the volume about the peak is ``counted`` in half, which is the geometric mean of both (studies/ordinary).
        """

        evidence: torch.Tensor = -self.rows(y).square().sum(-1)[:, 0] / 2 - counted * self.volume(y)
        return evidence.nan_to_num(-float("inf"), neginf=-float("inf"))
