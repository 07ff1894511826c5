"""The output error of networks all of whose weights are trained: the same problem, with other columns.

With a population of bearings as its prior (FEM-NN) a network starts at the likeliest answer at the nodes.
From random weights a network of all layers ends in valleys of its own. So its output layer first follows the answer at
the nodes; then all weights are trained on the same rows: readings, tolerances, and the prior of functions, which asks
the network for its values at the nodes. Weights that neither tells stay near where they started.

What the network is off by is told by the same functions of the nodes, about the network in place of the spline: bands
are those of the one covariance.

Legend: G networks, M members (bearings, or 1 where they share their coefficients), Q parameters of a member, S speeds,
A unknowns that members have, K nodes, L points, F features, N balance planes, T model parameters, Y = M Q + 2 N + T
numbers.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import TYPE_CHECKING, ClassVar, Self

import numpy as np

from pipeline.identification.blocks import Basis, Prior
from pipeline.identification.inputs import evaluate_functions
from pipeline.identification.model import CoefficientModel
from pipeline.identification.output_error_fit import OutputErrorFit
from pipeline.identification.problem import OutputError
from pipeline.identification.training import FitSetup, Progress, minimise

if TYPE_CHECKING:
    import torch


def start_networks(
    model: CoefficientModel,
    guess: np.ndarray,
    generator: torch.Generator,
    inputs: torch.Tensor,
    values: torch.Tensor,
    rest: torch.Tensor,
    steep: float = 1.0,
) -> torch.Tensor:
    """(G, 1, Y) networks of new hidden units, near the coefficients ``values`` (G, M, S, U) at scaled ``inputs``
    (S, 1), and the ``rest`` (G, 1, Y - M Q) of the numbers.

    Hidden units are drawn by the ``generator``, ``steep`` ones for values that bend sharply, for networks that start
    at the ``guess`` (M, U).
    """
    import torch

    networks = [
        model.with_output_at(model.spread_parameters(guess, generator, steep), inputs, value).flatten()
        for value in values
    ]
    return torch.cat([torch.stack(networks)[:, None], rest], dim=-1)


@dataclass(frozen=True, eq=False, kw_only=True)
class TrainedNetworks(OutputError):
    """Least squares of numbers (G, 1, Y): parameters of the members, residual unbalance, model parameters.

    Each of the G networks may weigh the readings by precisions of its own.
    """

    inputs: torch.Tensor  # (S, 1), scaled
    known: Prior  # of the numbers
    points: torch.Tensor  # (L, 1) scaled inputs: the nodes, at which the prior of functions holds, and some between
    between: torch.Tensor  # (L, L) rows of an output's values there, zero but for unit variance
    nodes: slice  # which of the points they are
    carried: ClassVar = ("gsamq", "mq")  # every output may have all parameters of its member

    @cached_property
    def prior(self) -> Prior:
        """What is known of the numbers; what is known of the functions is not linear in them."""
        return self.known

    def at(self, starts: torch.Tensor) -> Self:
        """That of some networks, each of which may have aims of its own."""
        aims = self.known.aims if self.known.aims.ndim == 1 else self.known.aims[starts]
        chosen = super().at(starts)
        return chosen if chosen is self else replace(chosen, known=replace(self.known, aims=aims))

    def rows(self, weights: torch.Tensor) -> torch.Tensor:
        """(G, 1, rows + N), those of the prior of functions last."""
        import torch

        return torch.cat([super().rows(weights), self.deviate(weights)[:, None]], dim=-1)

    def normal(self, weights: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Gradient (G, 1, Y) and information (G, 1, Y, Y)."""
        import torch

        (gradient, matrix), slopes = super().normal(weights), self._slopes(weights, self.points)
        slopes = slopes.flatten(-2).movedim(1, 2)  # (G, A, L, M Q)
        at_nodes, between = self.functions.rows @ slopes[:, :, self.nodes].flatten(1, 2), self.between @ slopes
        by_networks = torch.cat([at_nodes, between.flatten(1, 2)], dim=1)
        slope = torch.nn.functional.pad(by_networks, (0, self.places.n_rest))
        return gradient + self.deviate(weights)[:, None] @ slope, matrix + (slope.mT @ slope)[:, None]

    def carrier(self, weights: torch.Tensor) -> torch.Tensor:
        """(G, S, A, M, Q) derivative of the active outputs by the networks' parameters."""
        return self._slopes(weights, self.inputs)

    def _spread_outputs(self, local: torch.Tensor, later: torch.Tensor, before: torch.Tensor) -> torch.Tensor:
        """(G, M Q, M Q), as that of features, for whose numbers those of the networks are."""
        import torch

        return torch.einsum("gsamq,gsab,gsbnr->gmqnr", later, local, before).flatten(3).flatten(1, 2)

    def _slopes(self, weights: torch.Tensor, inputs: torch.Tensor) -> torch.Tensor:
        """(G, S, A, M, Q) derivative of the active outputs by the networks' parameters: zero but for their own."""
        jacobian = self.basis.model.raw_jacobian(self.networks(weights), inputs)  # (G, M, S, U, Q)
        slopes = jacobian.new_zeros(len(weights), len(inputs), len(self.active), jacobian.shape[1], jacobian.shape[-1])
        for a, (m, u) in enumerate(self.active):
            slopes[:, :, a, m] = jacobian[:, m, :, u]
        return slopes

    def deviate(self, weights: torch.Tensor) -> torch.Tensor:
        """(G, N + A L) of the networks' values at the nodes from the prior of functions, and of those between."""
        import torch

        values = self.basis.model.raw(self.networks(weights), self.points)  # (G, M, L, U)
        every = torch.stack([values[:, m, :, u] for m, u in self.active], dim=1)
        at_nodes = self.functions.deviations(every[..., self.nodes].flatten(1))
        return torch.cat([at_nodes, (every @ self.between.mT).flatten(1)], dim=1)

    def networks(self, numbers: torch.Tensor) -> torch.Tensor:
        """(G, M, Q) parameters of the coefficient model."""
        import torch

        return torch.unflatten(numbers[:, 0, self.places.coefficients], -1, (len(self.scale), -1))

    def outputs(self, weights: torch.Tensor) -> torch.Tensor:
        """(G, M, S, U) outputs of the networks."""
        return self.basis.model.raw(self.networks(weights), self.inputs)


