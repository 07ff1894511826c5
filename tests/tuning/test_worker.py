"""Studies that are killed, interrupted, shared or ill: no finished trial is lost, none is drawn twice."""

from __future__ import annotations

import os
import re
import shutil
import signal
import subprocess
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from running import names_in

from pipeline.__main__ import main
from pipeline.errors import ConfigError
from pipeline.identification.training import Outcome
from pipeline.tuning import study as study_module
from pipeline.tuning.space import find_default
from pipeline.tuning.storage import REPEATS, list_attempts, repeat_stopped
from pipeline.tuning.study import StudyProblem, open_study
from pipeline.tuning.worker import run_study
from studies import (
    ALONE,
    CHEAP,
    ENVIRONMENT,
    PYTHON,
    TRIALS,
    Forks,
    Make,
    Undisturbed,
    ended,
    finished,
    lengthen,
    refused,
    silent,
    told,
    trials_of,
    wait_until,
    with_config,
    with_other_data,
    with_tuning,
)

pytestmark = pytest.mark.slow  # it trains, or starts processes


def stop_again_and_again(start: Forks, problem: StudyProblem, number: int, rng: np.random.Generator) -> int:
    """How often a study was stopped by a signal, each time a moment after it had two new results, until it was
    through.
    """
    for stops in range(20):
        runner, before = start(problem), len(told(problem))
        if before > problem.config.tuning.n_trials - 3:
            assert (runner.end(), runner.said) == (0, "")
            return stops
        wait_until(lambda before=before: len(told(problem)) > before + 1)
        time.sleep(rng.uniform(0.0, 0.1))
        runner.signal(number)
        code = runner.end()
        assert runner.said == ""
        if code == 0:  # the last trials were quicker than the signal
            return stops
        assert code == (-signal.SIGKILL if number == signal.SIGKILL else 130)
    raise AssertionError("it was never through")


def test_a_study_that_is_undisturbed_has_trials_of_every_kind(undisturbed: Undisturbed, cheap: StudyProblem) -> None:
    """What the studies of this file are compared with: complete and pruned trials, all of them different."""
    trials = undisturbed()
    assert (len(trials), trials[0][2]) == (TRIALS, find_default(cheap.config))
    assert {state for _, state, *_ in trials} == {"COMPLETE", "PRUNED"}
    assert len({value for _, _, _, value, _, _ in trials}) == TRIALS
    assert all(curve for *_, curve, _ in trials)


@pytest.mark.parametrize(
    ("number", "sampler"),
    [
        (signal.SIGKILL, "tpe"),
    ],
)
def test_a_study_that_is_stopped_at_random_moments_ends_as_if_it_had_not_been(
    number: int, sampler: str, start: Forks, make: Make, undisturbed: Undisturbed, rng: np.random.Generator
) -> None:
    """States, parameters, values and learning curves are the very same, bit by bit; stopped trials are repeated."""
    problem = make(sampler=sampler)
    assert stop_again_and_again(start, problem, number, rng) >= 1  # by the clock it may be through after one
    assert finished(problem) == undisturbed(sampler=sampler)
    repeats = [trial for trial in trials_of(problem) if REPEATS in trial.user_attrs]
    assert repeats
    assert len(trials_of(problem)) == TRIALS + len(repeats)


def test_the_number_of_trials_is_the_total(make: Make, undisturbed: Undisturbed) -> None:
    """Five, then nine, are nine, no start-up point comes twice; again with nine, or with fewer, runs none."""
    for total in (1, 5, 9, 9, 3):
        run_study(make(n_trials=total), silent)
        assert told(make())[:total] == undisturbed()[:total]
    assert len(trials_of(make())) == 9


