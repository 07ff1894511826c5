"""Which operating conditions and which runs bring the numbers of bearing laws to a stated accuracy, before measuring.

Legend: T states (operating conditions that could be set), C candidate runs, Th numbers, Z = Th + 2 N + model
parameters.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from pipeline.config.operating import column_of
from pipeline.config.schema import Config
from pipeline.data.excitation_files import Runs
from pipeline.errors import ConfigError, nearest
from pipeline.laws.journal import JournalLaw
from pipeline.laws.law_set import LawSet
from pipeline.problem.design import exchange
from pipeline.problem.law_information import LawInformation, add_rows, guess_table, inform, law_rows
from pipeline.problem.planning import Planner
from pipeline.problem.ranking import find_least
from pipeline.rotor.bearing_table import BearingTable


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


State = Mapping[str, float]
"""Condition -> its value, SI."""


def clearances_of(laws: LawSet) -> np.ndarray:
    """(B,) m, infinite for a law without one."""
    return np.array([law.clearance.value if isinstance(law, JournalLaw) else np.inf for law in laws.laws])


def guess_at(config: Config, laws: LawSet, state: State) -> BearingTable:
    """The bearings as the laws' guesses have them, at the machine's speeds in a state."""
    speeds = config.machine.speeds.rad_s()
    return guess_table(laws, speeds, {name: np.full(len(speeds), value) for name, value in state.items()})


def list_states(config: Config, laws: LawSet) -> list[State]:
    """Every combination of the conditions that could be set. Raises ConfigError for one that is missing."""
    given = config.design.operating or config.machine.operating
    for name in laws.inputs:
        if name not in given:
            raise ConfigError(
                f"design.operating must have {name}, which the bearing laws need, but it has "
                f"{', '.join(given) or 'nothing'}: add the values that could be set, such as "
                f"{{{name}: [{', '.join(f'{n} {column_of(name).unit}' for n in (40, 55, 70))}]}}"
            )
    return [dict(zip(given, values, strict=True)) for values in itertools.product(*given.values())]


def inform_candidates(planner: Planner, laws: LawSet, runs: Runs, tables: Sequence[BearingTable]) -> LawCandidates:
    """What each run would tell on the bearings of each state (``tables``). Raises ConfigError for an unknown number."""
    names = [parameter.name for parameter in laws.parameters]
    asked = planner.config.design.numbers or names
    for name in asked:
        if name not in names:
            raise ConfigError(
                f"design.numbers must be unknown numbers of machine.laws, but got {name}: {nearest(name, names)}"
            )
    plans = [planner.measure(runs, table) for table in tables]
    nothing = inform(plans[0])
    readings = [[add_rows(rows) for rows in np.moveaxis(law_rows(plan), 2, 0)] for plan in plans]
    return LawCandidates(nothing.alone(), np.array(readings), np.array([name in asked for name in names]))
