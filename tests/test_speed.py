"""The bars of speed, each printed with what was measured (``pytest -s -m slow tests/test_speed.py``).

Both sides of every ratio are measured in this process on one thread (numpy's and torch's, by conftest.py), and
the least time of each is taken: another program on the machine only ever makes a time longer.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from conftest import Machine, MachineFactory

from pipeline.config.compose import compose_config
from pipeline.config.identification import AdamConfig, LevenbergMarquardtConfig
from pipeline.data.simulate import forced_response
from pipeline.identification import optimizers
from pipeline.identification.training import TrainingSetup, initial_parameters, prepare, run_training
from pipeline.rotor.ross_adapter import ross_rotor
from pipeline.stages.robustness import starting_points
from pipeline.stages.tune import child_record
from pipeline.tracking import StageRecord, TrackingSettings, track
from pipeline.tuning.parallel import run_study
from pipeline.tuning.review import TrialAccount, accounts
from pipeline.tuning.study import StudyProblem

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("one_thread")]

Refined = Callable[[str, int], list[str]]


def seconds(action: Callable[[], object]) -> float:
    """How long it takes, once."""
    start = time.perf_counter()
    action()
    return time.perf_counter() - start


def least_times(actions: list[Callable[[], object]], repeats: int) -> list[float]:
    """The least time of each action; they take turns, so that a busy machine slows all alike."""
    times = [[seconds(action) for action in actions] for _ in range(repeats)]
    return np.min(times, axis=0).tolist()


# --- generate ------------------------------------------------------------------------------------


@pytest.mark.parametrize(("factor", "nodes"), [(1, 7), (4, 25)])
def test_response_is_50_times_faster_than_ross(
    factor: int, nodes: int, machine: MachineFactory, refined: Refined
) -> None:
    """591 speeds x 3 runs against three ROSS ``run_unbalance_response`` calls, assembly left out.

    ROSS keeps the transfer matrices of a rotor: the three calls share them; each timing has a fresh rotor.
    """
    made = machine(*refined("hydrostatic_stiffness", factor))
    assert (len(made.speeds), len(made.runs), made.rotor.n_nodes) == (591, 3, nodes)

    def ours() -> np.ndarray:
        return forced_response(made.rotor, made.bearings, made.excitations, made.runs)

    def of_ross() -> float:
        rotor = ross_rotor(made.config.rotor, made.config.bearing, made.speeds)
        return seconds(lambda: three_calls(made, rotor))

    ours()
    slow = min(of_ross() for _ in range(3))
    (fast,) = least_times([ours], 20)
    print(f"{nodes} nodes: ROSS {slow:.3f} s, here {fast * 1e3:.1f} ms: {slow / fast:.0f} times faster")
    assert slow / fast >= 50


def three_calls(machine: Machine, rotor: Any) -> None:
    """The response of every run, by ROSS's rotor."""
    for run in machine.runs:
        own = [e for e in machine.excitations if e.run == run]
        nodes, sizes, phases = [e.node for e in own], [e.magnitude for e in own], [e.phase for e in own]
        rotor.run_unbalance_response(nodes, sizes, phases, frequency=machine.speeds)


