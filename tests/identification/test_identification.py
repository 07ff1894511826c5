"""Training: derivatives against autograd, recovery of a known truth, named outcomes, models as files.

The machines are small: ball bearings, 25 speeds, one run; fluid-film bearings, 60 speeds, three runs.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from conftest import Machine, unknown_at_all
from hypothesis import given
from hypothesis import strategies as st

from pipeline.coefficients import COEFFICIENTS
from pipeline.config.compose import compose_config
from pipeline.config.identification import (
    AdamConfig,
    LBFGSConfig,
    LevenbergMarquardtConfig,
    LossConfig,
    NetworkModelConfig,
    OptimizerConfig,
    TrainingConfig,
)
from pipeline.config.loader import list_options
from pipeline.errors import DataError, IdentifiabilityError
from pipeline.identification.fit import fit
from pipeline.identification.identified import IdentifiedModel
from pipeline.identification.model import CoefficientModel, coefficient_model
from pipeline.identification.outcome import Outcome
from pipeline.identification.residual_loss import ResidualTraining, initial_parameters, prepare_residual
from pipeline.identification.storage import ARCHITECTURE, WEIGHTS, load_model, save_model
from pipeline.identification.training import (
    FitSetup,
    Minimum,
    Progress,
    held_out_speeds,
    initial_guess,
    minimise,
)
from pipeline.problem.measurement import Measurement

pytestmark = pytest.mark.usefixtures("one_thread")

FOREVER = 100_000  # patience: no early stopping


def optimizer(
    adam: int = 0,
    lbfgs: int = 0,
    lm: int = 0,
    rate: float = 0.1,
    final: float = 1e-3,
    patience: int = FOREVER,
) -> OptimizerConfig:
    """Phases of so many steps."""
    return OptimizerConfig(
        adam=AdamConfig(steps=adam, patience=patience, learning_rate=rate, final_rate_fraction=final),
        lbfgs=LBFGSConfig(steps=lbfgs, patience=patience, history=10),
        levenberg_marquardt=LevenbergMarquardtConfig(steps=lm, patience=patience, initial_damping=0.01),
    )


def setup_of(
    machine: Machine,
    phases: OptimizerConfig,
    parametrisation: str = "log",
    scaling: str = "per_speed",
    holdout_every: int = 0,
    tolerance: float = 0.0,
) -> FitSetup:
    """The experiment's model, trained by ``phases``."""
    return FitSetup(
        machine.config.model.model_copy(update={"parametrisation": parametrisation}),
        LossConfig(kind="residual", scaling=scaling, regularisation=0.0),
        phases,
        TrainingConfig(holdout_every=holdout_every, tolerance=tolerance),
    )


def asked(machine: Machine, *unknowns: str, shared: bool = False) -> Measurement:
    """The machine's clean data, with these coefficients unknown (kxx and kyy)."""
    names = unknowns or ("kxx", "kyy")
    return replace(machine.measurement, unknowns=unknown_at_all(machine.rotor.bearing_nodes, names, shared))


def starts(training: ResidualTraining, setup: FitSetup, guesses: list[float]) -> torch.Tensor:
    """(G, M, P) one training a guess, N/m."""
    return torch.cat([initial_parameters(training, setup, 0, guess) for guess in guesses])


def run(
    training: ResidualTraining,
    start: torch.Tensor,
    setup: FitSetup,
    progress: Progress | None = None,
    record_trajectory: bool = False,
) -> Minimum:
    """Train from there."""
    return minimise(
        training.problem,
        start,
        setup,
        held_out=training.held_out,
        progress=progress,
        record_trajectory=record_trajectory,
    )


def trained(measurement: Measurement, setup: FitSetup, guesses: list[float]) -> tuple[ResidualTraining, Minimum]:
    """All guesses at once."""
    training = prepare_residual(measurement, setup)
    return training, run(training, starts(training, setup, guesses), setup)


def errors(machine: Machine, training: ResidualTraining, found: Minimum) -> np.ndarray:
    """(G,) the largest relative error of any coefficient and speed."""
    worst = []
    for parameters in found.parameters:
        values = training.identified(parameters).values(machine.speeds)
        true = np.stack([machine.bearings.coefficient(n) for n in training.model.unknowns], axis=-1)
        worst.append(np.abs(values / true - 1).max())
    return np.array(worst)


