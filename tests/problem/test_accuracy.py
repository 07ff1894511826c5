"""Runs and speeds that reach a stated accuracy: laws of the information, what is said, and fits."""

from __future__ import annotations

import itertools
import json
from pathlib import Path

import numpy as np
import pytest
from conftest import Run

from pipeline.config.compose import compose_config
from pipeline.data.excitation_files import list_candidates
from pipeline.data.simulate import add_noise
from pipeline.errors import ConfigError
from pipeline.problem.accuracy import RunInformation, reach, run_information, scale_to_limits
from pipeline.problem.planning import Designer, Planner, list_clearances
from pipeline.rotor.stored import load_modelled_bearings, load_rotor
from pipeline.stages import refit_study
from pipeline.units import RAD_S_PER_RPM

COARSE = ["experiment=realistic", "machine.speeds={start_rpm: 900, stop_rpm: 5700, step_rpm: 240}"]
FEW = [*COARSE, "identify.unknowns=[kxx,kyy]", "design.functions=4"]


def designer(*overrides: str) -> Designer:
    """Of the machine of `realistic`."""
    config = compose_config(["stage=design", *overrides])
    machine = config.machine
    speeds = np.array(machine.speeds.rpm()) * RAD_S_PER_RPM
    rotor, prior = load_rotor(machine.rotor), load_modelled_bearings(machine.rotor, machine.bearings, speeds)
    planner = Planner(config, rotor, list_clearances(config, rotor))
    return Designer(planner, prior, planner.limit(list_candidates(machine.candidates), prior))


@pytest.fixture(scope="module")
def information() -> RunInformation:
    """Of every candidate, for all sixteen coefficients."""
    made = designer(*COARSE)
    return made.inform(made.measure(made.allowed))


def test_more_is_never_worse(information: RunInformation) -> None:
    """Another run and another speed lower every deviation, or leave it."""
    some, more = information.deviation((0, 5)), information.deviation((0, 2, 5))
    fewer = information.deviation((0, 2, 5), every=2)
    assert (more <= some * (1 + 1e-9)).all()
    assert (more <= fewer * (1 + 1e-9)).all()
    assert (fewer > more).any()


def test_the_fewest_runs_and_speeds_are_taken(information: RunInformation) -> None:
    """What is said to be reached is; one run less, or every larger step, does not reach it."""
    found = reach(information, 0.12, 4, [1, 2, 4])
    assert found.reached
    assert information.worst(found.runs, found.every) <= 0.12
    sets = itertools.combinations(range(len(information.rows)), len(found.runs) - 1)
    assert min(information.worst(runs) for runs in sets) > 0.12
    assert all(information.worst(found.runs, k) > 0.12 for k in (1, 2, 4) if k > found.every)
    assert not reach(information, 1e-4, 2, [1]).reached


def test_the_deviation_is_that_of_linear_least_squares() -> None:
    """Noisy readings of one plan, each answered by the linearised model: the spread is the predicted one."""
    made = designer(*FEW, "~identify.model_parameters")
    plan = made.measure(made.allowed[:2])
    found = run_information(plan, 4)
    rows = found.rows.reshape(-1, found.rows.shape[-1])
    generator, answers = np.random.default_rng(0), []
    for _ in range(300):
        off = (add_noise(plan.dataset, plan.deviation, generator).displacement - plan.dataset.displacement) * (
            np.sqrt(2.0) / plan.deviation
        )
        right = np.moveaxis(np.concatenate([off.real, off.imag], axis=1), 2, 0).ravel()
        answers.append(np.linalg.lstsq(rows, right, rcond=None)[0].reshape(len(found.names), -1) @ found.functions.T)
    spread = np.std(answers, axis=0).T
    assert spread == pytest.approx(found.deviation((0, 1)), rel=0.2)


def test_orbits_stay_within_their_share() -> None:
    """Runs that were made smaller touch the limit; the others are as they were."""
    made = designer(*COARSE)
    possible = list_candidates(made.planner.config.machine.candidates)
    allowed, again = made.allowed, made.planner.limit(made.allowed, made.prior)
    assert again == allowed or all(
        one[0].magnitude == pytest.approx(other[0].magnitude, rel=1e-12)
        for one, other in zip(again, allowed, strict=True)
    )
    assert any(one[0].magnitude < other[0].magnitude for one, other in zip(allowed, possible, strict=True))
    assert any(one == other for one, other in zip(allowed, possible, strict=True))
    circle = np.array([1.0, -1j]).reshape(1, 1, 2, 1) * 3e-6
    assert scale_to_limits(circle, np.array([1e-6])) == pytest.approx(1 / 3)
    assert scale_to_limits(circle, np.array([np.inf])) == pytest.approx(1.0)


@pytest.mark.slow
def test_what_can_be_reached_is_written_and_can_be_used(run: Run, tmp_path: Path) -> None:
    """Sixteen coefficients at 5 % with a force that turns backward."""
    run("design", ["experiment=realistic", "design.accuracy=0.05"], tmp_path)
    about = json.loads((tmp_path / "design.json").read_text())
    assert about["reached"]
    assert len(about["predicted"]) == 16
    assert max(about["predicted"].values()) <= 0.05
    file = tmp_path / "designed_excitation.yaml"
    config = compose_config(["experiment=realistic", f"machine.runs_file='{file}'"])
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
    said = capsys.readouterr().out
    assert "10 % can't be reached with 3 runs for 16 of 16 coefficients; the worst, node" in said
    assert "(enough)" in said


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
    error = np.array([refit_study.measure_again(config, seed).error for seed in range(6)])
    ratio = error / (67.45 * np.array(list(about["predicted"].values())))
    print(f"error over prediction {ratio.mean():.2f}")
    assert 0.6 < ratio.mean() < 1.6
