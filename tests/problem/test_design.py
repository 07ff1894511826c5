"""Runs, speeds and states that reach a stated accuracy: laws of the information."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from pipeline.config.compose import compose_config
from pipeline.data.excitation_files import list_candidates
from pipeline.data.simulate import add_noise
from pipeline.problem.design import (
    Candidates,
    choose,
    inform_coefficients,
    merit,
    plan_speeds,
    plan_states,
    scale_to_limits,
)
from pipeline.problem.planning import Planner, plan_coefficients
from pipeline.rotor.stored import load_rotor

COARSE = ["experiment=realistic", "machine.speeds={start_rpm: 900, stop_rpm: 5700, step_rpm: 240}"]
FEW = [*COARSE, "identify.unknowns=[kxx,kyy]", "design.functions=4"]


def planner(*overrides: str) -> Planner:
    """Of the machine of `realistic`."""
    config = compose_config(["stage=design", *overrides])
    return plan_coefficients(config, load_rotor(config.machine.rotor))


@pytest.fixture(scope="module")
def candidates() -> Candidates:
    """For all sixteen coefficients."""
    made = planner(*COARSE)
    (plan,) = made.measure(made.allowed)
    return inform_coefficients(plan, made.config.design.functions)


def test_more_is_never_worse(candidates: Candidates) -> None:
    """Another run and another speed lower every deviation, or leave it."""
    everywhere = range(len(candidates.rows))
    some, more = candidates.deviation(everywhere, (0, 5)), candidates.deviation(everywhere, (0, 2, 5))
    fewer = candidates.deviation(everywhere[::2], (0, 2, 5))
    assert (more <= some * (1 + 1e-9)).all()
    assert (more <= fewer * (1 + 1e-9)).all()
    assert (fewer > more).any()


@pytest.mark.slow
def test_the_fewest_runs_and_speeds_are_taken(candidates: Candidates) -> None:
    """What is said to be reached is; one run less, or every larger step, does not reach it."""
    best, everywhere = plan_speeds(candidates, 0.12, 4, [1, 2, 4]), range(len(candidates.rows))
    assert candidates.worst(best.states, best.runs) == best.worst <= 0.12
    assert best.states == tuple(everywhere[:: best.every])
    sets = itertools.combinations(range(candidates.rows.shape[1]), len(best.runs) - 1)
    assert min(candidates.worst(everywhere, runs) for runs in sets) > 0.12
    assert all(candidates.worst(everywhere[::k], best.runs) > 0.12 for k in (1, 2, 4) if k > best.every)
    assert plan_speeds(candidates, 1e-4, 2, [1]).worst > 1e-4


def test_the_deviation_is_that_of_linear_least_squares() -> None:
    """Noisy readings of one plan, each answered by the linearised model: the spread is the predicted one."""
    made = planner(*FEW, "~identify.model_parameters")
    (plan,) = made.measure(made.allowed[:2])
    told = inform_coefficients(plan, 4)
    rows = told.rows.reshape(-1, len(told.prior))
    generator, answers = np.random.default_rng(0), []
    for _ in range(300):
        off = (add_noise(plan.dataset, plan.deviation, generator).displacement - plan.dataset.displacement) * (
            np.sqrt(2.0) / plan.deviation
        )
        right = np.concatenate([off.real, off.imag], axis=1).swapaxes(1, 2).ravel()
        answers.append(told.slopes @ np.linalg.lstsq(rows, right, rcond=None)[0])
    assert np.std(answers, axis=0) == pytest.approx(told.deviation(range(len(told.rows)), (0, 1)), rel=0.2)


def test_orbits_stay_within_their_share() -> None:
    """Runs that were made smaller touch the limit; the others are as they were."""
    made = planner(*COARSE)
    possible = list_candidates(made.config.machine.candidates)
    allowed, again = made.allowed, made.limit(made.allowed)
    assert again == allowed or all(
        one[0].magnitude == pytest.approx(other[0].magnitude, rel=1e-12)
        for one, other in zip(again, allowed, strict=True)
    )
    assert any(one[0].magnitude < other[0].magnitude for one, other in zip(allowed, possible, strict=True))
    assert any(one == other for one, other in zip(allowed, possible, strict=True))
    circle = np.array([1.0, -1j]).reshape(1, 1, 2, 1) * 3e-6
    assert scale_to_limits(circle, np.array([1e-6])) == pytest.approx(1 / 3)
    assert scale_to_limits(circle, np.array([np.inf])) == pytest.approx(1.0)


# --- oil temperatures and runs for the numbers of bearing laws: the slope of a viscosity, in closed form -----

CHANGES = np.array([-10.0, -5.0, 0.0, 5.0, 20.0])  # K from the reference
SLOPE = 0.03  # 1/K
PRECISION = np.array([1e4, 4e4])  # of ln viscosity, by either run


def oils(wanted: tuple[bool, bool] = (True, True)) -> Candidates:
    """Each run reads the logarithm of the viscosity in each state, and nothing else."""
    rows = np.stack([np.ones(len(CHANGES)), -SLOPE * CHANGES], axis=1)
    readings = np.einsum("tz,c->tcz", rows, np.sqrt(PRECISION))[:, :, None]
    prior = np.log([1e6, 2.0]) ** -2
    return Candidates(("oil.viscosity", "oil.slope"), readings, prior, np.eye(2)[None], np.array(wanted))


def test_the_slope_wants_the_two_temperatures_that_lie_furthest_apart() -> None:
    """With the better run at both: its error of two viscosities over their distance."""
    one, two = plan_states(oils((False, True)), 1, 0.02)
    assert one.worst == pytest.approx(np.log(2.0), rel=0.05)  # at its prior
    assert (two.states, two.runs) == ((0, 4), (1,))
    assert two.worst == pytest.approx(np.hypot(1 / 200.0, 1 / 200.0) / (SLOPE * 30.0), rel=1e-3)


def test_no_more_runs_and_states_than_the_accuracy_needs() -> None:
    """The viscosity alone, at its reference: one state, one run; finer, both runs; finer still, every state."""
    (rough,) = plan_states(oils((True, False)), 2, 0.0051)
    assert (rough.states, rough.runs) == ((2,), (1,))
    (finer,) = plan_states(oils((True, False)), 2, 0.0046)
    assert (finer.states, finer.runs) == ((2,), (0, 1))
    assert finer.worst == pytest.approx(1 / np.sqrt(PRECISION.sum()), rel=1e-3)
    assert len(plan_states(oils((True, False)), 2, 0.0)) == 5


# --- from the command line ---------------------------------------------------------------------------------


def test_the_best_set_of_runs_is_found(rng: np.random.Generator) -> None:
    """Greedy exchange against the best of all sets, for random information; both criteria prefer more information."""
    rows = rng.normal(size=(8, 2, 3, 2, 4)) * 10.0 ** rng.uniform(-1, 1, (8, 1, 1, 1, 1))
    information = np.einsum("cmsru,cmsrv->cmsuv", rows, rows)
    present = np.ones((2, 4), dtype=bool)
    for criterion in ("A", "D"):
        sets = list(itertools.combinations(range(8), 3))
        values = [merit(information[list(s)].sum(axis=0), present, criterion) for s in sets]
        found = merit(information[list(choose(information, present, 3, criterion))].sum(axis=0), present, criterion)
        assert found <= np.sort(values)[2]  # an exchange may end at a neighbour of the best
        assert merit(information[:4].sum(axis=0), present, criterion) < merit(
            information[:3].sum(axis=0), present, criterion
        )
