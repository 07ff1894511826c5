"""Choosing oil temperatures and runs: the slope of a viscosity, in closed form."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.laws.numbers import LawParameter
from pipeline.problem.law_design import LawCandidates, plan_by_states
from pipeline.problem.law_information import LawInformation

CHANGES = np.array([-10.0, -5.0, 0.0, 5.0, 20.0])  # K from the reference
SLOPE = 0.03  # 1/K
PRECISION = np.array([1e4, 4e4])  # of ln viscosity, by either run


def candidates(wanted: tuple[bool, bool] = (True, True)) -> LawCandidates:
    """Each run reads the logarithm of the viscosity in each state, and nothing else."""
    numbers = (
        LawParameter("oil.viscosity", "Pa * s", 0.02, 1e6, None),
        LawParameter("oil.slope", "1 / K", SLOPE, 2.0, None),
    )
    rows = np.stack([np.ones(len(CHANGES)), -SLOPE * CHANGES], axis=1)
    readings = np.einsum("ta,tb,c->tcab", rows, rows, PRECISION)
    return LawCandidates(LawInformation(numbers, np.zeros((2, 2)), 0), readings, np.array(wanted))


def test_the_slope_wants_the_two_temperatures_that_lie_furthest_apart() -> None:
    """With the better run at both: its error of two viscosities over their distance."""
    one, two = plan_by_states(candidates((False, True)), 5, 1, 0.02)
    assert one.worst == pytest.approx(np.log(2.0), rel=0.05)  # at its prior
    assert two.states == (0, 4)
    assert two.runs == (1,)
    assert two.worst == pytest.approx(np.hypot(1 / 200.0, 1 / 200.0) / (SLOPE * 30.0), rel=1e-3)


def test_no_more_runs_and_states_than_the_accuracy_needs() -> None:
    """The viscosity alone, at its reference: one state, one run; finer, both runs; finer still, every state."""
    (rough,) = plan_by_states(candidates((True, False)), 5, 2, 0.0051)
    assert (rough.states, rough.runs) == ((2,), (1,))
    (finer,) = plan_by_states(candidates((True, False)), 5, 2, 0.0046)
    assert (finer.states, finer.runs) == ((2,), (0, 1))
    assert finer.worst == pytest.approx(1 / np.sqrt(PRECISION.sum()), rel=1e-3)
    assert len(plan_by_states(candidates((True, False)), 5, 2, 0.0)) == 5
