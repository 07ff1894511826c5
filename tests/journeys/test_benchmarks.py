"""The benchmarks do what they say and no time fails them; what is compared there does the same work."""

from __future__ import annotations

from pathlib import Path
from unittest.mock import Mock

import pytest
from conftest import MachineFactory, assert_says

from benchmarks import __main__ as command
from benchmarks.measure import Aim, Benchmark, Measured, Times, in_turns
from benchmarks.report import surroundings
from studies import ALONE, Make, silent


def one(aim: Aim, ours: float = 3.0, peer: float = 1.0, scale: float = 1.0) -> Measured:
    """A benchmark of three turns, the middle one with the times given."""
    times = Times([ours / 2, ours, 2 * ours], [peer, peer, peer], scale)
    return Measured(Benchmark("x", "this", "that", aim, lambda: times), times)


@pytest.mark.parametrize(
    ("measured", "median", "met"),
    [
        (one(Aim(3.0)), 3.0, True),
        (one(Aim(2.9)), 3.0, False),
        (one(Aim(0.4), scale=0.1), 0.3, True),
        (one(Aim(2.0, "at least"), ours=1.0, peer=2.0), 2.0, True),
        (one(Aim(2.1, "at least"), ours=1.0, peer=2.0), 2.0, False),
        (one(Aim(3.5, "below"), ours=3.0, peer=0.1), 30.0, True),
        (one(Aim(3.0, "below")), 3.0, False),
    ],
)
def test_the_median_is_held_against_the_aim(measured: Measured, median: float, met: bool) -> None:
    assert measured.median == pytest.approx(median)
    assert measured.met is met


def test_both_sides_take_turns() -> None:
    said: list[str] = []
    times = in_turns(lambda: said.append("ours"), lambda: said.append("peer"), 3)
    assert said == ["ours", "peer"] * 3
    assert (len(times.ours), len(times.peer)) == (3, 3)


@pytest.fixture
def found(monkeypatch: pytest.MonkeyPatch) -> dict[str, Benchmark]:
    """Two benchmarks in the place of all: one misses its aim, the other breaks."""
    breaks = Mock(side_effect=RuntimeError("no such thing"))
    made = {"x": one(Aim(0.1)).benchmark, "broken": Benchmark("broken", "this", "that", Aim(1), breaks)}
    monkeypatch.setattr(command, "benchmarks", lambda: made)
    return made


@pytest.mark.usefixtures("found")
def test_no_time_and_no_breakdown_fails_it(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Exit code 0 where an aim is missed, and where a benchmark breaks; the page says both."""
    assert command.main(["--write", str(tmp_path / "page.md")]) == 0
    page = (tmp_path / "page.md").read_text(encoding="utf-8")
    assert_says(
        page.replace("\n", " "),
        "| x | 3 | 1.5 to 6 | at most 0.1 | no | 3.00 s | 1.00 s |",
        "`broken` could not be measured: RuntimeError: no such thing",
        "torch 2",
    )
    assert max(len(line) for line in page.splitlines()) <= 100
    assert "no such thing" in capsys.readouterr().err


def test_the_page_says_whether_the_machine_was_quiet() -> None:
    assert "other programs ran beside it" in surroundings(1.9)
    assert "the machine was quiet" in surroundings(0.1)


def test_an_unknown_name_is_a_mistake(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit, match=r"^2$"):
        command.main(["no_such_benchmark"])
    assert "guesses_at_once" in capsys.readouterr().err


def test_every_benchmark_is_on_the_committed_page() -> None:
    page = (Path(__file__).parents[2] / "docs" / "measured" / "benchmarks.md").read_text(encoding="utf-8")
    assert [name for name in command.benchmarks() if f"`{name}`" not in page] == []


@pytest.mark.slow
def test_ross_answers_for_the_same_pedestals() -> None:
    """To what its smoothing of the bearings' table leaves."""
    from benchmarks.modelling import on_pedestals
    from benchmarks.ross_oracle import ross_rotor

    made = on_pedestals(1)
    rotor = ross_rotor(made.config.machine.rotor, made.config.machine.bearings, made.speeds)
    first = [e for e in made.excitations if e.run == made.runs[0]]
    acting = [[e.node for e in first], [e.magnitude for e in first], [e.phase for e in first]]
    theirs = rotor.run_unbalance_response(*acting, frequency=made.speeds[::118]).forced_resp[:42:6].T
    ours = made.response[::118, :28:4, 0]
    assert abs(ours - theirs).max() < 3e-6 * abs(theirs).max()


@pytest.mark.slow
@pytest.mark.usefixtures("one_thread")
def test_81_guesses_at_once_take_the_steps_of_one(machine: MachineFactory) -> None:
    """Without early stopping, so that the benchmark compares the same phases."""
    import torch

    from benchmarks.training import endless
    from pipeline.evaluation.repeats import choose_starts
    from pipeline.identification.residual_loss import initial_parameters, prepare_residual
    from pipeline.identification.training import minimise

    made = machine("experiment=ball_bearing")
    setup, guesses = endless(made.config), choose_starts(made.config.robustness)
    assert (len(guesses), guesses[0], guesses[-1]) == (81, 1.0, pytest.approx(1e8))
    prepared = prepare_residual(made.measurement, setup)
    together = torch.cat([initial_parameters(prepared, setup, made.config.seed, float(guess)) for guess in guesses])
    batches = [
        minimise(prepared.problem, start, setup, held_out=prepared.held_out) for start in (together[40:41], together)
    ]
    assert batches[0].steps == batches[1].steps


@pytest.mark.slow
def test_two_workers_do_the_trials_of_one(make: Make, tmp_path: Path) -> None:
    """Random search without pruning: the very same trials, all of them accounted for, and nothing to complain of."""
    from pipeline.tuning.finalists import summarize
    from pipeline.tuning.worker import run_study

    problems = (make(**ALONE, storage=f"sqlite:///{tmp_path}/{n}.db", n_trials=4, workers=n) for n in (1, 2))
    studies = [run_study(problem, silent) for problem in problems]
    assert [sentences for _, sentences in studies] == [[], []]
    one, two = ([trial.parameters for trial in summarize(study)] for study, _ in studies)
    assert (len(one), one) == (4, two)
