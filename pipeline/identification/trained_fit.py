"""FEM-NN under the sensors' noise: networks whose hidden layers are trained by the output error, too.

All weights of a network have directions that the data leave free, along curved valleys: no linearised covariance holds
there. So several small networks are trained, each from hidden units of its own draw and on one half of the speeds: of
two neighbouring speeds one is in the half, and the next network has the other one (balanced half-samples; McCarthy
1969). The other half ends its training: the state that predicts it best counts. The answer is the mean of their
outputs, in which the halves cancel; or the best network, where the mean explains the readings worse. The scatter about
it is its standard deviation: an estimate from half of the readings lies as far from that of the whole as the latter
lies from the truth. Few networks tell it roughly, for which Student's factor allows.

The mean of networks is a network of all their hidden units, whose output layer is linear in what differs: what follows
from a fit by the output error follows from it, too.

Legend: G networks, M members, Q parameters of a member, S speeds, U unknowns, A those of them that members have, K
features of the mean, N balance planes, T model parameters, Y = M Q + 2 N + T numbers, Z = A K + 2 N + T weights.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from pipeline.errors import ConfigError
from pipeline.identification.blocks import Basis, Prior
from pipeline.identification.inputs import SPEED
from pipeline.identification.model import CoefficientModel
from pipeline.identification.model_error import MeanSquareError, noise_alone
from pipeline.identification.optimizers import levenberg_marquardt, until_still
from pipeline.identification.output_error_fit import OutputErrorFit
from pipeline.identification.problem import OutputError
from pipeline.identification.trained_network import TrainedNetworks, pose_networks, start_networks
from pipeline.identification.training import FitSetup, Minimum, Outcome, Progress, initial_guess, minimise
from pipeline.problem.noise_levels import student_factor

if TYPE_CHECKING:
    import torch

FEWEST_SPEEDS = 4


@dataclass(frozen=True, eq=False, kw_only=True)
class TrainedFit(OutputErrorFit):
    """The mean of the networks."""

    scatter: np.ndarray  # (Z, Z) of the weights

    def covariance(self) -> np.ndarray:
        """(Z, Z) from the scatter of the networks."""
        return self.scatter

    def error(self, inflation: float = 1.0) -> MeanSquareError:
        """The scatter: networks of their own follow what the mean can't."""
        return noise_alone(self.problem, inflation * self.scatter)