def test_a_stopped_trial_is_repeated_at_its_place(make: Make) -> None:
    """Its repeat has a number of its own; of two repeats the first counts, and a spare trial has no result."""
    import optuna

    study = open_study(make(n_trials=3))
    config = make(n_trials=3, heartbeat_seconds=10**6).config.tuning
    for _ in range(4):
        study.enqueue_trial({})

    def ask() -> Any:
        with pytest.warns(UserWarning, match="Heartbeat of storage"):
            return study.ask()

    for state in ("COMPLETE", "FAIL"):
        study.tell(ask(), 1.0 if state == "COMPLETE" else None, state=optuna.trial.TrialState[state])
    assert [trial.number for trial in repeat_stopped(study, config)] == [0, 4, 2]
    study.enqueue_trial({}, user_attrs={REPEATS: 1})  # as another worker does at the same moment
    assert [trial.number for trial in repeat_stopped(study, config)] == [0, 4, 2]
    study.tell(ask(), state=optuna.trial.TrialState.FAIL)  # number 2
    ask().set_user_attr("worker", "x")  # number 3, beyond the total
    study.tell(ask(), state=optuna.trial.TrialState.FAIL)  # number 4, a repeat that is stopped as well
    assert [trial.number for trial in repeat_stopped(study, config)] == [0, 6, 7]
    assert [trial.number for trial in list_attempts(study)] == [0, 6, 7, 3]


def test_a_trial_that_died_before_its_first_heartbeat_is_repeated(make: Make, undisturbed: Undisturbed) -> None:
    """Optuna takes no such trial for silent, and it would run for ever."""
    problem = make(n_trials=2)
    study = open_study(problem)
    with pytest.warns(UserWarning, match="Heartbeat of storage"):
        study.ask()
    run_study(problem, silent)
    assert finished(problem) == undisturbed()[:2]
    assert [trial.state.name for trial in trials_of(problem)] == ["FAIL", "COMPLETE", "COMPLETE"]


def _reorder(problem: StudyProblem) -> StudyProblem:
    space = dict(problem.config.tuning.space)
    return with_tuning(problem, space={"rate": space.pop("rate")} | space)


def _shorten(problem: StudyProblem) -> StudyProblem:
    return with_tuning(problem, space={k: of for k, of in problem.config.tuning.space.items() if k != "damping"})


def _with_optimizer(problem: StudyProblem) -> StudyProblem:
    optimizer = problem.config.optimizer
    phase = optimizer.levenberg_marquardt.model_copy(update={"steps": 3})
    return with_config(problem, optimizer=optimizer.model_copy(update={"levenberg_marquardt": phase}))


def _with_other_known(problem: StudyProblem) -> StudyProblem:
    known = problem.measurement.known
    return replace(problem, measurement=replace(problem.measurement, known=replace(known, values=known.values + 1.0)))


CHANGES: dict[str, tuple[Callable[[StudyProblem], StudyProblem], list[str]]] = {
    "a range": (
        lambda p: with_tuning(
            p,
            space=dict(p.config.tuning.space)
            | {"rate": p.config.tuning.space["rate"].model_copy(update={"high": 0.5})},
        ),
        ["the search space changed (rate)"],
    ),
    "a dimension less": (_shorten, ["the search space changed (damping, its order)"]),
    "the order": (_reorder, ["the search space changed (its order)"]),
    "the data": (
        with_other_data,
        ["the data changed (vibration, excitation and rotor)"],
    ),
    "the known coefficients": (
        _with_other_known,
        ["the data changed (known coefficients)"],
    ),
    "the optimiser": (_with_optimizer, ["the configuration changed (optimizer)"]),
    "the seed": (lambda p: with_config(p, seed=3), ["the configuration changed (seed)"]),
    "the sampler": (lambda p: with_tuning(p, sampler="random"), ["the sampler changed (sampler)"]),
    "the pruner": (lambda p: with_tuning(p, pruner="none"), ["the sampler changed (pruner)"]),
    "two at once": (
        lambda p: with_other_data(with_tuning(p, startup_trials=4)),
        ["the data changed", "the sampler changed (startup_trials)"],
    ),
}


def test_a_study_of_something_else_is_refused(make: Make) -> None:
    problem = make(n_trials=1)
    run_study(problem, silent)
    before = told(problem)
    advice = ["tuning.study=NAME", "tuning.changed=restart", problem.config.tuning.storage, "'ball_bearing'"]
    for change, fragments in CHANGES.values():
        with refused(*fragments, *advice):
            run_study(change(problem), silent)
    assert told(problem) == before


def test_what_is_done_with_the_trials_may_change(make: Make) -> None:
    run_study(make(n_trials=1), silent)
    run_study(make(n_trials=2, finalists=7, seeds=(5,), least_gain=3.0, changed="restart"), silent)
    assert len(trials_of(make())) == 2