# --- derivatives ---------------------------------------------------------------------------------


def a_model(
    depth: int | None,
    activation: str = "tanh",
    parametrisation: str = "log",
    unknowns: int = 3,
    members: int = 2,
) -> CoefficientModel:
    """A small model; depth None for constants."""
    names = ("kxx", "kyy", "cxx", "cyy")[:unknowns]
    return CoefficientModel(
        unknowns=names,
        inputs=("speed",),
        parametrisation=parametrisation,
        scale=tuple(tuple(10.0 ** (6 + u + m) for u in range(unknowns)) for m in range(members)),
        hidden=None if depth is None else tuple(3 + layer for layer in range(depth)),
        activation=activation,
        input_scaling="log_rpm",
        ranges=((10.0, 600.0),),
    )


SHAPES = [(None, "tanh")] + [(depth, act) for depth in (1, 2, 3) for act in ("tanh", "silu", "sine")]


@pytest.mark.parametrize(("depth", "activation"), SHAPES)
def test_network_jacobian_equals_autograd(depth: int | None, activation: str, generator: torch.Generator) -> None:
    """The hand-written back-propagation against torch's reverse mode, for every depth and activation."""
    model = a_model(depth, activation)
    inputs = model.scaled_inputs(speed=np.array([10.0, 90.0, 333.0, 600.0]))
    parameters = torch.randn(2, 2, model.n_parameters, generator=generator, dtype=torch.float64)
    found = model.raw_jacobian(parameters, inputs)
    assert found.shape == (2, 2, 1 if depth is None else 4, 3, model.n_parameters) or depth is None
    for g in range(2):
        for m in range(2):
            wanted = torch.autograd.functional.jacobian(lambda p: model.raw(p, inputs), parameters[g, m])
            torch.testing.assert_close(found[g, m].expand_as(wanted), wanted, rtol=1e-10, atol=1e-12)


@pytest.mark.parametrize("parametrisation", ["log", "scaled"])
@pytest.mark.parametrize("depth", [None, 1, 2])
@pytest.mark.parametrize("tied", [False, True])
def test_problem_jacobian_equals_autograd(
    parametrisation: str, depth: int | None, tied: bool, hydrostatic: Machine, generator: torch.Generator
) -> None:
    """What Levenberg-Marquardt steps by is the derivative of the rows that the loss squares."""
    setup = setup_of(hydrostatic, optimizer(lm=1), parametrisation)
    kind: dict[str, object] = {"width": 3, "depth": depth}
    model = hydrostatic.config.model.model_copy(update=kind | {"parametrisation": parametrisation})
    if depth is None:
        model = compose_config(["experiment=ball_bearing", f"model.parametrisation={parametrisation}"]).model
    few = np.arange(0, 60, 9)
    measurement = asked(hydrostatic, "kxx", "kyy", "cxx", shared=tied).select(few)
    prepared = prepare_residual(measurement, replace(setup, model=model))
    shape = (1, 1 if tied else 2, prepared.model.n_parameters)
    parameters = 0.3 * torch.randn(*shape, generator=generator, dtype=torch.float64)
    found = prepared.problem.jacobian(parameters)
    wanted = torch.autograd.functional.jacobian(prepared.problem.rows, parameters)  # (1, M, rows, 1, M, P)
    for m in range(shape[1]):
        torch.testing.assert_close(found[0, m], wanted[0, m, :, 0, m], rtol=1e-9, atol=1e-11)
        others = [other for other in range(shape[1]) if other != m]
        assert not wanted[0, m, :, 0, others].any()  # a bearing's rows know nothing of the other's parameters


@given(raw=st.floats(-20, 20), scale=st.floats(1e2, 1e9))
def test_slope_of_the_parametrisation(raw: float, scale: float) -> None:
    """d exp(r) / dr = exp(r), dr / dr = 1, times the scale."""
    at, size = torch.tensor([raw], dtype=torch.float64), torch.tensor([scale], dtype=torch.float64)
    for parametrisation in ("log", "scaled"):
        model = a_model(None, parametrisation=parametrisation, unknowns=1)
        wanted = torch.autograd.functional.jacobian(lambda r, model=model: model.physical(r, size), at)
        torch.testing.assert_close(model.physical_slope(at, size), wanted[0], rtol=1e-14, atol=0)


# --- starting points -----------------------------------------------------------------------------


