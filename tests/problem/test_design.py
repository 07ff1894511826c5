"""Runs, speeds and states that reach a stated accuracy: laws of the information, what is said, and fits."""

from __future__ import annotations

import itertools
import json
from pathlib import Path

import numpy as np
import pytest
from conftest import Run, assert_says

from pipeline.config.compose import compose_config
from pipeline.data.excitation_files import list_candidates
from pipeline.data.simulate import add_noise
from pipeline.errors import ConfigError
from pipeline.problem.design import Candidates, inform_coefficients, plan_speeds, plan_states, scale_to_limits
from pipeline.problem.planning import Planner, plan_coefficients, reach
from pipeline.rotor.stored import load_rotor
from pipeline.stages import robustness

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


@pytest.mark.slow
def test_what_can_be_reached_is_written_and_can_be_used(run: Run, tmp_path: Path) -> None:
    """Sixteen coefficients at 5 % with a force that turns backward."""
    run("design", ["experiment=realistic", "design.accuracy=0.05"], tmp_path)
    about = json.loads((tmp_path / "design.json").read_text())
    assert (about["reached"], len(about["predicted"])) == (True, 16)
    assert max(about["predicted"].values()) <= 0.05
    config = compose_config(["experiment=realistic", f"machine.runs_file='{tmp_path / 'designed_excitation.yaml'}'"])
    assert [one.name for one in config.machine.runs] == about["runs"]
    assert any(force.whirl == "backward" for one in config.machine.runs for force in one.forces)


@pytest.mark.slow
def test_what_cannot_be_reached_is_said_with_a_cure(
    run: Run, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Weights alone whirl forward."""
    run("design", [*COARSE, "design.accuracy=0.1", "machine.candidates.force_nodes=[]"], tmp_path)
    about = json.loads((tmp_path / "design.json").read_text())
    assert not about["reached"]
    assert (
        about["cures"]["a force that turns backward"]
        <= 0.1
        < min(of for name, of in about["cures"].items() if name != "a force that turns backward")
    )
    assert_says(
        capsys.readouterr().out,
        *("10 % can't be reached with 3 runs for 16 of 16 coefficients; the worst, node", "(enough)"),
    )


@pytest.mark.slow
def test_probes_on_casings_are_a_cure() -> None:
    """What they are said to bring is what a machine that has them reaches."""
    support = "{kxx: 1e8 N/m, kyy: 2e8 N/m, cxx: 5e3 N s/m, cyy: 8e3 N s/m, mxx: 20 kg, myy: 20 kg"
    soft = [
        *(*FEW, "machine.as_built=null", "identify.known_within=30"),
        "identify.model_parameters={support_stiffness: 1}",
        f"+machine.rotor.supports=[{support}, node: 1}}, {support}, node: 6}}]",
    ]
    probes = [
        f"{{node: {node}, measures: {what}, angle: {angle} deg}}"
        for what, node, angle in itertools.product(("shaft", "casing"), (1, 6), (0, 90))
    ]
    few, more = (reach(planner(*soft, f"machine.probes.at=[{', '.join(probes[:count])}]"), 0.001) for count in (4, 8))
    assert few[0].worst > few[2]["probes on the casings of nodes 1, 6"] == pytest.approx(more[0].worst, rel=1e-9)


def test_a_wrong_accuracy_is_refused() -> None:
    """By name."""
    with pytest.raises(ConfigError, match=r"design\.accuracy"):
        compose_config(["stage=design", "experiment=realistic", "design.accuracy=0"])


@pytest.mark.slow
def test_fits_of_the_designed_runs_are_as_accurate_as_predicted(run: Run, tmp_path: Path) -> None:
    """Median errors of normal deviates are 0.6745 of the deviation: their mean ratio, as built."""
    run("design", [*FEW, "design.accuracy=0.02"], tmp_path)
    about = json.loads((tmp_path / "design.json").read_text())
    series = ["model=chebyshev", "model.count=3", "model.trend=false", "model.input_scaling=rpm"]
    file = f"machine.runs_file='{tmp_path / 'designed_excitation.yaml'}'"
    config = compose_config(["stage=robustness", *FEW, *series, file])
    error = np.array([robustness.measure_again(config, seed).error for seed in range(6)])
    ratio = error / (67.45 * np.array(list(about["predicted"].values())))
    print(f"error over prediction {ratio.mean():.2f}")
    assert 0.6 < ratio.mean() < 1.6
