"""The residual, and the preconditioned residual, as functions of the parameters: rows and Jacobian.

The residual of each bearing and speed is linear in its U unknowns, ``A p + y``. A QR
factorisation of A, done once, leaves U rows a speed with the same norm up to a constant, so a training step
costs the same for any number of nodes and of runs; where the coefficients are the same at every
speed, all speeds together leave U rows.

The preconditioned loss multiplies each speed's rows by the regularised pseudo-inverse of A: they are then the distance
of the unknowns, each relative to its scale, from what that speed by itself says of them. Directions that the orbits
hardly tell apart weigh as much as the others, which the residual all but ignores.

Legend: G guesses or seeds, M members trained independently (the bearings, or 1 where they share their coefficients), B
bearings, S speeds, U unknowns, Q parameters.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from pipeline.errors import ConfigError
from pipeline.identification.blocks import for_model
from pipeline.identification.held_out import held_out_speeds
from pipeline.identification.identified import IdentifiedModel
from pipeline.identification.model import CoefficientModel, coefficient_model
from pipeline.identification.optimizers import LeastSquares
from pipeline.identification.training import FitSetup, initial_guess, root_mean_square
from pipeline.problem.identifiability import judge_identifiability, require_identifiable
from pipeline.problem.measurement import Measurement
from pipeline.problem.residual import BearingEquations, LinearResidual

if TYPE_CHECKING:
    import torch


@dataclass(frozen=True, eq=False)
class ResidualProblem(LeastSquares):
    """``rows = R p(parameters) + y`` with ``loss^2 = |rows|^2 + rest``."""

    model: CoefficientModel
    inputs: torch.Tensor  # (S, 1)
    matrix: torch.Tensor  # R, (M, S, U, U)
    offset: torch.Tensor  # y, (M, S, U)
    rest: torch.Tensor  # (M,) the part of the squared loss that no coefficient can change
    scale: torch.Tensor  # (M, 1, U)

    def _linearise(self, parameters: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """(G, M, S, U) rows, and (G, M, S, U, U) their derivative by the outputs of the model."""
        coefficients, slope = self.model.physical(self.model.raw(parameters, self.inputs), self.scale)
        return (self.matrix @ coefficients[..., None])[..., 0] + self.offset, self.matrix * slope[..., None, :]

    def rows(self, parameters: torch.Tensor) -> torch.Tensor:
        """(G, M, rows) from parameters (G, M, Q)."""
        return self._linearise(parameters)[0].flatten(2)

    def jacobian(self, parameters: torch.Tensor) -> torch.Tensor:
        """(G, M, rows, Q) derivative of :meth:`rows`."""
        return (self._linearise(parameters)[1] @ self.model.raw_jacobian(parameters, self.inputs)).flatten(2, 3)

    def normal(self, parameters: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Gradient J'r (G, M, Q) and J'J (G, M, Q, Q) of the rows."""
        rows, slopes = self._linearise(parameters)
        gradient = (slopes.mT @ rows[..., None])[..., 0]
        return self.model.raw_normal(parameters, self.inputs, gradient, slopes.mT @ slopes)

    def level(self, squared: torch.Tensor) -> torch.Tensor:
        """(G, M) root mean square of the residual over speeds, runs and directions.

        The paper's ``|r|_2`` divided by the root of the number of its elements.
        """
        return (squared + self.rest).sqrt()

    def rounding(self) -> torch.Tensor:
        """(M,) the loss that the data round to: that of no bearing force at all, times their precision."""
        return _ROUNDING * (self.offset.square().sum((-2, -1)) + self.rest).sqrt()

    def scatter(self) -> float:
        """The share that the squares fall by where each parameter gains a tenth of the residual's own variance.

        Nothing states the precision of the data here (digits of a file, single precision, noise): what is left over
        shows it. As the relative offset of Bates & Watts (1981), but of the gain made and not of the one predicted.
        """
        rows, size = self.offset[0].numel(), self.model.n_parameters
        return min(_GAIN * size / (2 * max(rows - size, 1)), _LARGEST_SHARE)

    def members(self) -> tuple[ResidualProblem, ...]:
        """The problem of each member by itself."""
        return tuple(
            replace(
                self,
                matrix=self.matrix[m : m + 1],
                offset=self.offset[m : m + 1],
                rest=self.rest[m : m + 1],
                scale=self.scale[m : m + 1],
            )
            for m in range(len(self.scale))
        )

    def on(self, device: str) -> ResidualProblem:
        """The problem with its tensors on this device."""
        import torch

        tensors: dict[str, Any] = {k: value for k, value in vars(self).items() if isinstance(value, torch.Tensor)}
        return replace(self, **{name: tensor.to(device) for name, tensor in tensors.items()})

    def per_speed(self, regularisation: float) -> tuple[np.ndarray, np.ndarray]:
        """The regularised pseudo-inverse of A (M, S, U, U) and the answer of each speed (M, S, U), in scales.

        ``regularisation`` is relative to the largest singular value; what lies below the rounding of the data is left
        out in any case.
        """
        scaled = (self.matrix * self.scale[:, :, None]).numpy()
        left, singular, right = np.linalg.svd(scaled, full_matrices=False)
        largest = singular[..., :1]
        kept = singular > _ROUNDING * largest
        factor = np.where(kept, singular, 0.0) / np.maximum(singular**2 + (regularisation * largest) ** 2, _TINY)
        inverse = np.einsum("mnvu,mnv,mnwv->mnuw", right, factor, left)
        return inverse, -(inverse @ self.offset.numpy()[..., None])[..., 0]

    def preconditioned(self, regularisation: float) -> ResidualProblem:
        """The same unknowns with rows ``A^+ (A p + y)``, a root mean square over speeds and unknowns."""
        import torch

        inverse, answer = self.per_speed(regularisation)
        size = np.sqrt(answer.shape[1] * answer.shape[2])
        return ResidualProblem(
            self.model,
            self.inputs,
            torch.as_tensor(inverse @ self.matrix.numpy() / size),
            torch.as_tensor(-answer / size),
            torch.zeros(len(answer), dtype=torch.float64),
            self.scale,
        )


