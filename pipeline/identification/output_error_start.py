"""Where the fit by the output error starts: weighted linear least squares of the residual, in the model's features.

From a random start the output error may stick; the residual, linear in the coefficients, has one answer. Where the
sensors are too few to tell the forces at the bearings, the start is the configured guess in several sizes, and what a
stationary Kalman smoother makes of each speed by itself.

Legend: G starts, S speeds, P channels, R runs, M members, U unknowns, Th numbers of bearing laws, Z weights.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import product
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.coefficients import is_direct
from pipeline.config.identification import LevenbergMarquardtConfig
from pipeline.data.operating import space_evenly
from pipeline.identification.blocks import Basis, for_model, orthonormal_basis
from pipeline.identification.families import list_choices
from pipeline.identification.held_out import held_out_points, held_out_runs
from pipeline.identification.linear_start import linear_start, read_modes, start_at
from pipeline.identification.model import coefficient_model
from pipeline.identification.optimizers import levenberg_marquardt, until_still
from pipeline.identification.problem import OutputError, output_error
from pipeline.identification.search import Searched, search
from pipeline.identification.selection import add_beyond, with_sigma
from pipeline.identification.training import FitSetup, initial_guess
from pipeline.problem.expansion import filter_bearings
from pipeline.problem.measurement import Guess, Measurement
from pipeline.problem.ranking import count_alike

if TYPE_CHECKING:
    import torch


EXPLAINED = 4.0
"""Root mean square over the noise up to which a start may be near the answer; a wrong valley leaves more."""


@dataclass(frozen=True, eq=False, kw_only=True)
class OutputErrorStart:
    """Everything before the first step."""

    measurement: Measurement  # all speeds and runs
    keep: np.ndarray  # (S,) mask of the training speeds
    problem: OutputError  # of the training speeds and runs
    weights: torch.Tensor  # (G, 1, Z); several where they are guesses
    held_out: Mapping[str, OutputError]  # what is predicted in place of fitted: held_out_speeds, held_out_runs
    from_guess: bool  # the sensors were too few for a linear start
    filtered: np.ndarray | None = None  # (M, S, U) at the training speeds: what a filter made of few sensors
    searched: Searched | None = None  # what a population of bearings makes likely
    near: bool = False  # it is an answer at the full precision, with the rotor solved there
    starts: tuple[int, int] = (0, 0)  # that were fitted, and of them those that led here; none where there is one way

    @property
    def by_evidence(self) -> bool:
        """Whether all features are kept, and the likelihood says how large they are: corrections, several inputs."""
        model = self.problem.basis.model
        return bool(self.problem.kept.any()) and (model.fades or len(model.inputs) > 1)


@lru_cache(maxsize=1)
def prepare_output_error(measurement: Measurement, setup: FitSetup) -> OutputErrorStart:
    """The problem on the training speeds and runs, and where it starts.

    The last one is kept: what a fit is expected to tell, and the fit, have the same start.

    Raises ConfigError for held-out runs that the data lack, or that leave no other.
    """
    measurement = for_model(measurement, setup)
    held_out = held_out_runs(measurement, setup.training)
    keep = ~held_out_points(measurement.dataset.speeds, measurement.dataset.operating, setup.training)
    runs = np.setdiff1d(np.arange(len(measurement.dataset.runs)), held_out)
    plane_scale = _plane_scale(measurement)  # solves the response, of which all problems are parts
    training = align_weights(measurement.select(keep, runs))
    begin: Callable[..., tuple[OutputError, dict[str, Any]]] = _start_by_coefficients
    begin = _start_by_laws if training.laws else _start_by_population if setup.model.families else begin
    make_basis = nodes_basis if setup.model.families else drawn_basis
    basis = make_basis(setup, training, measurement.dataset.points)
    problem, first = begin(training, setup, basis, plane_scale)
    problem = problem.with_baseline(first["weights"][:1])
    measurement = replace(measurement, as_found=problem.measurement.as_found, noise=problem.measurement.noise)
    left_out: dict[str, Measurement] = {}
    if not keep.all():
        left_out["held_out_speeds"] = measurement.select(~keep, runs)
    if len(held_out):
        left_out["held_out_runs"] = measurement.select(None, held_out)
    predicted = {name: output_error(other, problem.basis, plane_scale) for name, other in left_out.items()}
    return OutputErrorStart(measurement=measurement, keep=keep, problem=problem, held_out=predicted, **first)


@lru_cache(maxsize=1)
def find_likely(measurement: Measurement, setup: FitSetup, within: float = 1e3) -> OutputErrorStart:
    """The start of the fit at one answer that is likely: what is expected of guesses in several sizes is as wrong as
    they are.

    Constants that fit the readings, as of :func:`_approach`; what these do not tell is known to a factor ``within`` of
    the guess, where no other is stated.
    """
    start = prepare_output_error(measurement, setup)
    weights, problem, made = start.weights, start.problem, start.problem.measurement
    if start.from_guess and len(weights) > 1 and not any(parameter.growth for parameter in made.parameters):
        known = replace(made, guess=replace(made.guess, within=made.guess.within or within), solved=made.response)
        held = replace(problem, sensors=replace(problem.sensors, measurement=known))
        weights = _approach(held, weights, setup.optimizer.levenberg_marquardt)
    return replace(start, weights=weights[:1])


def _start_by_coefficients(
    training: Measurement, setup: FitSetup, basis: Basis, plane_scale: float
) -> tuple[OutputError, dict[str, Any]]:
    """Near the least squares of the residual; near guesses where the sensors are too few for that.

    Guesses are the configured one in several sizes.
    """
    import torch

    unknowns, values = training.unknowns, None
    if training.guess.within is None:
        values = linear_start(training, basis.at(training.dataset.points).numpy(), np.array(basis.model.scale))
    # Free at once, the features of several inputs would follow the noise of points: the fit starts at their trend.
    if values is not None:
        medians = np.median(np.abs(values), axis=1)  # sizes from the data in place of guessed ones
        sizes = np.where(medians > 0, medians, basis.model.scale).tolist()
        basis = replace(basis, model=replace(basis.model, scale=tuple(map(tuple, sizes))))
        problem = output_error(training, basis, plane_scale)
        return problem, {"weights": start_at(problem, values), "from_guess": len(basis.model.inputs) > 1}
    problem = output_error(training, basis, plane_scale)
    shape = (unknowns.n_members, len(training.dataset.speeds), len(unknowns.names))
    guess = np.broadcast_to(initial_guess(setup, unknowns)[:, None], shape)
    weights = torch.cat([start_at(problem, size * guess) for size in (0.03, 0.1, 0.3, 1.0, 3.0, 10.0, 30.0)])
    kinds = {parameter.kind for parameter in training.parameters}
    if {"base_participation", "support_stiffness", "support_damping"} <= kinds and unknowns.planes:
        weights, starts = _temper(problem, read_modes(problem), setup.optimizer.levenberg_marquardt)
        return problem.update(weights), {"weights": weights, "from_guess": False, "near": True, "starts": starts}
    if any(parameter.growth for parameter in training.parameters):
        weights = _approach(problem, weights[1::2], setup.optimizer.levenberg_marquardt)
        if not float(problem.loss(weights[:1])) < EXPLAINED:
            further = _approach(problem, _draw(problem, guess, setup.seed), setup.optimizer.levenberg_marquardt)
            weights = min(weights, further, key=lambda ends: float(problem.loss(ends[:1]).nan_to_num(float("inf"))))
    return problem, {"weights": weights, "from_guess": True, "filtered": _filter(training)}


def _draw(problem: OutputError, guess: np.ndarray, seed: int, count: int = 6, spread: float = 1.5) -> torch.Tensor:
    """(G, 1, Z) ``count`` starts about the guess (M, S, U): coefficients within a factor e^``spread`` (one deviation),
    numbers of the model by their priors.
    """
    import torch

    generator = np.random.default_rng(seed)
    factors = np.exp(spread * generator.standard_normal((count, len(guess), 1, guess.shape[2])))
    starts = torch.cat([start_at(problem, guess * each) for each in factors])
    numbers = generator.standard_normal((count, 1, problem.places.n_parameters))
    starts[..., problem.places.parameters] += torch.as_tensor(numbers)
    return starts


def _approach(
    problem: OutputError, weights: torch.Tensor, config: LevenbergMarquardtConfig, factor: float = 4.0
) -> torch.Tensor:
    """The starts (G, 1, Z) as constants that fit ever more exact readings, from such as they miss by their noise.

    Film and support in series have many minima, of which exact readings take the nearest; rough ones have few, and the
    priors hold what they don't tell. Each time the readings are a ``factor`` more exact.
    """
    limited = problem.truncated(1)
    weights = problem.with_features(weights, 1)
    count = 1 + int(np.log(max(float(limited.loss(weights).min()), 1.0)) / np.log(factor))
    for turn in range(count, -1, -1):
        rough = limited.scaled(factor**-turn)
        weights = levenberg_marquardt(rough, weights, config, until_still(1e-3), by_diagonal=True)
    best = limited.loss(weights)[:, 0].nan_to_num(float("inf")).argsort()
    return limited.with_features(weights[best], problem.features.shape[-1])


def _temper(
    problem: OutputError,
    starts: torch.Tensor,
    config: LevenbergMarquardtConfig,
    ways: tuple[tuple[float, ...], ...] = ((1.0,), (0.1, 0.3, 1.0)),
) -> tuple[torch.Tensor, tuple[int, int]]:
    """(1, 1, Z) the best of the starts (G, 1, Z) after fits to exact readings, and to ever more exact ones (``ways`` of
    shares), with the rotor solved at each step: shapes of a base are far from what is stated of them, where no first
    order holds. How many ways were gone, and how many of them ended there.
    """
    limited = config.model_copy(update={"steps": 25, "initial_damping": 1e-2})
    ends: list[tuple[float, torch.Tensor]] = []
    for start, shares in product(starts, ways):
        weights = start[None]
        for share in shares:
            rough = replace(problem.scaled(share), exact=True)
            weights = levenberg_marquardt(rough, weights, limited, until_still(1e-3), by_diagonal=True)
        # The noise follows from what is predicted: ends are compared by their likelihood, each at its own noise.
        for _ in range(2):
            solved = problem.update(weights)
            readings = solved.readings.follow(solved.predicted(weights))
            rough = replace(solved, readings=readings, exact=True)
            weights = levenberg_marquardt(rough, weights, limited, until_still(1e-3), by_diagonal=True)
        ends.append((float(rough.rows(weights).square().sum()) + rough.readings.log_determinant(), weights))
    losses = [loss for loss, _ in ends]
    return ends[losses.index(min(losses))][1], (len(ends), count_alike(losses))


def align_weights(measurement: Measurement) -> Measurement:
    """The measurement at the common angle of all weights (``weight_angle``, where it is uncertain) that fits best.

    Far from it, Gauss-Newton steps end in another valley. For any bearings the response turns with the weights, so the
    angle is that between what the runs' differences show and what the guessed bearings make of them.
    """
    at = [t for t, parameter in enumerate(measurement.parameters) if parameter.kind == "weight_angle"]
    if not at:
        return measurement
    guess = measurement.guess.direct(measurement.unknowns)[:, None]
    expected = measurement.response.predict(measurement.table(guess)) / measurement.deviation
    shown = measurement.dataset.displacement / measurement.deviation
    turned = [run - run.mean(axis=2, keepdims=True) for run in (expected, shown)]
    angle = np.angle(np.vdot(turned[0], turned[1]))
    values = measurement.parameter_values
    values[at[0]] += angle / measurement.parameters[at[0]].deviation
    return measurement.update(values)


def drawn_basis(setup: FitSetup, training: Measurement, points: Mapping[str, np.ndarray]) -> Basis:
    """The features of the configured model over the ``points`` (name -> (S,)), orthonormal at those of ``training``.

    An output of 1 stands for the configured guess.
    """
    import torch

    sizes = Guess(setup.model.initial_stiffness, setup.model.initial_damping).sizes(training.unknowns)
    model = coefficient_model(setup.model, training.unknowns.names, points, sizes)
    generator = torch.Generator().manual_seed(setup.seed)
    drawn = model.spread_parameters(initial_guess(setup, training.unknowns), generator)
    return orthonormal_basis(model, drawn, training.dataset.points)


def _filter(training: Measurement, least_settled: float = 0.5) -> np.ndarray | None:
    """Unknowns (M, S, U) of each training speed by itself; None where the sensors are too few for that, too.

    The filter must have settled at the share ``least_settled`` of the speeds to be a start.
    """
    less = training.subtract_unbalance()
    if 2 * less.dataset.displacement[0].size < len(less.unknowns.active):
        return None
    values, settled = filter_bearings(less)
    if settled.mean() < least_settled:
        return None
    order = np.flatnonzero(settled)
    return values[:, order[np.abs(np.arange(len(settled))[:, None] - order).argmin(axis=1)]]


def _plane_scale(measurement: Measurement) -> float:
    """kg m that moves the sensors about as much as what was measured."""
    units = [np.abs(block.unit_sensors) for block in measurement.response.blocks if block.unit_sensors.shape[-1]]
    if not units:
        return 1.0
    return float(np.median(np.abs(measurement.dataset.readings)) / np.median(units[0]))


# --- a population of bearings ----------------------------------------------------------------------------


def nodes_basis(setup: FitSetup, training: Measurement, points: Mapping[str, np.ndarray]) -> Basis:
    """The functions of a model of nodes over the ``points`` (name -> (S,)): a weight is a value at a node."""
    import torch

    sizes = np.ones((training.unknowns.n_members, len(training.unknowns.names)))
    model = coefficient_model(setup.model, training.unknowns.names, points, sizes)
    parameters = torch.zeros(training.unknowns.n_members, model.n_parameters, dtype=torch.float64)
    values = torch.eye(model.n_functions + 1, model.n_functions, dtype=torch.float64)
    return Basis(model, parameters, values.expand(len(parameters), -1, -1), 0)


def _start_by_population(
    training: Measurement, setup: FitSetup, basis: Basis, plane_scale: float
) -> tuple[OutputError, dict[str, Any]]:
    """At the likeliest answer of the families."""
    problem = output_error(training, basis, plane_scale)
    model = basis.model
    nodes = np.geomspace(*model.ranges[0], model.n_functions)
    choices = list_choices(training, setup.model.families, nodes)
    searched = search(problem, choices, setup.seed)
    first = {"weights": searched.weights[:1], "from_guess": False, "searched": searched}
    return replace(searched.problem, functions=searched.choices.functions()), first


# --- bearing laws ----------------------------------------------------------------------------------------


def _start_by_laws(
    training: Measurement, setup: FitSetup, basis: Basis, plane_scale: float
) -> tuple[OutputError, dict[str, Any]]:
    """At the best numbers of bearing laws, without a correction.

    Laws have few numbers, and the readings depend on them far from linearly: a clearance that is wrong by three times
    makes other critical speeds. So many guesses, spread evenly over what was thought possible, are judged at a few
    operating points; the best of them, and the guess itself, are fitted there, and the whole fit goes on from the best.
    """
    theta, *counts = _fit_laws(training, basis, plane_scale)
    made = output_error(training, basis, plane_scale)
    basis = replace(basis, model=replace(basis.model, scale=_scale_by_laws(made, theta)))
    if setup.model.corrects_laws:
        problem = with_sigma(output_error(training, add_beyond(basis), plane_scale))
    else:
        problem = _without_correction(output_error(training, basis, plane_scale))
    weights, first = _weights_of(problem, theta), {"from_guess": False, "starts": tuple(counts)}
    if any(parameter.kind == "base_participation" for parameter in training.parameters):
        weights, _ = _temper(problem, weights, setup.optimizer.levenberg_marquardt)
        problem, first["near"] = problem.update(weights), True
    return problem, {"weights": weights} | first


def _fit_laws(
    training: Measurement,
    basis: Basis,
    plane_scale: float,
    points: int = 24,
    fitted: int = 7,
) -> tuple[torch.Tensor, int, int]:
    """The numbers (Th,) from which the readings are explained best, how many guesses were fitted, and how many of them
    ended there. The correction stays zero.

    With :func:`_spread` and ``fitted`` guesses at so many ``points``, guesses that are 3 times off in every clearance
    and 5 times in the viscosity lead to the same answer.
    """
    import torch

    few = space_evenly(len(training.dataset.speeds), points)
    problem = _without_correction(output_error(training.select(few), basis, plane_scale))
    section = LevenbergMarquardtConfig(steps=60, patience=1, initial_damping=1e-2)
    judged = _spread(problem)
    order = problem.loss(judged)[1:, 0].nan_to_num(float("inf")).argsort()[:fitted]
    starts = torch.cat([judged[:1], judged[1:][order]])
    ends = levenberg_marquardt(problem, starts, section, until_still(1e-4), by_diagonal=True)
    losses = problem.loss(ends)[:, 0].nan_to_num(float("inf"))
    best = int(losses.argmin())
    return problem.theta(ends)[best], len(ends), count_alike(losses.tolist())


def _spread(problem: OutputError, count: int = 255, reach: float = 2.0) -> torch.Tensor:
    """(G, 1, Z) the guess, and ``count`` starts that fill the space of the numbers evenly (Sobol 1967), to ``reach``
    prior deviations on either side.
    """
    import torch

    drawn = torch.quasirandom.SobolEngine(problem.law.n_numbers).draw(count + 1, dtype=torch.float64)[1:]
    numbers = reach * (2 * drawn - 1) * problem.law.prior_precision().rsqrt()
    return _weights_of(problem, torch.cat([torch.zeros_like(numbers[:1]), numbers]))


def _without_correction(problem: OutputError) -> OutputError:
    """The same with the laws alone: no feature is kept."""
    import torch

    return replace(problem, kept=torch.zeros_like(problem.kept))


def _scale_by_laws(problem: OutputError, theta: torch.Tensor) -> tuple[tuple[float, ...], ...]:
    """(M, U) sizes of the unknowns by the laws: of a cross-coupled one, that of the direct ones of its kind."""
    values, _ = problem.law.evaluate(theta[None])
    names, rows = problem.measurement.unknowns.names, []
    for medians in values[0].abs().median(dim=1).values.tolist():
        by_law, sizes = dict(zip(names, medians, strict=True)), []
        for name, size in by_law.items():
            direct = [v for n, v in by_law.items() if n[0] == name[0] and is_direct(n)]
            known = not is_direct(name) and direct and min(direct) > 0
            sizes.append(float(np.exp(np.mean(np.log(direct)))) if known else size)
        rows.append(tuple(size if size > 0 else 1.0 for size in sizes))
    return tuple(rows)


def _weights_of(problem: OutputError, theta: torch.Tensor) -> torch.Tensor:
    """(G, 1, Z) the numbers (Th,) or (G, Th), without a correction."""
    import torch

    numbers = torch.atleast_2d(theta)
    return problem.weigh(len(numbers), numbers=numbers, parameters=problem.sensors.solved_at)