@pytest.mark.parametrize("parametrisation", ["log", "scaled"])
@pytest.mark.parametrize("guess", [1.0, 3e4, 1e8])
def test_constants_start_at_the_guess(parametrisation: str, guess: float, ball: Machine) -> None:
    """Paper, Figure 2: a training starts at its initial guess, here to rounding, from 1 to 1e8 N/m."""
    setup = setup_of(ball, optimizer(lm=1), parametrisation)
    prepared = prepare_residual(asked(ball), setup)
    start = prepared.identified(starts(prepared, setup, [guess])[0])
    np.testing.assert_allclose(start.values(ball.speeds), guess, rtol=1e-13)


@pytest.mark.parametrize("depth", [1, 2])
@pytest.mark.parametrize("guess", [1.0, 1e8])
def test_networks_start_near_the_guess(depth: int, guess: float, hydrostatic: Machine) -> None:
    """Paper, Figure 2, for a network: at every speed and with any seed within a factor four of the guess."""
    setup = setup_of(hydrostatic, optimizer(lm=1))
    setup = replace(setup, model=setup.model.model_copy(update={"depth": depth}))
    prepared = prepare_residual(asked(hydrostatic), setup)
    for seed in range(5):
        start = prepared.identified(initial_parameters(prepared, setup, seed, guess)[0])
        assert np.abs(np.log(start.values(hydrostatic.speeds) / guess)).max() < np.log(4)


def test_configured_guess_and_seed(hydrostatic: Machine) -> None:
    """Stiffness and damping start where the configuration says; another seed gives another network."""
    setup, names = setup_of(hydrostatic, optimizer(lm=1)), ("kxx", "cyy", "kxy")
    np.testing.assert_array_equal(initial_guess(setup, unknown_at_all((1, 5), names)), [[1e6, 1e4, 0.0]] * 2)
    np.testing.assert_array_equal(initial_guess(setup, unknown_at_all((1, 5), names, True), 7.0), [[7.0, 1e4, 0.0]])
    prepared = prepare_residual(asked(hydrostatic, "kxx", "cyy"), setup)
    first, again, other = (initial_parameters(prepared, setup, seed) for seed in (3, 3, 4))
    assert torch.equal(first, again)
    assert not torch.equal(first, other)
    assert not torch.equal(first[:, 0], first[:, 1])  # each bearing has a network of its own


@pytest.mark.parametrize("scaling", ["rpm", "log_rpm"])
def test_inputs_are_scaled_to_one(scaling: str, hydrostatic: Machine) -> None:
    """The trained range of speeds becomes -1 to 1, evenly in rpm or its logarithm; a single speed -1."""
    config = hydrostatic.config.model.model_copy(update={"input_scaling": scaling})
    model = coefficient_model(config, ("kxx",), hydrostatic.speeds, np.ones((1, 1)))
    speeds = hydrostatic.speeds[[0, -1]]
    middle = np.sqrt(speeds.prod()) if scaling == "log_rpm" else speeds.mean()
    found = model.scaled_inputs(speed=np.array([speeds[0], middle, speeds[1]]))
    assert found.dtype == torch.float64
    np.testing.assert_allclose(found.numpy(), [[-1.0], [0.0], [1.0]], atol=1e-12)
    alone = coefficient_model(config, ("kxx",), speeds[:1], np.ones((1, 1)))
    np.testing.assert_allclose(alone.scaled_inputs(speed=speeds[:1]).numpy(), [[-1.0]])


# --- recovering a known truth --------------------------------------------------------------------

CHAINS = {
    # phases, largest relative error: first order reaches what its last learning rate allows
    "adam": (optimizer(adam=800), 1e-4),
    "lbfgs": (optimizer(lbfgs=60), 1e-12),
    "levenberg_marquardt": (optimizer(lm=40), 1e-12),
    "adam, lbfgs": (optimizer(adam=300, lbfgs=30), 1e-12),
    "adam, levenberg_marquardt": (optimizer(adam=300, lm=20), 1e-12),
    "all three": (optimizer(adam=250, lbfgs=10, lm=10), 1e-12),
}


