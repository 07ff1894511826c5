"""What a measurement determines, before any fit: ranks, condition numbers, and the deviations that its noise implies.

From the residual where x and y are measured at every bearing; from the response at the sensors otherwise. Where the
sensors tell the forces at the bearings, the two say the same. Where they do not, all bearings speak through the same
sensors and are judged together, at bearings that explain the readings. Neighbouring speeds then help each other as far
as the coefficients are smooth functions of the speed, and the deviation of the whole parametrisation tells how far. No
modelled coefficient is read.

Legend: S speeds, P channels, R runs, B bearings, M members, U unknowns, A those of them that members have, K features,
T model parameters.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from pipeline.coefficients import COEFFICIENTS
from pipeline.problem.determination import measure_sizes
from pipeline.problem.expansion import expand
from pipeline.problem.identifiability import (
    Identifiability,
    Solvability,
    count_determined,
    decompose,
    judge_identifiability,
    judge_rank,
    unit_columns,
)
from pipeline.problem.measurement import Measurement
from pipeline.problem.noise import DEPENDENT, least_squares_deviation, whiten
from pipeline.problem.residual import BearingEquations, LinearResidual, linear_residual, per_speed_least_squares
from pipeline.problem.slopes import ReadingSlopes, stack_rows
from pipeline.rotor.bearing_table import BearingTable

UNEQUAL = np.array([1.0, 0.2, -0.3, 0.7])
"""xx, xy, yx, yy over the guess, of the bearing that few sensors are judged by: one that is the same in all directions
would show circular orbits, from which less follows than from those of real bearings."""


@dataclass(frozen=True, eq=False)
class Diagnosis:
    """Everything that is known of a fit before it is done."""

    reports: tuple[Identifiability, ...]
    expected: BearingTable  # with the deviations of least squares of each speed by itself, or of smooth functions
    by_least_squares: bool = True  # which of the two

    @property
    def solved(self) -> bool:
        """Whether there is an answer at every bearing."""
        return all(report.verdict is not Solvability.NOT_IDENTIFIABLE for report in self.reports)

    def relative(self, node: int) -> dict[str, np.ndarray]:
        """Coefficient -> (S,) standard deviation over size."""
        b = self.expected.nodes.index(node)
        size, deviation = np.abs(self.expected.values[b]), self.expected.spread[b]
        return {
            name: np.divide(deviation[:, c], size[:, c], out=np.full(len(size), np.inf), where=size[:, c] > 0)
            for c, name in enumerate(COEFFICIENTS)
            if not np.isnan(deviation[:, c]).all()
        }


def diagnose_residual(measurement: Measurement, constant: bool) -> Diagnosis:
    """By the residual; ``constant`` where the coefficients are the same at every speed. Raises DataError."""
    return _diagnose_least_squares(
        measurement, measurement.equations, measurement.residual, constant, measurement.residual_root
    )


def _diagnose_least_squares(
    measurement: Measurement,
    equations: BearingEquations,
    residual: LinearResidual,
    constant: bool,
    find_root: Callable[[BearingTable], np.ndarray],
) -> Diagnosis:
    """By the ``residual`` of the equations, with the root of its covariance near the bearings that solve it."""
    reports = judge_identifiability(equations, residual, constant)
    answer = measurement.table(per_speed_least_squares(residual))
    spread = measurement.unknowns.expand_deviation(least_squares_deviation(whiten(residual, find_root(answer))))
    return Diagnosis(reports, replace(answer, deviation=spread, by="each speed by itself"))


def diagnose_response(
    measurement: Measurement, constant: bool, suppose: Callable[[Measurement], tuple[np.ndarray, BearingTable]]
) -> Diagnosis:
    """By the response at the sensors, whatever they are.

    ``suppose`` gives what few sensors are judged by: the functions of the speed, (M, S, K), that the coefficients are
    sought among, and bearings that explain the readings.
    """
    whole = measurement.subtract_unbalance()
    expansion = expand(whole.response, whole.dataset.displacement, whole.deviation)
    if expansion is None:
        return _diagnose_few_sensors(whole, *suppose(whole))
    residual = linear_residual(expansion.equations, whole.unknowns, whole.known)
    return _diagnose_least_squares(
        whole, expansion.equations, residual, constant, partial(expansion.residual_root, whole.response)
    )


# --- sensors too few for the forces at the bearings ---------------------------------------------------


def sensor_rows(measurement: Measurement, bearings: BearingTable) -> np.ndarray:
    """(S, 2 P R, A) how the readings over their noise move with the logarithm of each active unknown, or its share of
    its size, at these ``bearings``; real parts first.
    """
    size = measurement.unknowns.to_active(measurement.unknowns.leading(measure_sizes(bearings.values)))
    return stack_rows(np.sqrt(2.0) * ReadingSlopes(measurement, bearings).by_unknown * size[:, None, None])


def guess_bearings(measurement: Measurement) -> BearingTable:
    """Bearings of the size of the guess, :data:`UNEQUAL`."""
    unknowns = measurement.unknowns
    shape = np.array([UNEQUAL[2 * (name[1] == "y") + (name[2] == "y")] for name in unknowns.names])
    return measurement.table((measurement.guess.sizes(unknowns) * shape)[:, None])


def determines(rows: np.ndarray) -> bool:
    """Whether the rows (S, N, A) leave no combination of the unknowns free, at the median speed."""
    if rows.shape[1] < rows.shape[2]:
        return False
    singular = np.linalg.svd(unit_columns(rows), compute_uv=False)
    return bool(np.median(singular[:, -1] / singular[:, 0]) >= DEPENDENT)


def _diagnose_few_sensors(measurement: Measurement, features: np.ndarray, bearings: BearingTable) -> Diagnosis:
    """At ``bearings`` that explain the readings, with the noise of what these show, too: slopes of one response over
    the noise of another one promise anything.
    """
    shown = measurement.deviation_of(measurement.response.predict(bearings), measurement.baseline)
    weighed = replace(measurement, weighed=np.maximum(measurement.deviation, shown), solved=measurement.response)
    rows = sensor_rows(weighed, bearings)
    unknowns, dataset = measurement.unknowns, measurement.dataset
    singular, least = decompose(unit_columns(rows))
    rank = count_determined(singular)
    relative = _smooth_deviation(rows, np.stack([features[m] for m, _ in unknowns.active]))
    spread = unknowns.from_active(relative) * unknowns.leading(measure_sizes(bearings.values))
    nodes = measurement.rotor.bearing_nodes
    labels = tuple(
        unknowns.names[u] if unknowns.n_members == 1 else f"{unknowns.names[u]} at node {nodes[m]}"
        for m, u in unknowns.active
    )
    verdict, reason = _judge_few_sensors(labels, rank, np.median(relative, axis=0), len(dataset.channels))
    report = Identifiability(
        nodes=nodes,
        unknowns=labels,
        speeds=dataset.speeds,
        singular_values=singular,
        free=least,
        verdict=verdict,
        reason=reason,
        orbit_rank=np.full(len(rank), np.nan),
        orbit_condition=np.full(len(rank), np.nan),
        together="which share their coefficients" if unknowns.shared else "seen by the same sensors",
    )
    by = "smooth functions over all speeds"
    expected = replace(bearings, deviation=unknowns.expand_deviation(spread), by=by)
    return Diagnosis((report,), expected, by_least_squares=False)


def _smooth_deviation(rows: np.ndarray, features: np.ndarray, prior_deviation: float = 1e3) -> np.ndarray:
    """(S, A) standard deviation over size of unknowns whose logarithms combine ``features`` (A, S, K).

    Every feature is known beforehand to ``prior_deviation`` times the size of its unknown, so that what the sensors
    leave open has a finite deviation, far above 1.
    By QR rather than by the information: what the prior alone determines lies as far below the rest as numbers go.
    """
    from scipy.linalg import solve_triangular

    n_active, n_speeds, count = features.shape
    by_weight = np.einsum("sna,ask->snak", rows, features).reshape(-1, n_active * count)
    stacked = np.concatenate([by_weight, np.eye(n_active * count) / prior_deviation])
    size = np.linalg.norm(stacked, axis=0)
    triangle = np.linalg.qr(stacked / size, mode="r")
    slopes = np.einsum("ab,ask->akbs", np.eye(n_active), features).reshape(len(size), -1)
    carried = solve_triangular(triangle, slopes / size[:, None], trans="T")
    return np.asarray(np.linalg.norm(carried, axis=0).reshape(n_active, n_speeds).T)


def _judge_few_sensors(
    labels: tuple[str, ...], rank: np.ndarray, relative: np.ndarray, n_channels: int, learnt: float = 1.0
) -> tuple[Solvability, str]:
    """``learnt`` is the deviation over size from which on a coefficient was not determined."""
    wanted, sensors = len(labels), "the only sensor does" if n_channels == 1 else f"the {n_channels} sensors do"
    unknown = [label for label, deviation in zip(labels, relative, strict=True) if deviation > learnt]
    return judge_rank(
        rank,
        wanted,
        not unknown,
        f"{sensors} not determine all {wanted} unknowns, but as smooth functions of the speed they are determined",
        f"{sensors} not determine more than {int(rank.max())} of {wanted} unknowns at a speed, and over all speeds "
        f"not {'one of them' if len(unknown) == wanted else ', '.join(unknown)}; add sensors, a run of another whirl "
        "or frequency, or a structure (identify.structure)",
    )


# --- what tolerances do --------------------------------------------------------------------------------


def systematic_shifts(measurement: Measurement, bearings: BearingTable) -> np.ndarray | None:
    """(S, A, T) error of each active unknown, N/m and N s/m, where the machine is one prior deviation off.

    At one speed, weighted least squares takes a wrong model for other coefficients. Where the readings of a machine
    that is not as stated differ by ``V``, and move by ``J`` with the unknowns, both over the noise, the unknowns move
    by ``(J'J)^-1 J'V``. A fit over all speeds shares what is smooth over the speed, and a model error is: it moves by
    about as much. ``bearings`` are the best at hand. None where a speed by itself does not determine the unknowns.
    """
    linear = ReadingSlopes(measurement, bearings)
    unknown, model = stack_rows(linear.by_unknown), stack_rows(linear.by_model)
    size = np.linalg.norm(unknown, axis=1, keepdims=True)
    if unknown.shape[1] < unknown.shape[2] or not size.all():
        return None
    return np.asarray(np.linalg.pinv(unknown / size) @ model / size.swapaxes(1, 2))


def budget_percent(measurement: Measurement, bearings: BearingTable) -> dict[str, np.ndarray] | None:
    """Kind of parameter -> (A,) percent of the coefficient, the median over the speed: what its tolerance does to it,
    beside the deviations.

    Parameters of one kind are independent: their squares add. None as :func:`systematic_shifts`.
    """
    shifts = systematic_shifts(measurement, bearings)
    if shifts is None:
        return None
    sizes = measurement.unknowns.to_active(measurement.unknowns.leading(bearings.values))  # (S, A)
    kinds = np.array([parameter.kind for parameter in measurement.parameters])
    return {
        kind: 100 * np.median(np.sqrt((shifts[..., kinds == kind] ** 2).sum(axis=-1)) / np.abs(sizes), axis=0)
        for kind in dict.fromkeys(kinds.tolist())
    }