_GAIN, _LARGEST_SHARE = 0.1, 0.01
_ROUNDING = 1e-13
_TINY = np.finfo(float).tiny


def residual_problem(
    model: CoefficientModel, points: Mapping[str, np.ndarray], residual: LinearResidual, scaling: np.ndarray
) -> ResidualProblem:
    """The problem at the residual's ``points`` (name -> (S,)); each speed's rows are multiplied by (B, S)."""
    import torch

    weight = scaling[..., None]
    weighted = LinearResidual(
        residual.unknowns, residual.matrix * weight[..., None], residual.offset * weight
    ).by_member()
    n_rows = weighted.offset[0].size
    matrix, offset = weighted.matrix / np.sqrt(n_rows), weighted.offset / np.sqrt(n_rows)
    if model.hidden is None:
        matrix, offset = matrix.reshape(len(matrix), 1, -1, matrix.shape[-1]), offset.reshape(len(offset), 1, -1)
        points = {name: values[:1] for name, values in points.items()}
    orthogonal, triangular = np.linalg.qr(matrix)
    reduced = np.einsum("bsru,bsr->bsu", orthogonal, offset)
    unreachable = offset - np.einsum("bsru,bsu->bsr", orthogonal, reduced)
    return ResidualProblem(
        model,
        model.scaled_inputs(points),
        torch.as_tensor(triangular),
        torch.as_tensor(reduced),
        torch.as_tensor((unreachable**2).sum(axis=(1, 2))),
        model.scale_tensor(),
    )


def speed_scaling(scaling: Literal["per_speed", "none"], equations: BearingEquations) -> np.ndarray:
    """(B, S) factors of the residual in 1/N: one over the size of the bearing force at each speed, or one.

    Unbalance grows with the square of the speed; unscaled, the fastest speeds outweigh the slowest by
    orders of magnitude.
    """
    size = np.sqrt((np.abs(equations.free_residual) ** 2).mean(axis=(2, 3)))
    return np.ones_like(size) if scaling == "none" else 1.0 / size


def data_scale(residual: LinearResidual) -> np.ndarray:
    """(M, U) a size for every coefficient, from the data: bearing force over what a unit coefficient gives."""
    force = np.linalg.norm(residual.offset, axis=2)[..., None]  # (B, S, 1)
    unit = np.linalg.norm(residual.matrix, axis=2)  # (B, S, U)
    present = unit > 0  # a bearing may lack an unknown
    size = np.median(np.where(present, force / np.where(present, unit, 1.0), 1.0), axis=1)
    return size.mean(axis=0, keepdims=True) if residual.unknowns.shared else size


# --- training by it ----------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False, kw_only=True)
class ResidualTraining:
    """Everything before the first step: the problem on the training speeds and, where some are held out, on those."""

    measurement: Measurement
    problem: ResidualProblem
    held_out: ResidualProblem | None
    held_out_per_speed: ResidualProblem | None  # the residual scaled per speed, whatever the loss is

    def identified(self, parameters: torch.Tensor) -> IdentifiedModel:
        """The model with parameters (M, Q)."""
        nodes = self.measurement.rotor.bearing_nodes
        return IdentifiedModel(self.problem.model, self.measurement.unknowns, nodes, parameters)

    def per_speed_held_out_loss(self, parameters: torch.Tensor) -> np.ndarray:
        """(G,) what trainings of any loss are compared by; ``parameters`` (G, M, Q).

        Root mean square, over bearings and held-out speeds, of the residual divided by the bearing force of its speed.
        """
        assert self.held_out_per_speed is not None, "no speed is held out"
        return root_mean_square(self.held_out_per_speed.loss(parameters))