@pytest.mark.parametrize("chain", CHAINS)
@pytest.mark.parametrize("parametrisation", ["log", "scaled"])
def test_known_truth_is_recovered(chain: str, parametrisation: str, ball: Machine) -> None:
    """Paper, section 4.1 and Figure 2: from 1 and 1e8 N/m (log), from 1e4 to 1e8 N/m (scaled), to the truth.

    L-BFGS by itself starts at 1e4 N/m in the log parametrisation too: far below the truth exp(r) is flat,
    and its first line search leaves that plateau in one coefficient and not in the other. Adam goes first.
    """
    phases, bar = CHAINS[chain]
    guesses = [1.0, 1e8] if parametrisation == "log" and chain != "lbfgs" else [1e4, 1e6, 1e8]
    assert errors(ball, *trained(asked(ball), setup_of(ball, phases, parametrisation), guesses)).max() < bar


@pytest.mark.slow
@pytest.mark.parametrize("name", list_options("optimizer"))
@pytest.mark.parametrize("guess", [1.0, 1e8])
def test_optimizers_of_conf_recover_the_truth(name: str, guess: float, ball: Machine) -> None:
    """Paper, Figure 2: with every file of conf/optimizer, as it is, the guess does not matter."""
    config = compose_config(["experiment=ball_bearing", f"optimizer={name}"])
    setup = replace(setup_of(ball, config.optimizer), training=config.training)
    assert errors(ball, *trained(asked(ball), setup, [guess])).max() < (1e-3 if name == "adam" else 1e-9)


def test_four_unknowns_without_scaling(ball: Machine) -> None:
    """Eq. 6 as the paper writes it, unscaled: second order still finds stiffness and damping of each bearing.

    A ball bearing's damping force is 1e-6 of its stiffness force at these speeds, which bounds its accuracy.
    """
    setup = setup_of(ball, optimizer(lm=80), scaling="none")
    training, minimum = trained(asked(ball, "kxx", "kyy", "cxx", "cyy"), setup, [1e6])
    found, true = training.identified(minimum.parameters[0]).table(ball.bearings), ball.bearings
    np.testing.assert_allclose(found.values[..., [0, 3]], true.values[..., [0, 3]], rtol=1e-10)
    np.testing.assert_allclose(found.values[..., [4, 7]], true.values[..., [4, 7]], rtol=1e-6)
    np.testing.assert_array_equal(found.values[..., [1, 2, 5, 6]], true.values[..., [1, 2, 5, 6]])


def test_small_network_beats_a_constant(hydrostatic: Machine) -> None:
    """Paper, section 4.2, in small: a network of the speed follows what a constant can't, held out or not."""
    setup = setup_of(hydrostatic, optimizer(lm=60), holdout_every=10)
    setup = replace(setup, model=setup.model.model_copy(update={"width": 8}))
    training, batch = trained(asked(hydrostatic), setup, [1e7])
    true = np.stack([hydrostatic.bearings.coefficient(name) for name in ("kxx", "kyy")], axis=-1)
    constant = np.abs(true.mean(axis=1, keepdims=True) / true - 1).mean()
    error = np.abs(training.identified(batch.parameters[0]).values(hydrostatic.speeds) / true - 1).mean()
    assert error < 1e-2 * constant
    assert batch.held_out_loss[0] < 1e-2


def test_tied_bearings_are_identical(ball: Machine) -> None:
    """method.md, section 3, both bearings alike: one set of coefficients for both, and the true one."""
    training, batch = trained(asked(ball, shared=True), setup_of(ball, optimizer(lm=40)), [1.0, 1e8])
    assert batch.parameters.shape == (2, 1, 2)
    for g in range(2):
        values = training.identified(batch.parameters[g]).values(ball.speeds)
        assert values.shape == (2, 25, 2)
        np.testing.assert_array_equal(values[0], values[1])
    assert errors(ball, training, batch).max() < 1e-12


def test_tied_fit_of_unlike_bearings_is_a_compromise(hydrostatic: Machine) -> None:
    """The two journals of a rotor move differently; a tied model has both bearings' residual in one norm."""
    setup = setup_of(hydrostatic, optimizer(lm=1))
    tied, single = (prepare_residual(asked(hydrostatic, shared=shared), setup) for shared in (True, False))
    assert (len(tied.model.scale), len(single.model.scale)) == (1, 2)
    parameters = torch.zeros(1, 2, single.model.n_parameters, dtype=torch.float64)
    same = replace(single.problem, scale=tied.problem.scale.expand(2, -1, -1))
    both = same.loss(parameters).square().mean(dim=1).sqrt()
    torch.testing.assert_close(tied.problem.loss(parameters[:, :1])[:, 0], both, rtol=1e-12, atol=0)


