"""Networks whose hidden layers are trained by the output error: derivatives, halves, mean, scatter, refusals."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from comparing import machine, task
from scipy.interpolate import CubicSpline

from pipeline.comparison.cases import Case
from pipeline.config.compose import compose_config
from pipeline.errors import ConfigError
from pipeline.identification.answer import conclude
from pipeline.identification.blocks import Prior
from pipeline.identification.fit import fit
from pipeline.identification.identified import Fit
from pipeline.identification.model import coefficient_model
from pipeline.identification.output_error_fit import OutputErrorFit, fit_from
from pipeline.identification.output_error_start import prepare_output_error
from pipeline.identification.quality import output_error_quality
from pipeline.identification.trained_fit import TrainedFit, train_hidden
from pipeline.identification.trained_network import hold_between, pose_networks, start_networks
from pipeline.identification.training import FitSetup, setup_of
from pipeline.impedance import PLACES
from pipeline.laws.population import make_priors
from pipeline.parameters.model import ModelParameter
from pipeline.problem.measurement import Measurement

FILM = ("experiment=noisy_stiffness", "machine.speeds.step_rpm=100")
SMALL = ("loss.hidden=trained", "model.width=4", "loss.networks=4")


def data(noise: float = 0.01, *overrides: str) -> Measurement:
    """Probes at the bearings at sixty speeds."""
    return task(Case(noise, "bearings", 60), *FILM, *overrides)


def setup(*overrides: str) -> FitSetup:
    """The experiment's, with trained hidden layers."""
    return setup_of(compose_config([*FILM, *SMALL, *overrides]))


@pytest.fixture(scope="module")
def drawn() -> OutputErrorFit:
    """The fit with hidden layers as drawn, with a residual unbalance and an uncertain modulus."""
    measurement = data(0.01, "identify.unknowns=[kxx,kyy]", "identify.unbalance_planes=[2]")
    uncertain = ModelParameter("youngs_modulus", 0.02, "")
    return fit_from(prepare_output_error(replace(measurement, parameters=(uncertain,)), setup()), setup())


@pytest.fixture(scope="module")
def trained(drawn: OutputErrorFit) -> TrainedFit:
    """The fit that goes on from there."""
    return train_hidden(drawn, setup())


@pytest.mark.slow
def test_the_normal_equations_are_those_of_automatic_differentiation(drawn: OutputErrorFit) -> None:
    """Two layers; each network has precisions of its own."""

    fitted = drawn.problem
    model = replace(fitted.basis.model, hidden=(3, 2))
    generator = torch.Generator().manual_seed(0)
    share = torch.rand(2, len(drawn.problem.measurement.dataset.speeds), 1, 1, generator=generator)
    inputs = model.scaled_inputs(fitted.measurement.dataset.points)
    weighed = replace(fitted, readings=fitted.readings.scaled(share))
    size = 2 * model.n_parameters + 2 * fitted.places.n_planes + 1
    known = Prior(torch.eye(size, dtype=torch.float64)[-1:], torch.tensor([[0.3], [-0.3]], dtype=torch.float64))
    rows = torch.randn(5, 3 * len(fitted.active), generator=generator, dtype=torch.float64)
    functions, points = Prior(rows, rows[:, 0]), torch.linspace(-1, 1, 5, dtype=torch.float64)[:, None]
    posed, between = replace(weighed, functions=functions), hold_between(3, 2, 0.1)
    problem = pose_networks(posed, model, known, inputs, points, between, points_a_node=2)
    numbers = 0.1 * torch.randn(2, 1, size, generator=generator, dtype=torch.float64)
    gradient, matrix = problem.normal(numbers)
    whole = torch.autograd.functional.jacobian(problem.rows, numbers, vectorize=True)
    for g in range(2):
        jacobian, rows = whole[g, 0, :, g, 0], problem.rows(numbers)[g, 0]
        wanted = jacobian.T @ jacobian
        assert float((matrix[g, 0] - wanted).abs().max()) < 1e-10 * float(wanted.abs().max())
        off = (gradient[g, 0] - jacobian.T @ rows).abs().max()
        assert float(off) < 1e-10 * float((jacobian.abs().T @ rows.abs()).max())


@pytest.mark.slow
def test_the_answer_is_the_mean_of_networks_that_were_trained(trained: TrainedFit, drawn: OutputErrorFit) -> None:
    """One network of all hidden units; training lowers the loss of the halves, and of the readings kept from them."""
    assert trained.identified.model.hidden == (16,)
    first, last = (row for row in (trained.minimum.history[drawn.minimum.steps], trained.minimum.history[-1]))
    assert float(last["loss"]) < float(first["loss"])
    assert trained.minimum.outcomes[0].label == "converged"
    assert trained.problem.loss(trained.weights) < 1.05 * drawn.problem.loss(drawn.weights)


