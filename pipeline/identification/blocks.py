"""The blocks of unknowns that are fitted together, one after the other in a flat vector, and their priors.

The coefficients' block: a model's output layer over an orthonormal basis of its features, the smoothest first, whose
outputs correct bearing laws of few numbers. A coefficient that must be positive is the law's times ``exp(output)``,
another one the law's plus ``scale * output``: an output of zero leaves the law as it is. Without laws the ``scale``
takes their place.

Legend: G data sets or starts, Z weights, N rows of priors, M members, S operating points, F features (hidden units or
fixed functions, trend and 1), K functions of the basis, U unknowns, Q parameters, Th numbers of bearing laws (theta,
the logarithm of each over its guess).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from pipeline.coefficients import COEFFICIENTS
from pipeline.errors import ConfigError
from pipeline.identification.inputs import SPEED
from pipeline.identification.model import CoefficientModel
from pipeline.impedance import list_places, to_coefficients
from pipeline.laws.law_set import NO_LAWS, LawSet
from pipeline.unknowns import UnknownSet

if TYPE_CHECKING:
    import torch

    from pipeline.identification.training import FitSetup
    from pipeline.problem.measurement import Measurement


@dataclass(frozen=True)
class Places:
    """Where each block lies among the weights; one that is not there has the size 0."""

    n_coefficients: int  # weights of the coefficients' functions, or of networks
    n_numbers: int = 0  # of bearing laws
    n_planes: int = 0  # of residual unbalance: two parts each
    n_parameters: int = 0  # uncertain numbers of rotor, weights and probes

    @property
    def coefficients(self) -> slice:
        """The weights of what coefficients are functions of."""
        return slice(0, self.n_coefficients)

    @property
    def numbers(self) -> slice:
        """Theta: numbers of bearing laws, as logarithms over their guesses."""
        return slice(self.n_coefficients, self.n_coefficients + self.n_numbers)

    @property
    def planes(self) -> slice:
        """Real and imaginary part of each plane's residual unbalance."""
        return slice(self.numbers.stop, self.numbers.stop + 2 * self.n_planes)

    @property
    def parameters(self) -> slice:
        """Model parameters, in prior deviations."""
        return slice(self.planes.stop, self.size)

    @property
    def n_rest(self) -> int:
        """How many follow the coefficients' weights."""
        return self.n_numbers + 2 * self.n_planes + self.n_parameters

    @property
    def size(self) -> int:
        """Z."""
        return self.n_coefficients + self.n_rest


@dataclass(frozen=True, eq=False)
class Prior:
    """What is known before the data, as whitened rows: ``rows z - aims`` has unit variance."""

    rows: torch.Tensor  # (N, Z)
    aims: torch.Tensor  # (N,) or (G, N)

    def __len__(self) -> int:
        """N."""
        return len(self.rows)

    def deviations(self, weights: torch.Tensor) -> torch.Tensor:
        """(G, N) of the weights (G, Z)."""
        return weights @ self.rows.T - self.aims

    def gradient(self, weights: torch.Tensor) -> torch.Tensor:
        """(G, Z) half the derivative of the squares."""
        return self.deviations(weights) @ self.rows

    @cached_property
    def information(self) -> torch.Tensor:
        """(Z, Z)."""
        return self.rows.T @ self.rows


# --- coefficients over a basis ---------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Basis:
    """Output weights ``W = weights z``, added to those of the parameters. Of features, they are orthonormal at the
    training speeds.
    """

    model: CoefficientModel
    parameters: torch.Tensor  # (M, Q) of the model where z is zero; hidden layers are kept
    weights: torch.Tensor  # (M, F, K)
    n_trend: int  # the first so many are the constant and the trend

    @property
    def n_features(self) -> int:
        """K."""
        return self.weights.shape[-1]

    def at(self, points: Mapping[str, np.ndarray]) -> torch.Tensor:
        """(M, S, K) the basis at ``points``: name -> (S,), the speed in rad/s."""
        return self.model.features(self.parameters, self.model.scaled_inputs(points)) @ self.weights

    def origin(self, points: Mapping[str, np.ndarray]) -> torch.Tensor:
        """(M, S, U) the model's outputs at ``points`` where z is zero."""
        return self.model.raw(self.parameters, self.model.scaled_inputs(points))

    def prior_precision(self, n_speeds: int, beyond_trend: float, beyond_constant: float = 1.0) -> torch.Tensor:
        """(K,) of the weights: a coefficient deviates from its trend by ``beyond_trend``, as normal with mean zero.

        From a constant, where there is no trend, by ``beyond_constant``, of outputs. Features are orthonormal over
        ``n_speeds``: weights of variance v make outputs of variance v K / S.
        """
        import torch

        spread = beyond_trend if self.model.trend else beyond_constant
        count = self.n_features - self.n_trend
        precision = torch.zeros(self.n_features, dtype=torch.float64)
        precision[self.n_trend :] = count / (n_speeds * spread**2)
        return precision

    def parameters_of(self, coordinates: torch.Tensor) -> torch.Tensor:
        """(G, M, Q) all parameters of the model, from ``coordinates`` (G, M, U, K)."""
        import torch

        output = (self.weights @ coordinates.mT).flatten(-2)  # (G, M, F U)
        count = self.parameters.shape[1] - output.shape[-1]
        return self.parameters + torch.nn.functional.pad(output, (count, 0))