def test_known_answer_has_zero_gradient(ball: Machine) -> None:
    """At the modelled coefficients J^T r is 1e-9 of what it is 1 % away, and the loss is rounding."""
    names = ("kxx", "kyy", "cxx", "cyy")
    prepared = prepare_residual(asked(ball, *names), setup_of(ball, optimizer(lm=1)))
    true = np.stack([ball.bearings.coefficient(name)[:, 0] for name in names], axis=-1)
    generator = torch.Generator().manual_seed(0)
    gradients = []
    for guess in (true, 1.01 * true):
        at = prepared.model.initial_parameters(guess, generator)[None]
        rows, jacobian = prepared.problem.rows(at), prepared.problem.jacobian(at)
        gradients.append(float((jacobian.mT @ rows[..., None]).abs().max()))
        if guess is true:
            assert float(prepared.problem.loss(at).max()) < 1e-10
    assert gradients[0] < 1e-9 * gradients[1]


def test_second_order_answer_is_the_least_squares_one(hydrostatic: Machine, rng: np.random.Generator) -> None:
    """On noisy data constants have a closed form: the p of least |A p + y| over all speeds."""
    data = hydrostatic.dataset.displacement
    noise = rng.normal(size=data.shape) + 1j * rng.normal(size=data.shape)
    noisy = replace(hydrostatic.dataset, displacement=data + 1e-5 * np.abs(data) * noise)
    setup = setup_of(hydrostatic, optimizer(lm=60))
    constant = compose_config(["experiment=ball_bearing"]).model
    measurement = replace(asked(hydrostatic), dataset=noisy)
    prepared, batch = trained(measurement, replace(setup, model=constant), [1e6])
    problem = prepared.problem
    wanted = [np.linalg.lstsq(problem.matrix[b, 0].numpy(), -problem.offset[b, 0].numpy())[0] for b in range(2)]
    found = prepared.identified(batch.parameters[0]).values(hydrostatic.speeds[:1])[:, 0]
    np.testing.assert_allclose(found, wanted, rtol=1e-9)
    assert batch.loss[0] > 1e-3  # noise remains


# --- many at once --------------------------------------------------------------------------------


@pytest.mark.parametrize("phases", [optimizer(adam=60), optimizer(lm=15), optimizer(lbfgs=8)])
def test_guesses_trained_together_do_not_influence_each_other(phases: OptimizerConfig, ball: Machine) -> None:
    """Five guesses at once end where each ends alone (1e-12; steps forced equal, no early stopping)."""
    guesses = [1.0, 1e2, 1e4, 1e6, 1e8]
    setup = setup_of(ball, phases)
    _, together = trained(asked(ball), setup, guesses)
    for g, guess in enumerate(guesses):
        _, alone = trained(asked(ball), setup, [guess])
        torch.testing.assert_close(together.parameters[g], alone.parameters[0], rtol=1e-12, atol=1e-12)
        assert together.loss[g] == pytest.approx(alone.loss[0], rel=1e-12, abs=1e-14)