@pytest.mark.slow
def test_the_answer_stays_in_a_curved_valley() -> None:
    """Forward whirl leaves a combination of three coefficients nearly free: a mean of logarithms would leave it."""
    measurement = data(0.01, "identify.unknowns=[kxx,kxy,cxx]", "identify.unbalance_planes=[2]")
    found = fit_from(prepare_output_error(measurement, setup()), setup())
    answer = train_hidden(found, setup())
    assert answer.problem.loss(answer.weights) < 1.5 * found.problem.loss(found.weights)


@pytest.mark.slow
def test_the_scatter_has_every_number_and_is_no_linearised_covariance(trained: TrainedFit) -> None:
    covariance = trained.covariance()
    assert covariance.shape == (trained.problem.places.size,) * 2
    assert np.linalg.matrix_rank(covariance) <= 4  # of four networks
    (modulus,) = conclude(trained).parameters
    assert modulus.deviation > 0
    square = output_error_quality(trained).summary["fit"]["chi_square"]
    assert 0 <= square["numbers"] < 100
    assert 0.8 < square["value"] / square["expected"] < 1.2


@pytest.mark.slow
def test_intervals_hold_on_five_data_sets() -> None:
    """Nominal 95 % intervals, wider by Student's factor; errors within a half of those of random features."""
    held, errors = [], []
    truth = machine(*FILM).truth(Case(0.01, "bearings", 60)).values
    for i in range(5):
        measurement = task(Case(0.01, "bearings", 60, i), *FILM)
        found: Fit = fit(measurement, setup("model.width=8", "loss.networks=8"))
        plain = fit(measurement, setup("loss.hidden=drawn", "model.width=24"))
        band = found.deviation(measurement.dataset.speeds)
        off, other = (np.abs(one.table(measurement.known).values - truth) for one in (found, plain))
        stated = ~np.isnan(band)
        held.append((off[stated] <= 1.96 * band[stated]).mean())
        errors.append(np.median(off[stated]) / np.median(other[stated]))
    assert 0.87 <= np.mean(held) <= 1.0
    assert np.median(errors) <= 1.5


@pytest.mark.parametrize(
    ("speeds", "overrides", "words"),
    [
        (60, ("model=constant", "loss.hidden=trained"), "but got model.kind=constant: choose"),
        (60, ("model=b_spline", "loss.hidden=trained"), "but got model.kind=b_spline: choose"),
        (3, SMALL, "4 training speeds or more, which it halves, but got 3"),
    ],
)
def test_there_must_be_hidden_layers_and_four_speeds(speeds: int, overrides: tuple[str, ...], words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        fit(task(Case(0.01, "bearings", speeds), *FILM), setup_of(compose_config([*FILM, *overrides])))


@pytest.mark.slow
@pytest.mark.parametrize("family", ["plain", "tilting_pad", "rolling", "unknown"])
def test_a_network_starts_where_the_nodes_are(family: str) -> None:
    """A bearing drawn from the prior wanders from node to node; the start follows it to half a percent."""

    config = compose_config(["model=bearings_network", "loss=response"]).model
    speeds, over = np.geomspace(100, 700, config.count), torch.linspace(-1, 1, 112, dtype=torch.float64)[:, None]
    (prior,) = make_priors([family], speeds, 1e3, 0.06)
    drawn = prior.mean + prior.root @ np.random.default_rng(0).standard_normal(len(prior.mean))
    wanted = torch.as_tensor(CubicSpline(np.linspace(-1, 1, config.count), drawn.reshape(8, -1).T)(over[:, 0]))
    spline = coefficient_model(config, tuple(PLACES), {"speed": speeds}, np.ones((1, 8)))
    model = replace(spline, functions=None, n_functions=0, **config.network)
    start = start_networks(
        model,
        np.zeros((1, 8)),
        torch.Generator().manual_seed(0),
        over,
        wanted[None, None],
        over.new_zeros(1, 1, 0),
        steep=3.0,
    )
    assert float((model.raw(start, over)[0, 0] - wanted).square().mean(0).sqrt().max()) < 5e-3


def test_between_the_nodes_networks_are_held_to_the_spline() -> None:
    """On it nothing deviates; a value beside it does by what is allowed, in units of that."""

    nodes = np.random.default_rng(0).standard_normal((2, 5))
    values = torch.as_tensor(CubicSpline(np.linspace(-1, 1, 5), nodes, axis=1)(np.linspace(-1, 1, 17)))
    held = hold_between(5, 4, 0.01)
    assert torch.allclose(values @ held.mT, torch.zeros_like(values), atol=1e-11)
    values[1, 6] += 0.01
    assert float((values @ held.mT)[1, 6]) == pytest.approx(1.0)
