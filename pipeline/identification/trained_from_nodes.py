"""FEM-NN with a population of bearings as its prior: networks trained from the likeliest answer at the nodes.

From random weights a network of all layers ends in valleys of its own. So its output layer first follows the answer at
the nodes; then all weights are trained on the same rows: readings, tolerances, and the prior of functions, which asks
the network for its values at the nodes. Weights that neither tells stay near where they started.

What the network is off by is told by the same functions of the nodes, about the network in place of the spline: bands
are those of the one covariance. Legend: M members, U unknowns, A active ones, K nodes, Q parameters, F features.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from pipeline.identification.blocks import Basis, Prior
from pipeline.identification.model import CoefficientModel
from pipeline.identification.output_error_fit import OutputErrorFit
from pipeline.identification.problem import OutputError
from pipeline.identification.trained_network import TrainedNetworks, start_networks
from pipeline.identification.training import FitSetup, Progress, minimise

if TYPE_CHECKING:
    import torch


def train_from_nodes(
    fit: OutputErrorFit,
    setup: FitSetup,
    progress: Progress | None = None,
    *,
    hold: float = 1e-4,
    points_a_node: int = 8,
    still: float = 3e-4,
    patience: int = 5,
) -> OutputErrorFit:
    """The fit of networks that start at a fit of values at nodes, with its precisions of the readings.

    Args:
        hold: information on each weight about its start, so that none is free.
        points_a_node: at so many times as many places the start follows the answer.
        still: training ends where ``patience`` steps lower the loss by less than this share, which is about one of
            chi-square: far less than what the readings leave open.
    """
    import torch

    problem, spline = fit.problem, fit.problem.model
    model = replace(spline, functions=None, n_functions=0, **setup.model.network)
    over, rest = _spread(points_a_node * spline.n_functions), fit.weights[..., problem.places.n_coefficients :]
    guess, generator = np.zeros(problem.scale[:, 0].shape), torch.Generator().manual_seed(setup.seed)
    start = start_networks(model, guess, generator, over, spline.raw(problem.parameters(fit.weights), over), rest)
    n_of_networks = start.shape[-1] - rest.shape[-1]
    training = problem.of_kind(
        TrainedNetworks,
        basis=replace(problem.basis, model=model),
        inputs=model.scaled_inputs(problem.measurement.dataset.points),
        known=_hold(start[0, 0], n_of_networks, hold),
        nodes=_spread(spline.n_functions),
    )
    minimum = minimise(training, start, setup.ending(patience, still), progress=progress)
    basis = _about(replace(spline, **setup.model.network), training.networks(minimum.parameters)[0])
    weights = fit.weights.clone()
    weights[..., : problem.places.n_coefficients] = 0.0  # deviations from the networks
    weights[..., problem.places.n_coefficients :] = minimum.parameters[..., n_of_networks:]
    functions = Prior(problem.functions.rows, -training.deviate(minimum.parameters)[0])
    return replace(
        fit,
        start=replace(fit.start, held_out={name: _pose(other, basis) for name, other in fit.start.held_out.items()}),
        problem=replace(_pose(problem, basis), functions=functions).update(weights),
        minimum=replace(minimum.after(fit.minimum), parameters=weights),
    )


def _spread(count: int) -> torch.Tensor:
    """(S, 1) scaled speeds, evenly."""
    import torch

    return torch.linspace(-1.0, 1.0, count, dtype=torch.float64)[:, None]


def _hold(start: torch.Tensor, n_of_networks: int, information: float) -> Prior:
    """Each number of the networks about its ``start`` (Q,), the others about zero with unit variance."""
    import torch

    mine = torch.arange(len(start)) < n_of_networks
    rows = torch.diag(torch.where(mine, information**0.5, 1.0).to(start.dtype))
    return Prior(rows, torch.where(mine, rows @ start, 0.0))


def _about(model: CoefficientModel, networks: torch.Tensor) -> Basis:
    """The functions of the nodes about ``networks`` (M, Q), which have no such functions among their own features."""
    import torch

    n_unknowns, count = len(model.unknowns), model.n_functions
    nothing = torch.zeros(len(networks), count * n_unknowns, dtype=networks.dtype)
    parameters = torch.cat([networks[:, :-n_unknowns], nothing, networks[:, -n_unknowns:]], dim=1)
    chosen = torch.eye(model.sizes[-1][0] + 1, dtype=networks.dtype)[:, -count - 1 : -1]
    return Basis(model, parameters, chosen.expand(len(networks), -1, -1), 0)


def _pose(problem: OutputError, basis: Basis) -> OutputError:
    """The problem in deviations from the networks."""
    points = problem.measurement.dataset.points
    return replace(problem, basis=basis, features=basis.at(points), origin=basis.origin(points))