def orthonormal_basis(model: CoefficientModel, parameters: torch.Tensor, points: Mapping[str, np.ndarray]) -> Basis:
    """The basis for training at ``points``: name -> (S,), the speed in rad/s.

    First the constant and the trend, then the combinations of hidden units that vary most beside them: broad units
    overlap, so these are the smooth ones. Combinations that hardly vary are left out.
    """
    import torch

    features = model.features(parameters, model.scaled_inputs(points))
    count = 1 + model.n_trend
    hidden, trend = features[..., :-count], features[..., -count:]
    first, from_trend = _orthonormal(trend)
    projection = first.mT @ hidden
    _, from_hidden = _orthonormal(hidden - first @ projection)
    weights = torch.cat(
        [
            torch.cat([torch.zeros(*hidden.shape[::2], first.shape[-1], dtype=hidden.dtype), from_hidden], dim=-1),
            torch.cat([from_trend, -from_trend @ projection @ from_hidden], dim=-1),
        ],
        dim=1,
    )
    without_output = torch.nn.functional.pad(parameters[..., : -model.n_output], (0, model.n_output))
    return Basis(model, without_output, weights, first.shape[-1])


def _orthonormal(columns: torch.Tensor, negligible: float = 1e-6) -> tuple[torch.Tensor, torch.Tensor]:
    """(M, S, K) orthonormal combinations of ``columns`` (M, S, F), the largest first, and the weights (M, F, K).

    Combinations smaller than the ``negligible`` share of the largest need output weights that cancel to so many digits.
    """
    import torch

    left, singular, right = torch.linalg.svd(columns, full_matrices=False)
    count = int((singular > negligible * singular[:, :1]).all(dim=0).sum())
    return left[..., :count], (right.mT / singular[:, None])[..., :count]


