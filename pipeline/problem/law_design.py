"""Which operating conditions and which runs bring the numbers of bearing laws to a stated accuracy, before measuring.

Legend: T states (operating conditions that could be set), C candidate runs, Th numbers, Z = Th + 2 N + model
parameters.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pipeline.problem.design import exchange
from pipeline.problem.law_information import LawInformation
from pipeline.problem.ranking import find_least


@dataclass(frozen=True, eq=False)
class LawCandidates:
    """What each run would tell in each state."""

    nothing: LawInformation  # the priors alone
    readings: np.ndarray  # (T, C, Z, Z)
    wanted: np.ndarray  # (Th,) bool: the numbers that the accuracy is asked of

    def with_runs(self, states: Sequence[int], runs: Sequence[int]) -> LawInformation:
        """The information of these runs in each of these states."""
        return self.nothing.plus(self.readings[np.ix_(list(states), list(runs))].sum(axis=(0, 1)))

    def worst(self, states: Sequence[int], runs: Sequence[int]) -> float:
        """Relative deviation of the number among the wanted ones that is known least."""
        return float(self.with_runs(states, runs).deviation[self.wanted].max())

    def merit(self, states: Sequence[int], runs: Sequence[int], mean_weight: float = 1e-3) -> float:
        """Smaller is better; the mean decides between two plans whose worst number is the same."""
        deviation = self.with_runs(states, runs).deviation[self.wanted]
        return float(deviation.max() + mean_weight * deviation.mean())


@dataclass(frozen=True)
class LawPlan:
    """States and runs (indices), and the worst deviation with them."""

    states: tuple[int, ...]
    runs: tuple[int, ...]
    worst: float


def plan_by_states(candidates: LawCandidates, most_states: int, most_runs: int, accuracy: float) -> list[LawPlan]:
    """The best plan of one state, of two, ... until one reaches the ``accuracy``, with the fewest runs that do.

    States are chosen with all candidate runs, runs for these states.
    """
    n_states, n_runs = candidates.readings.shape[:2]
    plans: list[LawPlan] = []
    for count in range(1, min(most_states, n_states) + 1):
        states = _choose_states(candidates, count)
        plans.append(_choose_runs(candidates, states, min(most_runs, n_runs), accuracy))
        if plans[-1].worst <= accuracy:
            break
    return plans


def _choose_states(candidates: LawCandidates, count: int, most_sets: int = 2000) -> tuple[int, ...]:
    """The best states; of more than ``most_sets`` sets not each is tried, but single states are exchanged."""
    n_states, n_runs = candidates.readings.shape[:2]

    def merit(states: Sequence[int]) -> float:
        return candidates.merit(states, range(n_runs))

    sets = list(itertools.islice(itertools.combinations(range(n_states), count), most_sets + 1))
    return (
        exchange(merit, n_states, count)
        if len(sets) > most_sets
        else find_least({chosen: merit(chosen) for chosen in sets})
    )


def _choose_runs(candidates: LawCandidates, states: tuple[int, ...], most: int, accuracy: float) -> LawPlan:
    n_runs, plan = candidates.readings.shape[1], LawPlan(states, (), np.inf)
    for count in range(1, most + 1):
        runs = exchange(lambda chosen: candidates.merit(states, chosen), n_runs, count)
        plan = LawPlan(states, runs, candidates.worst(states, runs))
        if plan.worst <= accuracy:
            break
    return plan
