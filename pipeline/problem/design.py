"""Choosing the runs that determine the unknowns best, before anything is measured.

Each run adds its Fisher information to that of the others, and a set of runs is judged without a simulation. By least
squares at each speed (:mod:`pipeline.problem.noise`) it is ``I = sum A_r' S_r^-1 A_r`` with the covariance S_r of its
residual.

Choosing the speeds or conditions as well, that reach a stated accuracy: each run adds its information in each state to
that of the others and of the priors, on the numbers that are sought, on residual unbalance and on the uncertain numbers
of the model. The deviations follow from the inverse (Cramer-Rao). They are those of a fit by the output error.
Coefficients are smooth functions of the speed, ``p_u(s) = size_u(s) (1 + sum_k z_uk f_k(s))``, and a state is a speed.
Of bearing laws it is a set of operating conditions, at all speeds.

Legend: C candidate runs, S speeds, U unknowns, M members (see :mod:`pipeline.problem.residual`), T states, P channels,
A active unknowns or numbers of laws, K functions, N real readings of a run in a state, Z columns of
:meth:`pipeline.problem.slopes.ReadingSlopes.rows`. SI units.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Literal

import numpy as np

from pipeline.data.dataset import VibrationDataset
from pipeline.data.simulate import add_noise
from pipeline.problem.law_information import law_rows
from pipeline.problem.measurement import Measurement
from pipeline.problem.noise import least_squares_deviation, whiten
from pipeline.problem.ranking import find_least
from pipeline.problem.residual import LinearResidual, bearing_equations, linear_residual, per_speed_least_squares
from pipeline.problem.slopes import ReadingSlopes, deviate, invert, prior_information, stack_rows

Criterion = Literal["A", "D"]


def run_information(white: LinearResidual, n_runs: int, size: np.ndarray) -> np.ndarray:
    """(C, M, S, U, U) information of each run on the unknowns relative to their ``size`` (M, S, U).

    ``white`` is a :func:`pipeline.problem.noise.whiten` residual of all candidates as its runs.
    """
    members, n_speeds, _, n_unknowns = white.matrix.shape
    rows = (white.matrix * size[:, :, None]).reshape(members, n_speeds, 2, n_runs, -1, n_unknowns)
    return np.asarray(np.einsum("mscriu,mscriv->rmsuv", rows, rows))


def merit(information: np.ndarray, present: np.ndarray, criterion: Criterion, prior_deviation: float = 1e3) -> float:
    """What a design minimises, from the information (M, S, U, U) of its runs; ``present`` (M, U).

    A: logarithm of the mean variance; D: of the volume of the confidence region; means over speeds and bearings. Every
    unknown is known beforehand to within ``prior_deviation`` times its size, so that sets too small to determine all of
    them compare.
    """
    total = 0.0
    for m, unknowns in enumerate(present):
        determined = information[m][:, unknowns][:, :, unknowns] + np.eye(int(unknowns.sum())) / prior_deviation**2
        if criterion == "D":
            total -= float(np.linalg.slogdet(determined)[1].mean()) / unknowns.sum()
        else:
            total += float(np.log(np.trace(np.linalg.inv(determined), axis1=1, axis2=2) / unknowns.sum()).mean())
    return total / len(present)


def choose(information: np.ndarray, present: np.ndarray, count: int, criterion: Criterion) -> tuple[int, ...]:
    """Indices of the best ``count`` candidates by the criterion, see :func:`exchange`."""
    return exchange(
        lambda runs: merit(information[list(runs)].sum(axis=0), present, criterion), len(information), count
    )


def exchange(
    merit_of: Callable[[Sequence[int]], float], n_candidates: int, count: int, least_gain: float = 1e-9
) -> tuple[int, ...]:
    """The ``count`` of ``n_candidates`` of the least merit: greedily one by one, then exchanged while it falls."""
    chosen: list[int] = []
    for _ in range(count):
        free = [c for c in range(n_candidates) if c not in chosen]
        chosen.append(find_least({c: merit_of([*chosen, c]) for c in free}))
    improved = True
    while improved:
        improved = False
        for place in range(count):
            others = [*chosen[:place], *chosen[place + 1 :]]
            free = [c for c in range(n_candidates) if c not in others]
            best = find_least({c: merit_of([*others, c]) for c in free})
            if merit_of(chosen) - merit_of([*others, best]) > least_gain:
                chosen, improved = [*others, best], True
    return tuple(sorted(chosen))


# --- what a set of runs would give -------------------------------------------------------------------


def whiten_plan(plan: Measurement, dataset: VibrationDataset, root: np.ndarray) -> LinearResidual:
    """The weighted equations of a ``dataset`` of the planned runs, whose residual has this ``root`` of covariance.

    A ``plan`` is simulated on the prior, which it has as known bearings.
    """
    return whiten(linear_residual(bearing_equations(plan.rotor, dataset), plan.unknowns, plan.known), root)


def unknown_sizes(plan: Measurement, floor: float = 0.01) -> np.ndarray:
    """(M, S, U) sizes of the unknowns, zero where a member lacks one; some cross zero: no less than a share ``floor``
    of the largest of their kind.
    """
    values = np.abs(plan.known.values)
    kinds = values.reshape(*values.shape[:2], 2, 4)
    least = np.repeat(floor * kinds.max(axis=-1), 4, axis=-1)
    return plan.unknowns.leading(np.maximum(values, least))


def predict_deviations(plan: Measurement) -> dict[str, float]:
    """Bearing and unknown -> predicted standard deviation of least squares over size, median over speed."""
    return _medians(plan, least_squares_deviation(whiten_plan(plan, plan.dataset, plan.residual_root(plan.known))))


def simulate_deviations(plan: Measurement, count: int, generator: np.random.Generator) -> dict[str, float]:
    """The same, as the spread of ``count`` weighted least-squares fits to noisy data."""
    root = plan.residual_root(plan.known)
    fits = [
        per_speed_least_squares(whiten_plan(plan, add_noise(plan.dataset, plan.deviation, generator), root))
        for _ in range(count)
    ]
    return _medians(plan, np.array(fits).std(axis=0, ddof=1))


def _medians(plan: Measurement, deviation: np.ndarray) -> dict[str, float]:
    spread, sizes = (plan.unknowns.to_active(values) for values in (deviation, unknown_sizes(plan)))
    return dict(zip(list_names(plan), np.median(spread / sizes, axis=0).tolist(), strict=True))


def list_names(plan: Measurement) -> tuple[str, ...]:
    """(A,) what the active unknowns are called, such as ``node 1 kxx``."""
    unknowns = plan.unknowns
    nodes = ["all bearings"] if unknowns.shared else [f"node {node}" for node in plan.rotor.bearing_nodes]
    return tuple(f"{nodes[m]} {unknowns.names[u]}" for m, u in unknowns.active)


# --- runs and states that reach an accuracy ------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Candidates:
    """What each run would tell in each state."""

    names: tuple[str, ...]  # A, such as "node 1 kxx"
    rows: np.ndarray  # (T, C, N, Z) derivative of the readings over their noise
    prior: np.ndarray  # (Z,) information before any reading
    slopes: np.ndarray  # (S, A, Z) relative change of what is named by the numbers; S = 1 where no speed matters
    wanted: np.ndarray  # (A,) bool: what the accuracy is asked of

    def deviation(self, states: Sequence[int], runs: Sequence[int]) -> np.ndarray:
        """(S, A) relative standard deviations, from these runs in each of these states."""
        rows = self.rows[np.ix_(list(states), list(runs))].reshape(-1, len(self.prior))
        return deviate(self.slopes, invert(rows.T @ rows + np.diag(self.prior)))

    def medians(self, states: Sequence[int], runs: Sequence[int]) -> dict[str, float]:
        """Name -> relative standard deviation, median over the speed."""
        return dict(zip(self.names, np.median(self.deviation(states, runs), axis=0).tolist(), strict=True))

    def worst(self, states: Sequence[int], runs: Sequence[int], mean_weight: float = 0.0) -> float:
        """The largest of :meth:`medians` among the wanted ones, and so much of their mean: it decides between two
        plans whose worst is the same.
        """
        medians = np.median(self.deviation(states, runs), axis=0)[self.wanted]
        return float(medians.max() + mean_weight * medians.mean())


def inform_coefficients(plan: Measurement, count: int, prior_deviation: float = 1e3) -> Candidates:
    """What the runs of a ``plan`` would tell of unknowns that are Chebyshev series of ``count`` terms.

    A plan is simulated on the prior, which it has as known bearings; its noise is the stated one. Every weight is known
    beforehand to ``prior_deviation`` sizes of its unknown, so that sets of too few runs compare, too.
    """
    n_speeds, active = len(plan.dataset.speeds), plan.unknowns.active
    place = np.linspace(-1.0, 1.0, n_speeds) if n_speeds > 1 else np.zeros(1)
    functions = np.polynomial.chebyshev.chebvander(place, count - 1)
    relative = np.einsum("ab,sk->sabk", np.eye(len(active)), functions).reshape(n_speeds, len(active), -1)
    size = plan.unknowns.to_active(unknown_sizes(plan))
    rows = ReadingSlopes(plan, plan.known).rows(size[..., None] * relative)
    prior = prior_information(plan, np.full(relative.shape[-1], prior_deviation**-2.0))
    slopes = np.pad(relative, ((0, 0), (0, 0), (0, len(prior) - relative.shape[-1])))
    by_run = np.concatenate([rows.real, rows.imag], axis=1).swapaxes(1, 2)
    return Candidates(list_names(plan), by_run, prior, slopes, np.ones(len(active), dtype=bool))


def inform_numbers(plans: Sequence[Measurement], wanted: Sequence[str]) -> Candidates:
    """What the runs would tell of the numbers of bearing laws, which are the same in all ``plans``, one a state."""
    numbers = plans[0].laws.parameters
    rows = np.stack([stack_rows(np.moveaxis(law_rows(plan), 2, 0)) for plan in plans])
    prior = prior_information(plans[0], np.array([number.deviation**-2 for number in numbers]))
    names = tuple(number.name for number in numbers)
    slopes = np.eye(len(names), len(prior))[None]
    return Candidates(names, rows, prior, slopes, np.array([name in wanted for name in names]))


@dataclass(frozen=True)
class Plan:
    """States and runs (indices), and the worst deviation with them."""

    states: tuple[int, ...]
    runs: tuple[int, ...]
    worst: float

    @property
    def every(self) -> int:
        """Every how many of the states, where they are evenly spaced."""
        return self.states[1] - self.states[0] if len(self.states) > 1 else 1


_Merit = Callable[[Sequence[int], Sequence[int]], float]
"""What sets of runs are sought by, of states and runs: smaller is better."""


def _choose_runs(
    candidates: Candidates, states: Sequence[int], most: int, accuracy: float, merits: Sequence[_Merit]
) -> Plan:
    """The fewest runs in these states whose worst deviation is within the ``accuracy``; else the best of ``most``."""
    n_runs, plan = candidates.rows.shape[1], Plan(tuple(states), (), np.inf)
    for count in range(1, min(most, n_runs) + 1):
        sets = [exchange(partial(merit, states), n_runs, count) for merit in merits]
        runs = find_least({tried: candidates.worst(states, tried) for tried in sets})
        plan = Plan(plan.states, runs, candidates.worst(states, runs))
        if plan.worst <= accuracy:
            break
    return plan


def plan_speeds(candidates: Candidates, accuracy: float, most_runs: int, steps: Sequence[int]) -> Plan:
    """The fewest runs, then the fewest speeds, whose worst unknown is known to ``accuracy``, median over the speed.

    Sets are sought by the mean variance, which leads there, and by the worst unknown, which is asked for.
    ``steps`` are ascending: each so many-th speed is measured. Where the accuracy can't be reached, the best of
    ``most_runs`` at all speeds.
    """
    n_speeds = len(candidates.rows)
    merits: list[_Merit] = [lambda *plan: float(np.log((candidates.deviation(*plan) ** 2).mean())), candidates.worst]
    best = _choose_runs(candidates, range(n_speeds), most_runs, accuracy, merits)
    for every in steps if best.worst <= accuracy else ():
        states = tuple(range(0, n_speeds, every))
        if (worst := candidates.worst(states, best.runs)) <= accuracy:
            best = Plan(states, best.runs, worst)
    return best


def plan_states(candidates: Candidates, most_runs: int, accuracy: float, most_sets: int = 2000) -> list[Plan]:
    """The best plan of one state, of two, ... until one reaches the ``accuracy``, with the fewest runs that do.

    States are chosen with all candidate runs, runs for these states. Of more than ``most_sets`` sets of states not each
    is tried, but single states are exchanged.
    """
    merit, plans = partial(candidates.worst, mean_weight=1e-3), list[Plan]()
    n_states, n_runs = candidates.rows.shape[:2]
    for count in range(1, n_states + 1):
        sets = list(itertools.islice(itertools.combinations(range(n_states), count), most_sets + 1))
        if len(sets) > most_sets:
            states = exchange(lambda chosen: merit(chosen, range(n_runs)), n_states, count)
        else:
            states = find_least({chosen: merit(chosen, range(n_runs)) for chosen in sets})
        plans.append(_choose_runs(candidates, states, most_runs, accuracy, [merit]))
        if plans[-1].worst <= accuracy:
            break
    return plans


def scale_to_limits(displacement: np.ndarray, limits: np.ndarray) -> np.ndarray:
    """(R,) by how much each run must be made smaller, at most 1, so that no orbit leaves its limit.

    Args:
        displacement: (S, B, 2, R) complex x and y at the bearings, m.
        limits: (B,) m, of the orbits' major semi-axes.
    """
    x, y = displacement[:, :, 0], displacement[:, :, 1]
    orbit = (np.abs(x + 1j * y) + np.abs(x - 1j * y)) / 2  # (S, B, R), forward and backward circle together
    return np.asarray(1.0 / np.maximum(1.0, (orbit / limits[:, None]).max(axis=(0, 1))))
