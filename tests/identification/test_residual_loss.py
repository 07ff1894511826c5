"""The residual's loss: derivatives against autograd, starts, recovery of a known truth, and its rounding.

The machines are small: ball bearings, 25 speeds, one run; fluid-film bearings, 60 speeds, three runs.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from conftest import Machine, unknown_at_all
from training import CHAINS, asked, assert_close, errors, optimizer, setup_of, starts, trained

from pipeline.config.compose import compose_config
from pipeline.config.loader import list_options
from pipeline.identification.held_out import held_out_speeds
from pipeline.identification.residual_loss import initial_parameters, prepare_residual
from pipeline.identification.training import initial_guess

pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.mark.parametrize("parametrisation", ["log", "scaled"])
@pytest.mark.parametrize("depth", [None, 1, 2])
@pytest.mark.parametrize("tied", [False, True])
def test_problem_jacobian_equals_autograd(
    parametrisation: str, depth: int | None, tied: bool, hydrostatic: Machine, generator: torch.Generator
) -> None:
    """What Levenberg-Marquardt steps by is the derivative of the rows that the loss squares."""
    setup = setup_of(hydrostatic, optimizer(lm=1), parametrisation)
    kind = {"width": 3, "depth": depth, "parametrisation": parametrisation}
    model = hydrostatic.config.model.model_copy(update=kind)
    if depth is None:
        model = compose_config(["experiment=ball_bearing", f"model.parametrisation={parametrisation}"]).model
    measurement = asked(hydrostatic, "kxx", "kyy", "cxx", shared=tied).select(np.arange(0, 60, 9))
    prepared = prepare_residual(measurement, replace(setup, model=model))
    shape = (1, 1 if tied else 2, prepared.problem.model.n_parameters)
    parameters = 0.3 * torch.randn(*shape, generator=generator, dtype=torch.float64)
    found = prepared.problem.jacobian(parameters)
    wanted = torch.autograd.functional.jacobian(prepared.problem.rows, parameters)  # (1, M, rows, 1, M, P)
    for m in range(shape[1]):
        assert_close(found[0, m], wanted[0, m, :, 0, m], rtol=1e-9, atol=1e-11)
        # A bearing's rows know nothing of the other's parameters.
        assert not wanted[0, m, :, 0, [other for other in range(shape[1]) if other != m]].any()
    assert_close(
        prepared.problem.normal(parameters),
        (torch.einsum("gmrq,gmr->gmq", found, prepared.problem.rows(parameters)), found.mT @ found),
        rtol=1e-9,
        atol=1e-11,
    )


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
    """Paper, Figure 2, for a network: at every speed and with any seed within a factor two of the guess."""
    setup = setup_of(hydrostatic, optimizer(lm=1))
    network = {"depth": depth, "width": 48, "activation": "tanh", "parametrisation": "log"}
    setup = replace(setup, model=setup.model.model_copy(update=network))
    prepared = prepare_residual(asked(hydrostatic), setup)
    for seed in range(5):
        start = prepared.identified(initial_parameters(prepared, setup, seed, guess)[0])
        assert np.abs(np.log(start.values(hydrostatic.speeds) / guess)).max() < np.log(2)


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


@pytest.mark.slow
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
def test_optimizers_of_conf_recover_the_truth(name: str, ball: Machine) -> None:
    """Paper, Figure 2: with every file of conf/optimizer, as it is, the guess does not matter."""
    config = compose_config(["experiment=ball_bearing", f"optimizer={name}"])
    setup = replace(setup_of(ball, config.optimizer), training=config.training)
    assert errors(ball, *trained(asked(ball), setup, [1.0, 1e8])).max() < (1e-5 if name == "adam" else 1e-12)


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
    assert error < 1.5e-3 * constant
    assert batch.held_out_loss[0] < 1.5e-4


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
    assert (len(tied.problem.model.scale), len(single.problem.model.scale)) == (1, 2)
    parameters = torch.zeros(1, 2, single.problem.model.n_parameters, dtype=torch.float64)
    same = replace(single.problem, scale=tied.problem.scale.expand(2, -1, -1))
    both = same.loss(parameters).square().mean(dim=1).sqrt()
    assert_close(tied.problem.loss(parameters[:, :1])[:, 0], both, rtol=1e-12, atol=0)


def test_known_answer_has_zero_gradient(ball: Machine, generator: torch.Generator) -> None:
    """At the modelled coefficients J^T r is 1e-9 of what it is 1 % away, and the loss is rounding."""
    names = ("kxx", "kyy", "cxx", "cyy")
    prepared = prepare_residual(asked(ball, *names), setup_of(ball, optimizer(lm=1)))
    true = np.stack([ball.bearings.coefficient(name)[:, 0] for name in names], axis=-1)
    gradients = []
    for guess in (true, 1.01 * true):
        at = prepared.problem.model.initial_parameters(guess, generator)[None]
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
    prepared, batch = trained(replace(asked(hydrostatic), dataset=noisy), replace(setup, model=constant), [1e6])
    problem = prepared.problem
    wanted = [np.linalg.lstsq(problem.matrix[b, 0].numpy(), -problem.offset[b, 0].numpy())[0] for b in range(2)]
    found = prepared.identified(batch.parameters[0]).values(hydrostatic.speeds[:1])[:, 0]
    np.testing.assert_allclose(found, wanted, rtol=1e-9)
    assert batch.loss[0] > 0.1  # noise remains


def test_held_out_speeds_are_not_trained_on(hydrostatic: Machine) -> None:
    """A spoiled measurement at a held-out speed leaves the trained problem alone, and shows in the other."""
    setup = setup_of(hydrostatic, optimizer(lm=1), holdout_every=10)
    data, size = hydrostatic.dataset, np.where(held_out_speeds(60, 10), 1.3, 1.0)
    spoiled = replace(data, displacement=data.displacement * size[:, None, None])
    clean, other = (prepare_residual(replace(asked(hydrostatic), dataset=one), setup) for one in (data, spoiled))
    parameters = initial_parameters(clean, setup, 0)
    train, held_out = (replace(each, scale=clean.problem.scale) for each in (other.problem, other.held_out))
    assert_close(train.loss(parameters), clean.problem.loss(parameters), rtol=1e-14, atol=0)
    assert not torch.equal(held_out.loss(parameters), clean.held_out.loss(parameters))


def test_the_rounding_of_a_loss_follows_the_size_of_the_data() -> None:
    """1e-13 of the loss without any bearing force, whatever the unit of the rows."""
    from pipeline.identification.residual_loss import ResidualProblem

    rng = np.random.default_rng(0)
    offset = torch.as_tensor(rng.normal(size=(2, 5, 3)))
    rest = torch.as_tensor(rng.uniform(size=2))
    matrix = torch.zeros(2, 5, 3, 3, dtype=torch.float64)
    found = [
        ResidualProblem(None, None, size * matrix, size * offset, size**2 * rest, None).rounding()
        for size in (1.0, 1e3)
    ]
    np.testing.assert_allclose(found[0], 1e-13 * np.sqrt((offset.numpy() ** 2).sum((1, 2)) + rest.numpy()))
    np.testing.assert_allclose(found[1], 1e3 * found[0])