def test_restart_begins_a_changed_study_again(make: Make) -> None:
    """Its old trials are gone and its new ones are those of a new study; other studies of the database stay."""
    for study in ("ball_bearing", "other"):
        run_study(make(study=study, n_trials=3), silent)
    other = told(make(study="other"))
    change, _ = CHANGES["a range"]
    run_study(change(make(n_trials=2, changed="restart")), silent)
    assert len(trials_of(make())) == 2
    assert told(make(study="other")) == other
    run_study(change(make(study="new", n_trials=2)), silent)
    assert told(make()) == told(make(study="new"))


def at_work(problem: StudyProblem, pids: set[int]) -> Any:
    """A trial on which one of these processes works, in the middle of its training."""
    for trial in trials_of(problem):
        pid = int(trial.user_attrs.get("worker", ":0").split(":")[1])
        if trial.state.name == "RUNNING" and pid in pids and trial.intermediate_values:
            return trial
    return None


@pytest.mark.parametrize("workers", [2])
def test_the_trial_of_a_worker_that_dies_is_taken_over(workers: int, start: Forks, make: Make) -> None:
    problem = lengthen(make(**ALONE, n_trials=3, workers=workers))
    runner = start(problem, others=workers - 1)
    pids = wait_until(lambda: {w.pid for w in runner.workers()} if len(runner.workers()) == workers - 1 else None)
    trial = wait_until(lambda: at_work(problem, pids))
    os.kill(int(trial.user_attrs["worker"].split(":")[1]), signal.SIGKILL)
    assert runner.end() == 0, runner.said
    assert "a worker ended with exit code -9; the others took over its trial" in runner.said
    # Where two are left, both may put it back or ask for the last one: what has no place is not trained.
    trained = [other for other in trials_of(problem) if other.intermediate_values]
    (repeat,) = (other for other in trained if other.user_attrs.get(REPEATS) == trial.number)
    assert (repeat.state.name, repeat.params) == ("COMPLETE", trial.params)
    assert trial.intermediate_values.items() <= repeat.intermediate_values.items()
    assert (len(finished(problem)), len(trained), workers > 2 or len(trials_of(problem)) == 4) == (3, 4, True)


@pytest.mark.parametrize(("moment", "whole_group"), [("in a trial", True)])
def test_ctrl_c_stops_every_worker(moment: str, whole_group: bool, start: Forks, make: Make) -> None:
    """Whoever gets the signal, all end without a word of Python's, and every trial is finished or stopped."""
    count = 2 if moment == "in a trial" else 3
    problem = lengthen(make(**ALONE, n_trials=8, workers=count))
    runner = start(problem, others=count - 1 if moment == "in a trial" else 0)
    workers = wait_until(lambda: runner.workers() if len(runner.workers()) == count - 1 else None)
    if moment == "in a trial":
        wait_until(lambda: at_work(problem, {w.pid for w in workers}))
    if whole_group:
        os.killpg(runner.pid, signal.SIGINT)
    else:
        runner.signal(signal.SIGINT)
    assert (runner.end(), runner.said) == (130, "")
    assert ended(workers)
    assert {trial.state.name for trial in trials_of(problem)} <= {"COMPLETE", "FAIL"}


def failing(monkeypatch: pytest.MonkeyPatch, at: int, fail: Callable[[Any], Any]) -> None:
    """The ``at``-th training returns what ``fail`` makes of its result, or raises."""
    real, calls = study_module.minimise, []

    def minimise(*arguments: Any, **options: Any) -> Any:
        calls.append(1)
        batch = real(*arguments, **options)
        return fail(batch) if len(calls) == at + 1 else batch

    monkeypatch.setattr(study_module, "minimise", minimise)


def _raises(error: BaseException) -> Callable[[Any], Any]:
    def fail(_: Any) -> Any:
        raise error

    return fail


FAILURES: dict[str, tuple[Callable[[Any], Any], str]] = {
    "diverged": (lambda batch: replace(batch, outcomes=(Outcome.DIVERGED,)), "diverged: the loss is not"),
    "not finite": (lambda batch: replace(batch, parameters=batch.parameters * np.nan), "diverged: the loss"),
    "linear algebra": (_raises(torch.linalg.LinAlgError("the matrix is singular")), "the matrix is singular"),
    "memory": (_raises(MemoryError("a lot")), "MemoryError: a lot"),
    "a law": (_raises(ConfigError("x must be y")), "ConfigError: x must be y"),
}


