"""The operating conditions that could be set, and what runs in them would tell of the numbers of bearing laws.

Legend: S speeds, B bearings.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence

import numpy as np

from pipeline.config.operating import column_of
from pipeline.config.schema import Config
from pipeline.data.candidates import Runs
from pipeline.errors import ConfigError, nearest
from pipeline.laws.journal import JournalLaw
from pipeline.laws.law_set import LawSet
from pipeline.problem.law_design import LawCandidates
from pipeline.problem.law_information import add_rows, guess_table, inform, law_rows
from pipeline.problem.planning import Planner
from pipeline.rotor.bearing_table import BearingTable

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
