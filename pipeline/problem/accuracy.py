"""Choosing runs and speeds that reach a stated accuracy, before anything is measured.

The coefficients are smooth functions of the speed, ``p_u(s) = size_u(s) (1 + sum_k z_uk f_k(s))``, and each run adds
its Fisher information on the weights z, and on the uncertain numbers of the model, to that of the others and of the
priors. The deviation of a coefficient at a speed follows from the inverse (Cramer-Rao). It is that of a fit of these
functions by the output error.

Legend: C candidate runs, S speeds, P channels, A active unknowns, K functions, T model parameters, Z = A K + T. SI
units.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from pipeline.problem.design import exchange, unknown_sizes
from pipeline.problem.measurement import Measurement
from pipeline.problem.ranking import find_least
from pipeline.problem.slopes import ReadingSlopes


@dataclass(frozen=True, eq=False)
class RunInformation:
    """What each candidate run would tell at each speed."""

    names: tuple[str, ...]  # A, such as "node 1 kxx"
    functions: np.ndarray  # (S, K)
    rows: np.ndarray  # (C, S, 2 P, Z) derivative of the readings over their noise by weights and parameters
    n_parameters: int  # T
    prior_deviation: float = 1e3  # of every weight, in sizes of its unknown: sets of too few runs compare, too

    def deviation(self, runs: Sequence[int], every: int = 1) -> np.ndarray:
        """(S, A) relative standard deviation of the unknowns at all speeds, from ``runs`` at each ``every``-th one."""
        spread = np.linalg.inv(self._information(runs, every))
        count, n_active = self.functions.shape[1], len(self.names)
        blocks = np.stack([spread[a * count : (a + 1) * count, a * count : (a + 1) * count] for a in range(n_active)])
        return np.asarray(np.sqrt(np.einsum("sk,akl,sl->sa", self.functions, blocks, self.functions, optimize=True)))

    def _information(self, runs: Sequence[int], every: int) -> np.ndarray:
        """(Z, Z), of the priors too."""
        rows = self.rows[list(runs), ::every].reshape(-1, self.rows.shape[-1])
        prior = np.full(self.rows.shape[-1], self.prior_deviation**-2.0)
        prior[len(prior) - self.n_parameters :] = 1.0
        return np.asarray(rows.T @ rows + np.diag(prior))

    def medians(self, runs: Sequence[int], every: int = 1) -> dict[str, float]:
        """Relative standard deviation of each unknown, median over the speed."""
        median = np.median(self.deviation(runs, every), axis=0)
        return {name: float(value) for name, value in zip(self.names, median, strict=True)}

    def worst(self, runs: Sequence[int], every: int = 1) -> float:
        """The largest of :meth:`medians`."""
        return max(self.medians(runs, every).values())


def run_information(plan: Measurement, count: int) -> RunInformation:
    """What the runs of a ``plan`` would tell of unknowns that are Chebyshev series of ``count`` terms.

    A plan is simulated on the prior, which it has as known bearings; its noise is the stated one.
    """
    dataset, unknowns = plan.dataset, plan.unknowns
    place = np.linspace(-1.0, 1.0, len(dataset.speeds)) if len(dataset.speeds) > 1 else np.zeros(1)
    functions = np.polynomial.chebyshev.chebvander(place, count - 1)
    sizes = unknown_sizes(plan)  # (M, S, U)
    size = np.stack([sizes[m, :, u] for m, u in unknowns.active], axis=-1)
    slopes = ReadingSlopes(plan, plan.known)
    by_unknown = slopes.by_unknown * size[:, None, None]
    by_weight = np.einsum("spra,sk->sprak", by_unknown, functions).reshape(*by_unknown.shape[:3], -1)
    joined = np.sqrt(2.0) * np.concatenate([by_weight, slopes.by_model], axis=-1)
    rows = np.concatenate([joined.real, joined.imag], axis=1)
    nodes = ["all bearings"] if unknowns.shared else [f"node {node}" for node in plan.rotor.bearing_nodes]
    names = tuple(f"{nodes[m]} {unknowns.names[u]}" for m, u in unknowns.active)
    return RunInformation(names, functions, np.moveaxis(rows, 2, 0), len(plan.parameters))


@dataclass(frozen=True)
class Plan:
    """Runs (indices), every how many of the speeds, and whether that is accurate enough."""

    runs: tuple[int, ...]
    every: int
    reached: bool


def reach(information: RunInformation, accuracy: float, most_runs: int, steps: Sequence[int]) -> Plan:
    """The fewest runs, then the fewest speeds, whose worst unknown is known to ``accuracy``, median over the speed.

    Sets are sought by the mean variance, which leads there, and by the worst unknown, which is asked for.
    ``steps`` are ascending: each so many-th speed is measured. Where the accuracy can't be reached, the best of
    ``most_runs`` at all speeds.
    """
    runs: tuple[int, ...] = ()
    for count in range(1, min(most_runs, len(information.rows)) + 1):
        every_way = (partial(_merit, information), information.worst)
        sets = [exchange(merit, len(information.rows), count) for merit in every_way]
        runs = find_least({runs_tried: information.worst(runs_tried) for runs_tried in sets})
        if information.worst(runs) <= accuracy:
            enough = [every for every in steps if information.worst(runs, every) <= accuracy]
            return Plan(runs, max(enough, default=1), True)
    return Plan(runs, 1, False)


def _merit(information: RunInformation, runs: Sequence[int]) -> float:
    """Logarithm of the mean variance over unknowns and speeds."""
    return float(np.log((information.deviation(runs) ** 2).mean()))


def scale_to_limits(displacement: np.ndarray, limits: np.ndarray) -> np.ndarray:
    """(R,) by how much each run must be made smaller, at most 1, so that no orbit leaves its limit.

    Args:
        displacement: (S, B, 2, R) complex x and y at the bearings, m.
        limits: (B,) m, of the orbits' major semi-axes.
    """
    x, y = displacement[:, :, 0], displacement[:, :, 1]
    orbit = (np.abs(x + 1j * y) + np.abs(x - 1j * y)) / 2  # (S, B, R), forward and backward circle together
    return np.asarray(1.0 / np.maximum(1.0, (orbit / limits[:, None]).max(axis=(0, 1))))