# --- bearing laws ----------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class LawTerm:
    """The laws at the points of a measurement."""

    laws: LawSet
    points: Mapping[str, np.ndarray]  # name -> (S,) the speed in rad/s, operating conditions in SI
    leaders: tuple[int, ...]  # U indices of the coefficients that lead the unknowns

    @property
    def n_numbers(self) -> int:
        """Th."""
        return len(self.laws.parameters)

    def prior_precision(self) -> torch.Tensor:
        """(Th,) of theta: a guess is within its factor by one standard deviation of the logarithm."""
        import torch

        return torch.tensor([parameter.deviation**-2 for parameter in self.laws.parameters], dtype=torch.float64)

    def evaluate(self, theta: torch.Tensor, farthest: float = 5.0) -> tuple[torch.Tensor, torch.Tensor]:
        """(G, M, S, U) unknowns of ``theta`` (G, Th), N/m and N s/m, and their slopes (G, M, S, U, Th).

        Beyond the ``farthest`` prior deviations nothing changes any more: a step of a fit that leads there is none.
        """
        import torch

        limit = farthest * self.prior_precision().rsqrt()
        inside = (theta.abs() <= limit).to(theta.dtype)
        theta = torch.clamp(theta, -limit, limit)
        operating = {name: values for name, values in self.points.items() if name != "speed"}
        values, slopes = self.laws.coefficients(theta, self.points["speed"], operating)
        return values[..., list(self.leaders)], slopes[..., list(self.leaders), :] * inside[:, None, None, None]

    def correct(
        self,
        model: CoefficientModel,
        theta: torch.Tensor,
        outputs: torch.Tensor,
        scale: torch.Tensor,
        slopes: bool = True,
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """The unknowns of ``theta`` (G, Th) with the model's ``outputs`` (G, M, S, U) and ``scale``, N/m and N s/m;
        (G, M, S, U, U) their derivative by the outputs; and (G, M, S, U, Th) that by theta. Without ``slopes`` the
        derivatives may be those of no speed.
        """
        import torch

        if model.parametrisation == "impedance":
            places = torch.tensor(list_places(model.unknowns))
            order = torch.tensor([COEFFICIENTS.index(name) for name in model.unknowns])
            coordinates = outputs.new_zeros(*outputs.shape[:-1], len(COEFFICIENTS))
            coordinates[..., places] = outputs
            values, by_coordinate = to_coefficients(coordinates, torch.as_tensor(self.points[SPEED]), slopes)
            by_output = by_coordinate[..., order[:, None], places]
            return values.index_select(-1, order), by_output, outputs.new_zeros(*by_output.shape[:-1], 0)
        if not self.laws:
            values, by_output = model.physical(outputs, scale)
            return values, torch.diag_embed(by_output), outputs.new_zeros(*outputs.shape, 0)
        positive, (base, by_theta) = torch.tensor(model.positive), self.evaluate(theta)
        values, by_output = model.physical(outputs, torch.where(positive, base, scale), base)
        growth = torch.where(positive, torch.where(positive, outputs, 0.0).exp(), 1.0)
        return values, torch.diag_embed(by_output), by_theta * growth[..., None]


def select_active(
    active: Sequence[tuple[int, int]], values: torch.Tensor, by_outputs: torch.Tensor, by_numbers: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """What :meth:`LawTerm.correct` gives, of the active unknowns: (G, S, A), (G, S, A, A), (G, S, A, Th)."""
    import torch

    member, unknown = [m for m, _ in active], [u for _, u in active]
    values, slope, by_theta = (array[:, member, :, unknown] for array in (values, by_outputs, by_numbers))
    alike = torch.tensor(member)[:, None] == torch.tensor(member)  # (A, A) where two are of the same member
    slope = slope[..., unknown] * alike[:, None, None]
    return values.movedim(0, -1), slope.movedim(0, -2), by_theta.movedim(0, -2)


def slopes_by_weights(by_outputs: torch.Tensor, by_numbers: torch.Tensor, carrier: torch.Tensor) -> np.ndarray:
    """(G, S, A, A K + Th) derivative of the active unknowns by the weights of functions, of which ``carrier`` (A, S, K)
    has those of each unknown, and by the numbers of laws; from those of :func:`select_active`.
    """
    import torch

    by_functions = torch.einsum("gsab,bsk->gsabk", by_outputs, carrier).flatten(-2)
    return np.asarray(torch.cat([by_functions, by_numbers], dim=-1).numpy())


def carry_covariance(covariance: np.ndarray, carrier: np.ndarray) -> np.ndarray:
    """(S, A + Th, A + Th) covariance of outputs and numbers of laws at each speed, from (Z, Z) of the weights of
    functions, of which ``carrier`` (A, S, K) has those of each unknown, and of the numbers (Z = A K + Th).
    """
    (n_active, n_speeds, size), count = carrier.shape, carrier.shape[0] * carrier.shape[2]
    by_weight = carrier @ covariance[:count].reshape(n_active, size, -1)  # (A, S, Z)
    rows = np.concatenate([by_weight, covariance[count:, None].repeat(n_speeds, axis=1)]).swapaxes(0, 1)
    parts = rows[..., :count].reshape(n_speeds, -1, n_active, size)
    return np.concatenate([np.einsum("sabk,bsk->sab", parts, carrier), rows[..., count:]], axis=-1)


def law_term(laws: LawSet, unknowns: UnknownSet, points: Mapping[str, np.ndarray]) -> LawTerm:
    """The laws for the members' unknowns. Raises ConfigError for bearings that share their coefficients."""
    if laws and unknowns.shared:
        raise ConfigError(
            "identify.shared must be false where machine.laws gives each bearing its own, but it is true: leave it out"
        )
    return LawTerm(laws, points, tuple(COEFFICIENTS.index(name) for name in unknowns.names))


def for_model(measurement: Measurement, setup: FitSetup) -> Measurement:
    """The measurement as the configured model sees it: with bearing laws if it is made of them.

    Raises ConfigError where there are none, or for a loss that they don't go with.
    """
    if not setup.model.has_laws:
        return measurement if measurement.laws is NO_LAWS else replace(measurement, laws=NO_LAWS)
    if not measurement.laws:
        raise ConfigError(
            f"model={setup.model.kind} must have machine.laws (what is known of bearings and oil, and guesses of the "
            "rest), but the machine has none: write the section, or choose model=network_fluid_film"
        )
    kind, hidden = setup.loss.kind, setup.loss.hidden
    if kind != "response" or hidden != "drawn":
        came = f"loss.kind={kind}" if kind != "response" else f"loss.hidden={hidden}"
        raise ConfigError(
            f"model.kind={setup.model.kind} must go with loss.kind=response and loss.hidden=drawn, but got {came}: "
            "choose loss=response"
        )
    return measurement