def pose_networks(
    problem: OutputError,
    model: CoefficientModel,
    known: Prior,
    inputs: torch.Tensor,
    points: torch.Tensor,
    between: torch.Tensor,
    points_a_node: int = 1,
) -> TrainedNetworks:
    """The ``problem`` with networks in place of functions, whose parameters are all fitted; what is given besides is as
    in :class:`TrainedNetworks`."""
    import torch

    same = {entry.name: getattr(problem, entry.name) for entry in fields(OutputError)}
    same["basis"] = replace(problem.basis, model=model)
    same["kept"] = torch.ones(len(model.scale), model.n_parameters, dtype=torch.bool)
    nodes = slice(None, None, points_a_node)
    return TrainedNetworks(**same, known=known, inputs=inputs, points=points, between=between, nodes=nodes)


# --- from an answer at nodes -----------------------------------------------------------------------------


def train_from_nodes(
    fit: OutputErrorFit,
    setup: FitSetup,
    progress: Progress | None = None,
    *,
    hold: float = 1e-4,
    points_a_node: int = 8,
    between: float = 0.01,
    steep: float = 3.0,
    still: float = 3e-4,
    exact: float = 0.8,
    patience: int = 5,
) -> OutputErrorFit:
    """The fit of networks that start at a fit of values at nodes, with its precisions of the readings.

    Args:
        hold: information on each weight about its start, so that none is free.
        points_a_node: at so many times as many places the start follows the answer, and networks follow the spline.
        between: deviation of networks from the spline through their values at the nodes, of a coefficient. The prior
            knows nodes alone: free between them, networks follow the noise of few speeds there.
        steep: a hidden unit bends within a third of what it does in a network of its own, about two of fourteen nodes.
            Wider ones can't follow bearings whose coefficients wander from node to node: on one of them training
            stopped at twice the chi-square of the nodes. Units twice as steep follow the noise between nodes.
        still: training ends where ``patience`` steps lower the loss by less than this share, which is about one of
            chi-square: far less than what the readings leave open.
        exact: a loss of the nodes below it is one of readings more exact than their noise is taken for (simulated
            without any). One of chi-square is a larger share of it, by the square; by the share alone training went on
            to the last of 400 steps.
    """
    import torch

    problem, spline = fit.problem, fit.problem.basis.model
    model = replace(spline, functions=None, n_functions=0, **setup.model.network)
    over = _spread(points_a_node * (spline.n_functions - 1) + 1)
    rest = fit.weights[..., problem.places.n_coefficients :]
    guess, generator = np.zeros(problem.scale[:, 0].shape), torch.Generator().manual_seed(setup.seed)
    start = start_networks(
        model, guess, generator, over, spline.raw(problem.parameters(fit.weights), over), rest, steep
    )
    n_of_networks = start.shape[-1] - rest.shape[-1]
    inputs, known = model.scaled_inputs(problem.measurement.dataset.points), _hold(start[0, 0], n_of_networks, hold)
    held = hold_between(spline.n_functions, points_a_node, between)
    training = pose_networks(problem, model, known, inputs, over, held, points_a_node)
    share = still * max(1.0, exact / float(problem.loss(fit.weights))) ** 2
    minimum = minimise(training, start, setup.ending(patience, share), progress=progress)
    basis = _about(replace(spline, **setup.model.network), training.networks(minimum.parameters)[0])
    weights = fit.weights.clone()
    weights[..., : problem.places.n_coefficients] = 0.0  # deviations from the networks
    weights[..., problem.places.n_coefficients :] = minimum.parameters[..., n_of_networks:]
    functions = Prior(problem.functions.rows, -training.deviate(minimum.parameters)[0, : len(problem.functions)])
    return replace(
        fit,
        start=replace(fit.start, held_out={name: _pose(other, basis) for name, other in fit.start.held_out.items()}),
        problem=replace(_pose(problem, basis), functions=functions).update(weights),
        minimum=replace(minimum.after(fit.minimum), parameters=weights),
    )


def hold_between(count: int, points_a_node: int, deviation: float) -> torch.Tensor:
    """(L, L) how values at so many points a node deviate from the spline through those at the ``count`` nodes."""
    import torch

    points = _spread(points_a_node * (count - 1) + 1)
    every = torch.eye(len(points), dtype=points.dtype)
    spline = torch.as_tensor(evaluate_functions("nodes", count, points[:, 0].numpy()))
    return (every - spline @ every[::points_a_node]) / deviation


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