def train_hidden(
    fit: OutputErrorFit,
    setup: FitSetup,
    progress: Progress | None = None,
    *,
    still: float = 1e-3,
    patience: int = 5,
) -> TrainedFit:
    """Train all layers, from the fit with hidden layers as drawn, whose precisions of the readings are kept.

    It ends where no network's loss on its other half fell by the share ``still`` in ``patience`` steps.

    Raises ConfigError for a model without hidden layers, and for fewer than four speeds.
    """
    import torch

    if not setup.model.trains_hidden:
        raise ConfigError(
            f"loss.hidden=trained must have a model with hidden layers, but got model.kind={setup.model.kind}: choose "
            "model=network_fluid_film model.width=8, or loss.hidden=drawn"
        )
    problem, count = fit.problem, setup.loss.networks
    speeds = problem.measurement.dataset.speeds
    if len(speeds) < FEWEST_SPEEDS:
        raise ConfigError(
            f"loss.hidden=trained must have {FEWEST_SPEEDS} training speeds or more, which it halves, but got "
            f"{len(speeds)}: choose loss.hidden=drawn"
        )
    generator = torch.Generator().manual_seed(setup.seed)
    halves = _halves(count, len(speeds), generator)
    half, other = (problem.scaled(share.sqrt()[:, :, None, None]) for share in (halves, (2 - halves) * (halves != 1)))
    signs = torch.randn(count // 2, problem.places.n_parameters, generator=generator, dtype=torch.float64)
    aims = torch.stack([signs, -signs], dim=1).flatten(0, 1)
    every = fit.weights.repeat(count, 1, 1)
    linear = levenberg_marquardt(half, every, setup.optimizer.levenberg_marquardt, until_still())
    model, rest = problem.basis.model, linear[..., problem.places.n_coefficients :]
    inputs = model.scaled_inputs(problem.measurement.dataset.points)
    guess = initial_guess(setup, problem.measurement.unknowns)
    values, _ = model.physical(problem.outputs(linear), problem.scale)
    start = start_networks(model, guess, generator, inputs, values, rest)
    known = Prior(torch.eye(start.shape[-1], dtype=torch.float64)[len(start[0, 0]) - aims.shape[-1] :], aims)
    nowhere = inputs[:0]  # no prior of functions holds
    training, judging = (
        pose_networks(weighed, model, known, inputs, nowhere, nowhere @ nowhere.mT) for weighed in (half, other)
    )
    ending = setup.ending(patience, still)
    return _mean(fit, training, minimise(training, start, ending, held_out=judging, progress=progress, together=True))


def _halves(count: int, n_speeds: int, generator: torch.Generator) -> torch.Tensor:
    """(G, S) how often each speed counts: one of two neighbours twice, and the other one in every second network.

    The first and last speed count once in all: no network is to extrapolate.
    """
    import torch

    first = torch.rand(count // 2, n_speeds // 2, generator=generator) < 0.5
    inner = torch.stack([first, ~first], dim=-1).flatten(1)[:, : n_speeds - 2]
    share = torch.ones(count, n_speeds, dtype=torch.float64)
    share[:, 1:-1] = 2.0 * torch.stack([inner, ~inner], dim=1).flatten(0, 1)
    return share


# --- the mean of the networks ----------------------------------------------------------------------------


def _mean(fit: OutputErrorFit, training: TrainedNetworks, minimum: Minimum) -> TrainedFit:
    """The mean of the networks at the minimum, and their scatter about it."""
    import torch

    numbers, before, start = minimum.parameters, fit.problem, fit.start
    score = torch.as_tensor(minimum.held_out_loss)[:, None]
    speeds = before.measurement.dataset.speeds
    alone = before.basis.model.inputs == (SPEED,)
    over = torch.linspace(-1, 1, _POINTS, dtype=numbers.dtype)[:, None] if alone else training.inputs
    basis, coordinates = _span(before.basis.model, training.networks(numbers), over)
    weights = torch.stack([coordinates[:, m, :, u] for m, u in before.active], dim=1).flatten(1)
    each = torch.cat([weights, numbers[:, 0, training.places.n_coefficients :]], dim=-1)  # (G, Z)
    # A half is fitted too well by as much as the other, which lacks the two ends, is predicted too badly.
    fitted_square, predicted = training.loss(numbers).square(), score.square() * len(speeds) / (len(speeds) - 2)
    spent = min(
        max(float((predicted - fitted_square).mean()) * before.readings.size / 4, 0.0), float(numbers.shape[-1])
    )

    def make_mean(other: OutputError) -> OutputError:
        """The mean of the networks as weights of its own basis, at the readings of ``other``: as many count as followed
        the noise.
        """
        return replace(
            other,
            basis=basis,
            features=basis.at(other.measurement.dataset.points),
            kept=torch.ones(len(before.active), basis.n_features, dtype=torch.bool),
            precision=torch.zeros(basis.n_features, dtype=torch.float64),
            n_unspent=each.shape[-1] - round(spent) - before.places.n_parameters,
        )

    problem, answer = make_mean(before), each.mean(dim=0)
    # Where a combination is nearly free the networks lie along a curved valley, and their mean beside it.
    if float(problem.loss(answer[None, None]).square()) > float(((fitted_square + predicted) / 2).min()):
        answer = each[int(score.argmin())]
    # Few networks tell their scatter roughly: a pair of them is one degree of freedom, half of a complex one.
    off = (each - answer).numpy() * student_factor(len(each) / 4) / student_factor(np.inf)
    held_out = {name: make_mean(other) for name, other in start.held_out.items()}
    # The first row is the start, where the fit before ended.
    trained = replace(minimum, history=minimum.history[1:], steps=minimum.steps - 1).after(fit.minimum)
    outcome = Outcome.DIVERGED if Outcome.DIVERGED in minimum.outcomes else minimum.outcomes[0]
    return TrainedFit(
        start=replace(start, held_out=held_out),
        problem=problem,
        minimum=replace(trained, parameters=answer[None, None], outcomes=(outcome,)),
        factor=fit.factor,
        scatter=off.T @ off / len(each),
    )


def _span(model: CoefficientModel, networks: torch.Tensor, inputs: torch.Tensor) -> tuple[Basis, torch.Tensor]:
    """The outputs of ``networks`` (G, M, Q) as combinations of K functions of all their hidden units.

    The functions are orthonormal over the scaled ``inputs`` (S, n); the coordinates of the outputs are (G, M, K, U).
    """
    import torch

    whole, hidden = _join(model, networks)
    width = model.sizes[-1][0] - model.n_trend
    output_layers = torch.cat(model.layers(networks)[-1], dim=-2)  # (G, M, n_in + 1, U)
    separate = torch.eye(len(networks), dtype=networks.dtype)  # no network sees the others' hidden units
    hidden_layers = torch.einsum("gmwu,gh->mgwhu", output_layers[:, :, :width], separate).flatten(1, 2)
    output = torch.cat([hidden_layers, output_layers[:, :, width:].movedim(0, 2)], dim=1)
    columns = whole.features(hidden, inputs) @ output.flatten(2)
    size = columns.norm(dim=1, keepdim=True).clamp(min=_TINY)
    left, singular, right = torch.linalg.svd(columns / size, full_matrices=False)
    kept = singular > _NEGLIGIBLE * singular[:, :1]
    weights = torch.where(
        kept[:, None], (output.flatten(2) / size) @ right.mT / singular.clamp(min=_TINY)[:, None], 0.0
    )
    most = int(kept.any(dim=0).sum())
    coordinates = torch.where(kept[..., None], left.mT @ model.raw(networks, inputs), 0.0)
    return Basis(whole, hidden, weights[..., :most], 0), coordinates[:, :, :most]


_POINTS, _NEGLIGIBLE, _TINY = 400, 1e-8, 1e-300


def _join(model: CoefficientModel, networks: torch.Tensor) -> tuple[CoefficientModel, torch.Tensor]:
    """The network of all hidden units of ``networks`` (G, M, Q), and its parameters (M, ..) without an output layer."""
    import torch

    assert model.hidden is not None
    count, members, pieces = *networks.shape[:2], []
    for layer, (weight, bias) in enumerate(model.layers(networks)[:-1]):  # (G, M, n_in, n_out) and (G, M, 1, n_out)
        if layer:
            joined = torch.stack([torch.block_diag(*weight[:, m]) for m in range(members)])
        else:
            joined = weight.movedim(0, 2).flatten(2)
        pieces += [joined.flatten(1), bias.movedim(0, 1).flatten(1)]
    whole = replace(model, hidden=tuple(count * width for width in model.hidden))
    return whole, torch.cat([*pieces, torch.zeros(members, whole.n_output, dtype=networks.dtype)], dim=1)
