"""How trainings end: together as alone, converged, diverged, interrupted, at the precision of the data."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
import torch
from conftest import Machine
from training import CHAINS, asked, assert_close, minimised, optimizer, setup_of, starts, trained

from pipeline.config.compose import compose_config
from pipeline.config.identification import OptimizerConfig
from pipeline.errors import ConfigError
from pipeline.identification.fit import fit
from pipeline.identification.residual_loss import (
    ResidualProblem,
    ResidualTraining,
    initial_parameters,
    prepare_residual,
)
from pipeline.identification.training import FitSetup, Minimum, Outcome
from pipeline.stages.analysis import use_threads

pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.mark.slow
@pytest.mark.parametrize("phases", [optimizer(adam=60), optimizer(lm=15), optimizer(lbfgs=4)])
def test_guesses_trained_together_do_not_influence_each_other(phases: OptimizerConfig, ball: Machine) -> None:
    """Five guesses at once end where each ends alone (1e-12; steps forced equal, no early stopping)."""
    guesses = [1.0, 1e2, 1e4, 1e6, 1e8]
    setup = setup_of(ball, phases)
    _, together = trained(asked(ball), setup, guesses)
    for g, guess in enumerate(guesses):
        _, alone = trained(asked(ball), setup, [guess])
        assert_close(together.parameters[g], alone.parameters[0], rtol=1e-12, atol=1e-12)
        assert together.loss[g] == pytest.approx(alone.loss[0], rel=1e-12, abs=1e-14)


def test_a_named_device_trains_as_the_default(monkeypatch: pytest.MonkeyPatch, hydrostatic: Machine) -> None:
    """``training.device=cuda`` trains on a GPU what the processor would (1e-8), and is refused where torch sees none.

    Without a GPU here, the processor under another name takes the same path, to the same bits.
    """
    at_hand = torch.cuda.is_available()
    setup = setup_of(hydrostatic, optimizer(adam=4, lm=4))
    prepared = prepare_residual(asked(hydrostatic), setup)
    start = starts(prepared, setup, [1e4, 1e6])
    default, named = (
        minimised(prepared, start, replace(setup, training=setup.training.model_copy(update={"device": name})))
        for name in ("cpu", "cuda" if at_hand else "cpu:0")
    )
    assert_close(named.parameters, default.parameters, rtol=1e-8 if at_hand else 0, atol=0)
    assert (named.parameters.device.type, named.outcomes) == ("cpu", default.outcomes)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(ConfigError, match=r"training.device=cuda must have a GPU .* `make env TORCH=cuda`"):
        use_threads(compose_config(["experiment=hydrostatic_stiffness", "training.device=cuda"]))


def three_seeds(prepared: ResidualTraining, setup: FitSetup) -> tuple[Minimum, list[Minimum]]:
    """Networks from three seeds trained together, and each alone."""
    parts = [initial_parameters(prepared, setup, seed) for seed in range(3)]
    return minimised(prepared, torch.cat(parts), setup), [minimised(prepared, part, setup) for part in parts]


def test_seeds_of_a_network_trained_together(hydrostatic: Machine) -> None:
    """The same for networks from several seeds, where members share no numbers but the data."""
    setup = setup_of(hydrostatic, optimizer(adam=15))
    setup = replace(setup, model=setup.model.model_copy(update={"width": 6}))
    together, each = three_seeds(prepare_residual(asked(hydrostatic), setup), setup)
    for g, alone in enumerate(each):
        assert_close(together.parameters[g], alone.parameters[0], rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("phases", [optimizer(lm=60), optimizer(adam=40, lm=60)])
def test_a_training_that_is_over_stays_while_others_go_on(phases: OptimizerConfig, hydrostatic: Machine) -> None:
    setup = setup_of(hydrostatic, phases)
    setup = replace(
        setup,
        model=setup.model.model_copy(update={"width": 4}),
        training=setup.training.model_copy(update={"tolerance": 0.2}),
        optimizer=setup.optimizer.model_copy(
            update={"levenberg_marquardt": setup.optimizer.levenberg_marquardt.model_copy(update={"patience": 2})}
        ),
    )
    together, each = three_seeds(prepare_residual(asked(hydrostatic), setup), setup)
    for g, alone in enumerate(each):
        assert together.outcomes[g] is alone.outcomes[0]
        assert together.loss[g] == pytest.approx(alone.loss[0], rel=1e-6)
    steps = {alone.steps for alone in each}
    assert len(steps) > 1
    assert together.steps == max(steps)


@pytest.mark.parametrize(
    ("steps", "tolerance", "guess", "outcome", "fewest", "most", "loss"),
    [
        ({"lm": 500}, 0.1, 1e6, Outcome.CONVERGED, 0, 49, 1e-14),
        ({"adam": 20}, 0.0, 1.0, Outcome.BUDGET_SPENT, 21, 21, np.inf),  # and the start
    ],
)
def test_converged_or_budget_spent(
    steps: dict[str, int],
    tolerance: float,
    guess: float,
    outcome: Outcome,
    fewest: int,
    most: int,
    loss: float,
    ball: Machine,
) -> None:
    """No improvement above the tolerance for `patience` steps: converged, before the budget is spent."""
    _, batch = trained(asked(ball), setup_of(ball, optimizer(**steps, patience=5), tolerance=tolerance), [guess])
    assert batch.outcomes == (outcome,)
    assert fewest <= batch.steps <= most
    assert batch.loss[0] < loss


@pytest.mark.parametrize(("rate", "parametrisation"), [(1e6, "scaled"), (1e4, "log")])
def test_diverged(rate: float, parametrisation: str, ball: Machine) -> None:
    """A learning rate far too large: diverged (in the log case by overflow); the best state is kept."""
    setup = setup_of(ball, optimizer(adam=10, rate=rate, final=1.0), parametrisation)
    prepared = prepare_residual(asked(ball), setup)
    start = starts(prepared, setup, [1e6])
    batch = minimised(prepared, start, setup)
    assert batch.outcomes == (Outcome.DIVERGED,)
    assert batch.parameters.isfinite().all()
    assert batch.loss[0] <= float(prepared.problem.loss(start).square().mean().sqrt()) * (1 + 1e-12)


def test_one_diverged_member_leaves_the_others_alone(ball: Machine) -> None:
    setup = setup_of(ball, optimizer(lm=40))
    prepared = prepare_residual(asked(ball), setup)
    start = starts(prepared, setup, [1e6, 1e6])
    start[0] = float("nan")
    batch = minimised(prepared, start, setup)
    assert [outcome is Outcome.DIVERGED for outcome in batch.outcomes] == [True, False]
    assert batch.loss[1] < 1e-12


@pytest.mark.slow
def test_progress_and_history(ball: Machine) -> None:
    """Every step is shown with its phase and counted within it; the history has one row a step."""
    progress, watch, setup = Mock(), Mock(), setup_of(ball, optimizer(adam=3, lbfgs=2, lm=2))
    prepared = prepare_residual(asked(ball), setup)
    batch = minimised(prepared, starts(prepared, setup, [1e6]), setup, progress, watch)
    phases = [("adam", 3), ("lbfgs", 2), ("levenberg_marquardt", 2)]
    wanted = [("start", 1, 1)] + [(phase, k + 1, total) for phase, total in phases for k in range(total)]
    assert [call.args[:3] for call in progress.call_args_list] == wanted
    assert [(row["phase"], row["step"]) for row in batch.history] == [(of[0], i) for i, of in enumerate(wanted)]
    assert (watch.call_count, batch.steps) == (8, 8)


@pytest.mark.parametrize("chain", CHAINS)
def test_loss_never_ends_above_its_start(chain: str, hydrostatic: Machine) -> None:
    """The best state is at most as bad as the start, whatever the optimiser did; few steps of a network."""
    phases = CHAINS[chain][0]
    short = {name: {"steps": min(getattr(phases, name).steps, 3)} for name in OptimizerConfig.model_fields}
    parts = {name: getattr(phases, name).model_copy(update=part) for name, part in short.items()}
    setup = setup_of(hydrostatic, OptimizerConfig(**parts))
    prepared = prepare_residual(asked(hydrostatic), setup)
    start = initial_parameters(prepared, setup, 0)
    assert minimised(prepared, start, setup).loss[0] <= float(prepared.problem.loss(start).square().mean().sqrt())


@pytest.mark.slow
@pytest.mark.parametrize("digits", [6, 7])
def test_an_end_at_the_precision_of_the_data_is_converged(
    digits: int, hydrostatic: Machine, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Readings of a CSV file with few digits: what the loss falls by is soon lost in them.

    By the tolerance alone the same fit goes on for several times as many steps, and its answer is hardly another.
    """
    setup = setup_of(hydrostatic, optimizer(lm=150, patience=3), tolerance=1e-6)
    clean = asked(hydrostatic)
    values = clean.dataset.displacement
    size = 10.0 ** (np.floor(np.log10(np.abs(values))) - digits + 1)
    rounded = np.round(values.real / size) * size + 1j * np.round(values.imag / size) * size
    measured = replace(clean, dataset=replace(clean.dataset, displacement=rounded))
    found = fit(measured, setup)
    assert found.outcome is Outcome.CONVERGED
    monkeypatch.setattr(ResidualProblem, "scatter", lambda problem: 0.0)
    longer = fit(measured, setup)
    assert longer.outcome is Outcome.BUDGET_SPENT
    assert found.steps < longer.steps / 1.5
    assert found.loss < 1.2 * longer.loss


def test_losses_below_rounding_are_no_improvement() -> None:
    """A training at the precision of its data converges, however its losses go up and down there."""
    from pipeline.config.identification import TrainingConfig
    from pipeline.identification.training import _Monitor

    def steps(losses: list[float]) -> int:
        problem: Any = SimpleNamespace(rounding=lambda: torch.tensor([1e-13]), scatter=lambda: 0.0)
        monitor = _Monitor(
            problem=problem,
            held_out=None,
            config=TrainingConfig(holdout_every=0, holdout_runs=[], tolerance=0.1),
            progress=None,
            watch=None,
        )
        monitor.begin("levenberg_marquardt", 100, 3)
        for loss in losses:
            if monitor(torch.zeros(1, 1, 2), torch.full((1, 1), loss, dtype=torch.float64)).all():
                break
        return monitor.step

    falling = [1.0, 1e-3, 1e-9, 1e-15]
    assert steps([*falling, 8e-16, 6e-16, 4e-16, 2e-16, 1e-16]) == steps([*falling, *[1e-15] * 5]) == 7
    assert steps([1.0, 1e-3, 1e-9, 8e-10, 6e-10, 4e-10, 2e-10]) == 7, "above rounding they are"