def prepare_residual(measurement: Measurement, setup: FitSetup) -> ResidualTraining:
    """Everything before the first step.

    Raises IdentifiabilityError where the runs determine the unknowns of a bearing at no speed, unless ``setup.force``;
    DataError where x or y is not measured at a bearing; ConfigError for ``training.holdout_range``.
    """
    beyond = [name for name in ("holdout_range", "holdout_operating") if getattr(setup.training, name)]
    if beyond:
        raise ConfigError(
            f"training.{beyond[0]} must go with loss=response, but the loss is "
            f"{setup.loss.kind}, whose held-out speeds choose the best state: leave it out"
        )
    measurement = for_model(measurement, setup)
    equations, residual, points = measurement.equations, measurement.residual, measurement.dataset.points
    if not setup.force:
        require_identifiable(judge_identifiability(equations, residual, setup.constant))
    model = coefficient_model(setup.model, residual.unknowns.names, points, data_scale(residual))
    held_out = held_out_speeds(len(equations.speeds), setup.training.holdout_every)
    factor = speed_scaling(setup.loss.scaling, equations)
    per_speed = speed_scaling("per_speed", equations)

    def problem(keep: np.ndarray, scaling: np.ndarray) -> ResidualProblem:
        here = {name: values[keep] for name, values in points.items()}
        return residual_problem(model, here, residual.at(keep), scaling[:, keep])

    def trained(keep: np.ndarray) -> ResidualProblem:
        made = problem(keep, factor)
        return made.preconditioned(setup.loss.regularisation) if setup.loss.preconditioned else made

    some = bool(held_out.any())
    return ResidualTraining(
        measurement=measurement,
        problem=trained(~held_out),
        held_out=trained(held_out) if some else None,
        held_out_per_speed=problem(held_out, per_speed) if some else None,
    )


def initial_parameters(
    training: ResidualTraining, setup: FitSetup, seed: int, stiffness: float | None = None
) -> torch.Tensor:
    """(1, M, Q) starting parameters from a seed and, if given, a guess of the stiffness.

    With ``model.initialisation`` of ``per_speed`` and no guess, the last layer is fitted to the regularised least
    squares of each training speed.
    """
    import torch

    problem, guess = training.problem, initial_guess(setup, training.measurement.unknowns, stiffness)
    start = problem.model.initial_parameters(guess, torch.Generator().manual_seed(seed))
    if setup.model.initialisation == "per_speed" and stiffness is None:
        _, answer = problem.per_speed(setup.loss.regularisation)
        start = problem.model.with_output_at(start, problem.inputs, torch.as_tensor(answer) * problem.scale)
    return start[None]


# --- without training ------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class ChebyshevFit:
    """The series of the degree with the lowest held-out loss."""

    degree: int
    held_out_loss: float
    identified: IdentifiedModel


def fit_chebyshev(measurement: Measurement, setup: FitSetup) -> ChebyshevFit | None:
    """The Chebyshev series in the scaled speed, of an even degree up to 40, that the held-out speeds like best.

    The coefficients enter the residual linearly, so each degree has one least-squares answer: no start, no
    optimiser, no luck. None for constants, and where no speed is held out.
    """
    import torch

    if setup.constant or not setup.training.holdout_every:
        return None
    n_speeds = len(measurement.dataset.speeds)
    n_training = n_speeds - int(held_out_speeds(n_speeds, setup.training.holdout_every).sum())
    fits = []
    for degree in range(2, min(40, n_training - 1) + 1, 2):
        training = prepare_residual(measurement, replace(setup, model=setup.model.as_chebyshev(degree), force=True))
        parameters = torch.stack([_solve(member) for member in training.problem.members()])[None]  # (1, M, Q)
        loss = float(training.per_speed_held_out_loss(parameters)[0])
        fits.append(ChebyshevFit(degree, loss, training.identified(parameters[0])))
    return min(fits, key=lambda fit: fit.held_out_loss, default=None)


def _solve(problem: ResidualProblem) -> torch.Tensor:
    """(Q,) the least squares of a member's rows, which are linear in the parameters."""
    import torch

    zero = torch.zeros(1, 1, problem.model.n_parameters, dtype=torch.float64)
    jacobian, rows = problem.jacobian(zero)[0, 0].numpy(), problem.rows(zero)[0, 0].numpy()
    return torch.as_tensor(np.linalg.lstsq(jacobian, -rows, rcond=1e-15)[0])