@pytest.mark.parametrize("failure", FAILURES)
def test_a_trial_that_fails_says_why_and_the_study_goes_on(
    failure: str, make: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It is failed, with its reason, and counts as one of the total; the others are not touched."""
    fail, reason = FAILURES[failure]
    failing(monkeypatch, 1, fail)
    problem = make(n_trials=3)
    run_study(problem, silent)
    trials = finished(problem)
    assert [state for _, state, *_ in trials] == ["COMPLETE", "FAIL", "COMPLETE"]
    assert len(trials_of(problem)) == 3
    *_, value, _, attributes = trials[1]
    assert value is None
    assert reason in attributes["reason"]
    assert attributes["outcome"] in ("diverged", "failed")
    assert "\n" not in attributes["reason"]


@pytest.mark.parametrize("bug", [TypeError("a bug"), KeyError("a bug")], ids=repr)
def test_a_bug_is_not_swallowed(
    bug: Exception, make: Make, monkeypatch: pytest.MonkeyPatch, undisturbed: Undisturbed
) -> None:
    problem = make(n_trials=3)
    with monkeypatch.context() as patch:
        failing(patch, 1, _raises(bug))
        with pytest.raises(type(bug), match="a bug"):
            run_study(problem, silent)
    assert len(told(problem)) == 1
    run_study(problem, silent)
    assert finished(problem) == undisturbed()[:3]


def test_a_trial_that_another_worker_took_over_changes_nothing(make: Make, undisturbed: Undisturbed) -> None:
    """A worker that slept and was taken for dead goes on with other trials; its own was failed, and is repeated."""
    problem, asked = make(n_trials=3), []

    def fails_the_second(study: Any) -> None:
        import optuna

        running = [trial.number for trial in study.get_trials(deepcopy=False) if trial.state.name == "RUNNING"]
        if running == [1] and not asked:
            asked.append(study.tell(1, state=optuna.trial.TrialState.FAIL))

    run_study(problem, fails_the_second)
    assert asked
    assert finished(problem) == undisturbed()[:3]
    assert [trial.user_attrs.get(REPEATS) for trial in trials_of(problem)] == [None, None, 1, None]


def test_the_command_line_goes_on_where_it_was_interrupted(
    cheap: StudyProblem,
    tmp_path: Path,
    make: Make,
    undisturbed: Undisturbed,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """SIGINT is 130 and a sentence; the same command ends with the trials of an undisturbed study."""
    folder = shutil.copytree(cheap.config.output, tmp_path / "data")
    places = [f"output='{folder}'", "tuning.storage=sqlite:///studies.db", "tuning.folder=best"]
    command = [*PYTHON, "-m", "pipeline", "stage=tune", *CHEAP, *places]
    problem = make()
    options: dict[str, Any] = {
        "cwd": tmp_path,
        "env": ENVIRONMENT,
        "text": True,
        "stdout": subprocess.PIPE,
        "stderr": subprocess.PIPE,
        # A shell's background job hands down an ignored SIGINT.
        "preexec_fn": lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
    }
    with subprocess.Popen(command, **options) as process:
        wait_until(lambda: process.poll() is not None or len(told(problem)) > 1)
        process.send_signal(signal.SIGINT)
        out, err = process.communicate(timeout=30)
    assert process.returncode == 130, err
    assert "study interrupted; no finished trial is lost, and the same command goes on" in out + err
    assert "Traceback" not in out + err
    before = told(problem)
    assert before == undisturbed()[: len(before)]
    # The last trials may be quicker than the signal; 130 and the sentence say that it was taken.
    assert 2 <= len(before) <= TRIALS
    monkeypatch.chdir(tmp_path)
    assert main(command[command.index("stage=tune") :]) == 0
    out = capsys.readouterr().out
    assert re.search(rf"{TRIALS} trials in", out)
    assert "optuna-dashboard sqlite:///studies.db" in " ".join(out.split())
    assert finished(problem) == undisturbed()
    assert {"best.yaml", "README.md", "summary.json", "trials.csv", "finalists.csv"} <= names_in(tmp_path / "best")