def test_seeds_of_a_network_trained_together(hydrostatic: Machine) -> None:
    """The same for networks from several seeds, where members share no numbers but the data."""
    setup = setup_of(hydrostatic, optimizer(adam=15))
    setup = replace(setup, model=setup.model.model_copy(update={"width": 6}))
    prepared = prepare_residual(asked(hydrostatic), setup)
    parts = [initial_parameters(prepared, setup, seed) for seed in range(3)]
    together = run(prepared, torch.cat(parts), setup)
    for g, part in enumerate(parts):
        alone = run(prepared, part, setup)
        torch.testing.assert_close(together.parameters[g], alone.parameters[0], rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("phases", [optimizer(lm=60), optimizer(adam=40, lm=60)])
def test_a_training_that_is_over_stays_while_others_go_on(phases: OptimizerConfig, hydrostatic: Machine) -> None:
    """Each seed stops by its own loss, at another step, and ends where it ends alone."""
    setup = setup_of(hydrostatic, phases)
    setup = replace(
        setup,
        model=setup.model.model_copy(update={"width": 4}),
        training=setup.training.model_copy(update={"tolerance": 0.2}),
        optimizer=setup.optimizer.model_copy(
            update={"levenberg_marquardt": setup.optimizer.levenberg_marquardt.model_copy(update={"patience": 2})}
        ),
    )
    prepared = prepare_residual(asked(hydrostatic), setup)
    parts = [initial_parameters(prepared, setup, seed) for seed in range(3)]
    together = run(prepared, torch.cat(parts), setup)
    steps = set()
    for g, part in enumerate(parts):
        alone = run(prepared, part, setup)
        steps.add(alone.steps)
        assert together.outcomes[g] is alone.outcomes[0]
        assert together.loss[g] == pytest.approx(alone.loss[0], rel=1e-6)
    assert len(steps) > 1
    assert together.steps == max(steps)


def test_same_seed_same_bits(hydrostatic: Machine) -> None:
    """A training repeats itself to the last bit; another seed is another network with a near answer."""
    setup = setup_of(hydrostatic, optimizer(adam=10, lm=40), holdout_every=10)
    setup = replace(setup, model=setup.model.model_copy(update={"width": 8}))
    prepared = prepare_residual(asked(hydrostatic), setup)
    first, again, other = (run(prepared, initial_parameters(prepared, setup, seed), setup) for seed in (1, 1, 2))
    assert torch.equal(first.parameters, again.parameters)
    assert [row["loss"] for row in first.history] == [row["loss"] for row in again.history]
    assert not torch.equal(first.parameters, other.parameters)
    values = [prepared.identified(one.parameters[0]).values(hydrostatic.speeds) for one in (first, other)]
    assert np.abs(values[0] / values[1] - 1).mean() < 0.05


# --- outcomes ------------------------------------------------------------------------------------


def test_converged(ball: Machine) -> None:
    """No improvement above the tolerance for `patience` steps: converged, before the budget is spent."""
    _, batch = trained(asked(ball), setup_of(ball, optimizer(lm=500, patience=5), tolerance=0.1), [1e6])
    assert batch.outcomes == (Outcome.CONVERGED,)
    assert batch.steps < 100
    assert batch.loss[0] < 1e-14


def test_budget_spent(ball: Machine) -> None:
    """The loss still falls at the last step."""
    _, batch = trained(asked(ball), setup_of(ball, optimizer(adam=20, patience=5), tolerance=0.0), [1.0])
    assert batch.outcomes == (Outcome.BUDGET_SPENT,)
    assert batch.steps == 21  # and the start


@pytest.mark.parametrize(("rate", "parametrisation"), [(1e6, "scaled"), (1e4, "log")])
def test_diverged(rate: float, parametrisation: str, ball: Machine) -> None:
    """A learning rate far too large: diverged (in the log case by overflow); the best state is kept."""
    setup = setup_of(ball, optimizer(adam=10, rate=rate, final=1.0), parametrisation)
    prepared = prepare_residual(asked(ball), setup)
    start = starts(prepared, setup, [1e6])
    batch = run(prepared, start, setup)
    assert batch.outcomes == (Outcome.DIVERGED,)
    assert batch.parameters.isfinite().all()
    assert batch.loss[0] <= float(prepared.problem.loss(start).square().mean().sqrt()) * (1 + 1e-12)


def test_one_diverged_member_leaves_the_others_alone(ball: Machine) -> None:
    """A training that starts at NaN is called diverged, by itself."""
    setup = setup_of(ball, optimizer(lm=40))
    prepared = prepare_residual(asked(ball), setup)
    start = starts(prepared, setup, [1e6, 1e6])
    start[0] = float("nan")
    batch = run(prepared, start, setup)
    assert batch.outcomes[0] is Outcome.DIVERGED
    assert batch.outcomes[1] is not Outcome.DIVERGED
    assert batch.loss[1] < 1e-12


@pytest.mark.parametrize(
    ("phases", "after"),
    [
        (optimizer(adam=500), 100),
        (optimizer(lbfgs=50), 3),
        (optimizer(lm=50), 4),
        (optimizer(adam=50, lm=9), 53),
    ],
)
@pytest.mark.parametrize("holdout_every", [0, 10])
def test_interrupted_training_keeps_the_best_state(
    phases: OptimizerConfig, after: int, holdout_every: int, ball: Machine
) -> None:
    """Ctrl-C in any phase: the best state so far, called interrupted, is no worse than the start."""
    setup = setup_of(ball, phases, holdout_every=holdout_every)
    prepared = prepare_residual(asked(ball), setup)
    start = starts(prepared, setup, [1e6])
    calls = 0

    def interrupt(phase: str, step: int, total: int, loss: float) -> None:
        nonlocal calls
        calls += 1
        if calls == after:
            raise KeyboardInterrupt

    batch = run(prepared, start, setup, interrupt)
    assert batch.outcomes == (Outcome.INTERRUPTED,)
    assert calls == after == len(batch.history)
    assert batch.loss[0] < float(prepared.problem.loss(start).square().mean().sqrt())
    score = "held_out_loss" if holdout_every else "loss"
    reached = batch.held_out_loss if holdout_every else batch.loss
    assert reached[0] <= min(row[score] for row in batch.history) * (1 + 1e-12)


def test_progress_and_history(ball: Machine) -> None:
    """Every step is shown with its phase and counted within it; the history has one row a step."""
    seen: list[tuple[str, int, int]] = []

    def progress(phase: str, step: int, total: int, loss: float) -> None:
        seen.append((phase, step, total))

    setup = setup_of(ball, optimizer(adam=3, lbfgs=2, lm=2))
    prepared = prepare_residual(asked(ball), setup)
    batch = run(prepared, starts(prepared, setup, [1e6]), setup, progress, record_trajectory=True)
    phases = [("adam", 3), ("lbfgs", 2), ("levenberg_marquardt", 2)]
    wanted = [("start", 1, 1)] + [(phase, k + 1, total) for phase, total in phases for k in range(total)]
    assert seen == wanted
    assert [row["phase"] for row in batch.history] == [phase for phase, _, _ in wanted]
    assert [row["step"] for row in batch.history] == list(range(8))
    assert [step for step, _ in batch.trajectory] == list(range(8))
    assert batch.steps == 8


@pytest.mark.parametrize("chain", CHAINS)
def test_loss_never_ends_above_its_start(chain: str, hydrostatic: Machine) -> None:
    """The best state is at most as bad as the start, whatever the optimiser did; few steps of a network."""
    phases = CHAINS[chain][0]
    short = {name: {"steps": min(getattr(phases, name).steps, 3)} for name in OptimizerConfig.model_fields}
    parts = {name: getattr(phases, name).model_copy(update=part) for name, part in short.items()}
    setup = setup_of(hydrostatic, OptimizerConfig(**parts))
    prepared = prepare_residual(asked(hydrostatic), setup)
    start = initial_parameters(prepared, setup, 0)
    batch = run(prepared, start, setup)
    assert batch.loss[0] <= float(prepared.problem.loss(start).square().mean().sqrt())


def test_too_few_runs_are_refused_before_training(ball: Machine) -> None:
    """method.md, section 3: one run cannot tell four coefficients of a row."""
    network = compose_config(["experiment=hydrostatic_stiffness"]).model
    setup = replace(setup_of(ball, optimizer(lm=1)), model=network)
    with pytest.raises(IdentifiabilityError, match="the 1 run determine 4 of 8 unknowns"):
        fit(asked(ball, *COEFFICIENTS), setup)


# --- held-out speeds -----------------------------------------------------------------------------


@given(count=st.integers(1, 700), every=st.one_of(st.just(0), st.integers(2, 800)))
def test_held_out_speeds(count: int, every: int) -> None:
    """Every k-th speed, never the first and the last; at least half of the speeds are trained on."""
    mask = held_out_speeds(count, every)
    assert mask.shape == (count,)
    held = np.flatnonzero(mask)
    assert mask.sum() <= count / 2
    assert not mask[[0, -1]].any()
    assert (np.diff(held) == every).all()
    if every and count > every + 1:
        assert abs(mask.sum() - count / every) <= 1


def test_held_out_speeds_are_not_trained_on(hydrostatic: Machine) -> None:
    """A spoiled measurement at a held-out speed leaves the trained problem alone, and shows in the other."""
    setup = setup_of(hydrostatic, optimizer(lm=1), holdout_every=10)
    mask = held_out_speeds(60, 10)
    data = hydrostatic.dataset
    spoiled = replace(data, displacement=data.displacement * np.where(mask, 1.3, 1.0)[:, None, None])
    clean, other = (prepare_residual(replace(asked(hydrostatic), dataset=one), setup) for one in (data, spoiled))
    parameters = initial_parameters(clean, setup, 0)
    other_train = replace(other.problem, scale=clean.problem.scale)
    assert other.held_out is not None
    other_held = replace(other.held_out, scale=clean.problem.scale)
    torch.testing.assert_close(other_train.loss(parameters), clean.problem.loss(parameters), rtol=1e-14, atol=0)
    assert not torch.equal(other_held.loss(parameters), clean.held_out.loss(parameters))


# --- files ---------------------------------------------------------------------------------------


@pytest.fixture
def saved(tmp_path: Path, generator: torch.Generator) -> tuple[Path, IdentifiedModel]:
    """A model with random numbers and its folder."""
    model = a_model(2)
    parameters = torch.randn(2, model.n_parameters, generator=generator, dtype=torch.float64)
    identified = IdentifiedModel(model, unknown_at_all((1, 5), model.unknowns), (1, 5), parameters)
    assert sorted(path.name for path in save_model(tmp_path, identified)) == sorted([ARCHITECTURE, WEIGHTS])
    return tmp_path, identified


@pytest.mark.parametrize("depth", [None, 1, 3])
def test_storage_round_trip(depth: int | None, tmp_path: Path, generator: torch.Generator) -> None:
    """What is saved comes back with the same bits, architecture and scaling included."""
    model = a_model(depth, "silu", members=1)
    parameters = torch.randn(1, model.n_parameters, generator=generator, dtype=torch.float64)
    identified = IdentifiedModel(model, unknown_at_all((1, 5), model.unknowns), (1, 5), parameters)
    save_model(tmp_path, identified)
    loaded = load_model(tmp_path)
    assert (loaded.model, loaded.bearing_nodes) == (model, (1, 5))
    assert torch.equal(loaded.parameters, parameters)
    speeds = np.array([10.0, 200.0, 601.0])
    np.testing.assert_array_equal(loaded.values(speeds), identified.values(speeds))
    assert not [path for path in tmp_path.iterdir() if path.name.startswith(".")]


def _truncate(folder: Path) -> None:
    path = folder / WEIGHTS
    path.write_bytes(path.read_bytes()[:-20])


def _change(**values: object) -> Callable[[Path], None]:
    def change(folder: Path) -> None:
        path = folder / ARCHITECTURE
        path.write_text(json.dumps(json.loads(path.read_text()) | values))

    return change


def _drop_a_layer(folder: Path) -> None:
    path = folder / ARCHITECTURE
    description = json.loads(path.read_text())
    description["model"]["hidden"] = [3]
    path.write_text(json.dumps(description))


DAMAGES = {
    "truncated weights": _truncate,
    "no weights": lambda folder: (folder / WEIGHTS).unlink(),
    "weights are something else": lambda folder: (folder / WEIGHTS).write_bytes(b"PK\x03\x04 a pickle"),
    "no architecture": lambda folder: (folder / ARCHITECTURE).unlink(),
    "architecture is no JSON": lambda folder: (folder / ARCHITECTURE).write_text("{"),
    "architecture is a list": lambda folder: (folder / ARCHITECTURE).write_text("[]"),
    "older schema": _change(schema=0),
    "model is a list": _change(model=[1]),
    "model has no fields": _change(model={}),
    "another architecture": _drop_a_layer,
}


@pytest.mark.parametrize("damage", DAMAGES)
def test_damaged_model_is_refused(damage: str, saved: tuple[Path, IdentifiedModel]) -> None:
    """Weights are data, never code: what does not fit is refused with a sentence, not with a traceback."""
    folder, _ = saved
    DAMAGES[damage](folder)
    with pytest.raises(DataError, match="must"):
        load_model(folder)


def test_network_model_of_conf_is_the_one_that_is_built(hydrostatic: Machine) -> None:
    """Width, depth and parametrisation of the configuration make the architecture."""
    config = NetworkModelConfig.model_validate(hydrostatic.config.model.model_dump() | {"width": 4, "depth": 3})
    model = coefficient_model(config, ("kxx", "kyy"), hydrostatic.speeds, np.ones((2, 2)))
    assert model.sizes == [(1, 4), (4, 4), (4, 4), (4, 2)]
    assert model.n_parameters == 8 + 20 + 20 + 10