@pytest.mark.parametrize("nodes", [25, 97])
def test_response_grows_linearly_with_the_nodes(nodes: int, machine: MachineFactory, refined: Refined) -> None:
    """The band solve costs as much a node on a fine mesh as on a coarse one (at most 1.5 times)."""
    coarse = machine(*refined("hydrostatic_stiffness", 1))
    fine = machine(*refined("hydrostatic_stiffness", (nodes - 1) // 6))
    actions = [
        lambda made=made: forced_response(made.rotor, made.bearings, made.excitations, made.runs)
        for made in (coarse, fine)
    ]
    at_7, at_n = least_times(actions, 10)
    growth = at_n / at_7 / (nodes / 7)
    print(f"response: {at_7 * 1e3:.1f} ms at 7 nodes, {at_n * 1e3:.1f} ms at {nodes}: {growth:.2f} times a node")
    assert growth <= 1.5


# --- train ---------------------------------------------------------------------------------------


def steps(machine: Machine, optimizer: str, count: int) -> Callable[[], object]:
    """``count`` steps of an optimiser on the machine's own problem, without the monitor's account."""
    config = machine.config
    setup = TrainingSetup(config.identify, config.model, config.loss, config.optimizer, config.training)
    prepared = prepare(machine.equations, machine.bearings, setup)
    start = initial_parameters(prepared, setup, config.seed)
    go_on = torch.zeros(start.shape[:2], dtype=torch.bool)
    if optimizer == "adam":
        phase = AdamConfig(steps=count, patience=count, learning_rate=1e-3, final_rate_fraction=1.0)
        return lambda: optimizers.adam(prepared.train, start, phase, lambda *_: go_on)
    phase = LevenbergMarquardtConfig(steps=count, patience=count, initial_damping=1e6)  # accepted at once
    return lambda: optimizers.levenberg_marquardt(prepared.train, start, phase, lambda *_: go_on)


@pytest.mark.parametrize(("optimizer", "count"), [("adam", 10), ("levenberg_marquardt", 4)])
def test_step_does_not_depend_on_the_nodes(
    optimizer: str, count: int, machine: MachineFactory, refined: Refined
) -> None:
    """A training step at 97 nodes costs at most 1.2 times one at 7."""
    made = [machine(*refined("hydrostatic_stiffness", factor)) for factor in (1, 16)]
    assert [m.rotor.n_nodes for m in made] == [7, 97]
    actions = [steps(m, optimizer, count) for m in made]
    least_times(actions, 2)
    at_7, at_97 = least_times(actions, 40)
    print(
        f"{optimizer}: {1e3 * at_7 / count:.2f} ms a step at 7 nodes, {1e3 * at_97 / count:.2f} at 97: "
        f"{at_97 / at_7:.2f} times"
    )
    assert at_97 / at_7 <= 1.2


# --- robustness ----------------------------------------------------------------------------------


def test_81_guesses_at_once_cost_three_times_one(machine: MachineFactory) -> None:
    """81 initial guesses trained together take at most 3 times one alone, with the same phases.

    Without early stopping (tolerance 0, endless patience) both take every step.
    """
    made = machine("experiment=ball_bearing")
    config = made.config
    endless = {
        name: section.model_copy(update={"patience": 10**9})
        for name in ("adam", "lbfgs", "levenberg_marquardt")
        for section in [getattr(config.optimizer, name)]
    }
    setup = TrainingSetup(
        config.identify,
        config.model,
        config.loss,
        config.optimizer.model_copy(update=endless),
        config.training.model_copy(update={"tolerance": 0.0}),
    )
    prepared = prepare(made.equations, made.bearings, setup)
    guesses = starting_points(config)
    assert (len(guesses), guesses[0], guesses[-1]) == (81, 1.0, pytest.approx(1e8))
    together = torch.cat([initial_parameters(prepared, setup, config.seed, float(guess)) for guess in guesses])
    batches = [run_training(prepared, start, setup) for start in (together[40:41], together)]
    assert batches[0].steps == batches[1].steps  # nothing stopped early
    one, all_81 = least_times(
        [lambda start=start: run_training(prepared, start, setup) for start in (together[40:41], together)], 6
    )
    print(f"{batches[0].steps} steps: one guess {one:.3f} s, 81 together {all_81:.3f} s: {all_81 / one:.2f} times")
    assert all_81 / one <= 3.0


def test_unused_runs_cost_nothing(machine: MachineFactory) -> None:
    """QR leaves as many rows as unknowns: ten times the runs make a step cost at most 1.2 times as much."""
    made = machine("experiment=hydrostatic_stiffness")
    equations = made.equations
    many = replace(
        equations,
        frequencies=np.tile(equations.frequencies, 10),
        free_residual=np.tile(equations.free_residual, 10),
        displacement=np.tile(equations.displacement, 10),
    )
    config = made.config
    setup = TrainingSetup(config.identify, config.model, config.loss, config.optimizer, config.training)
    actions = []
    for data in (equations, many):
        prepared = prepare(data, made.bearings, setup)
        start = initial_parameters(prepared, setup, config.seed)
        actions.append(lambda prepared=prepared, start=start: [prepared.train.jacobian(start) for _ in range(3)])
    three, thirty = least_times(actions, 40)
    print(f"jacobian: {three / 3e-3:.2f} ms with 3 runs, {thirty / 3e-3:.2f} with 30: {thirty / three:.2f} times")
    assert thirty / three <= 1.2


# --- studies ---------------------------------------------------------------------------------------


def studied(made: Machine, folder: Path, *overrides: str) -> tuple[list[TrialAccount], float]:
    """The trials of a study, and its time in seconds."""
    config = compose_config(["stage=tune", f"tuning.storage={folder}/optuna.log", *overrides])
    problem = StudyProblem(config, made.equations, made.bearings, "the same data")
    start = time.perf_counter()
    study, sentences = run_study(problem, lambda _: None)
    wall = time.perf_counter() - start
    assert (len(accounts(study)), sentences) == (config.tuning.n_trials, [])
    return accounts(study), wall


def test_a_study_spends_its_time_on_training(machine: MachineFactory, tmp_path: Path) -> None:
    """Sampling, storage and tracking take less than 5 % of the time."""
    trials, wall = studied(machine("experiment=hydrostatic_stiffness"), tmp_path, "tuning.n_trials=24")
    training = sum(trial.seconds or 0.0 for trial in trials)
    children = [child_record(trial) for trial in trials]
    settings = TrackingSettings(True, f"sqlite:///{tmp_path}/mlflow.db", 30.0)
    record = StageRecord("x", "tune", time.time() - 1, time.time(), {}, {}, {}, children=children)
    track(replace(record, children=()), settings)  # makes the database
    tracking = seconds(lambda: track(record, settings))
    overhead = (wall - training + tracking) / wall
    print(
        f"{wall:.1f} s of which training {training:.1f} s, tracking {tracking:.1f} s: overhead {100 * overhead:.1f} %"
    )
    assert overhead < 0.05


@pytest.mark.skipif(len(os.sched_getaffinity(0)) < 2, reason="needs two cores")
def test_two_workers_are_nearly_twice_as_fast(machine: MachineFactory, tmp_path: Path) -> None:
    """1.7 times as fast as one. Random search without pruning, so that both do the very same trials.

    With the configured number of trials: at the end of a study one worker waits for the last trial of the other.
    """
    made = machine("experiment=hydrostatic_stiffness")
    alike = ("tuning.sampler=random", "tuning.pruner=none")
    one, slow = studied(made, tmp_path / "one", *alike)
    two, fast = studied(made, tmp_path / "two", "tuning.workers=2", *alike)
    if slow / fast < 1.7:  # another program took a core for a while?
        fast = min(fast, studied(made, tmp_path / "again", "tuning.workers=2", *alike)[1])
    assert [trial.parameters for trial in one] == [trial.parameters for trial in two]
    print(f"one worker {slow:.1f} s, two workers {fast:.1f} s: {slow / fast:.2f} times as fast")
    assert slow / fast >= 1.7
