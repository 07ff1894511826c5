"""Choosing the runs that determine the unknowns best, before anything is measured.

Each run adds its Fisher information to that of the others, ``I = sum A_r' S_r^-1 A_r`` with the covariance S_r of its
residual (least squares at each speed, :mod:`pipeline.problem.noise`): a set of runs is judged without a simulation.

Legend: C candidate runs, S speeds, U unknowns, M members (see :mod:`pipeline.problem.residual`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Literal

import numpy as np

from pipeline.coefficients import COEFFICIENTS
from pipeline.data.dataset import VibrationDataset
from pipeline.data.simulate import add_noise
from pipeline.problem.measurement import Measurement
from pipeline.problem.noise import least_squares_deviation, residual_covariance, whiten
from pipeline.problem.ranking import find_least
from pipeline.problem.residual import LinearResidual, bearing_equations, linear_residual, per_speed_least_squares

Criterion = Literal["A", "D"]


def run_information(white: LinearResidual, n_runs: int, size: np.ndarray) -> np.ndarray:
    """(C, M, S, U, U) information of each run on the unknowns relative to their ``size`` (M, S, U).

    ``white`` is a :func:`pipeline.problem.noise.whiten` residual of all candidates as its runs.
    """
    members, n_speeds, _, n_unknowns = white.matrix.shape
    rows = (white.matrix * size[:, :, None]).reshape(members, n_speeds, 2, n_runs, -1, n_unknowns)
    return np.asarray(np.einsum("mscriu,mscriv->rmsuv", rows, rows))


def merit(information: np.ndarray, present: np.ndarray, criterion: Criterion, prior_deviation: float = 1e3) -> float:
    """What a design minimises, from the information (M, S, U, U) of its runs; ``present`` (M, U).

    A: logarithm of the mean variance; D: of the volume of the confidence region; means over speeds and bearings. Every
    unknown is known beforehand to within ``prior_deviation`` times its size, so that sets too small to determine all of
    them compare.
    """
    total = 0.0
    for m, unknowns in enumerate(present):
        determined = information[m][:, unknowns][:, :, unknowns] + np.eye(int(unknowns.sum())) / prior_deviation**2
        if criterion == "D":
            total -= float(np.linalg.slogdet(determined)[1].mean()) / unknowns.sum()
        else:
            total += float(np.log(np.trace(np.linalg.inv(determined), axis1=1, axis2=2) / unknowns.sum()).mean())
    return total / len(present)


def choose(information: np.ndarray, present: np.ndarray, count: int, criterion: Criterion) -> tuple[int, ...]:
    """Indices of the best ``count`` candidates by the criterion, see :func:`exchange`."""
    return exchange(
        lambda runs: merit(information[list(runs)].sum(axis=0), present, criterion), len(information), count
    )


def exchange(
    merit_of: Callable[[Sequence[int]], float], n_candidates: int, count: int, least_gain: float = 1e-9
) -> tuple[int, ...]:
    """The ``count`` of ``n_candidates`` of the least merit: greedily one by one, then exchanged while it falls."""
    chosen: list[int] = []
    for _ in range(count):
        free = [c for c in range(n_candidates) if c not in chosen]
        chosen.append(find_least({c: merit_of([*chosen, c]) for c in free}))
    improved = True
    while improved:
        improved = False
        for place in range(count):
            others = [*chosen[:place], *chosen[place + 1 :]]
            free = [c for c in range(n_candidates) if c not in others]
            best = find_least({c: merit_of([*others, c]) for c in free})
            if merit_of(chosen) - merit_of([*others, best]) > least_gain:
                chosen, improved = [*others, best], True
    return tuple(sorted(chosen))


# --- what a set of runs would give -------------------------------------------------------------------


def plan_covariance(plan: Measurement) -> np.ndarray:
    """(S, R, 2 B, 2 B) N^2, of the residual; a ``plan`` is simulated on the prior, which it has as known bearings."""
    return residual_covariance(plan.rotor, plan.dataset, plan.known, plan.deviation)


def whiten_plan(plan: Measurement, dataset: VibrationDataset, covariance: np.ndarray) -> LinearResidual:
    """The weighted equations of a ``dataset`` of the planned runs."""
    return whiten(linear_residual(bearing_equations(plan.rotor, dataset), plan.unknowns, plan.known), covariance)


def unknown_sizes(plan: Measurement, floor: float = 0.01) -> np.ndarray:
    """(M, S, U) sizes of the unknowns; some cross zero: no less than a share ``floor`` of the largest of their kind."""
    values = np.abs(plan.known.values)
    kinds = values.reshape(*values.shape[:2], 2, 4)
    least = np.repeat(floor * kinds.max(axis=-1), 4, axis=-1)
    leaders = [COEFFICIENTS.index(name) for name in plan.unknowns.names]
    return np.asarray(np.maximum(values, least)[: plan.unknowns.n_members][..., leaders])


def predict_deviations(plan: Measurement) -> dict[str, float]:
    """Bearing and unknown -> predicted standard deviation of least squares over size, median over speed."""
    return _medians(plan, least_squares_deviation(whiten_plan(plan, plan.dataset, plan_covariance(plan))))


def simulate_deviations(plan: Measurement, count: int, generator: np.random.Generator) -> dict[str, float]:
    """The same, as the spread of ``count`` weighted least-squares fits to noisy data."""
    covariance = plan_covariance(plan)
    fits = [
        per_speed_least_squares(whiten_plan(plan, add_noise(plan.dataset, plan.deviation, generator), covariance))[0]
        for _ in range(count)
    ]
    return _medians(plan, np.array(fits).std(axis=0, ddof=1))


def _medians(plan: Measurement, deviation: np.ndarray) -> dict[str, float]:
    medians = np.median(deviation / unknown_sizes(plan), axis=1)
    return {name: float(medians[place]) for name, place in zip(list_names(plan), plan.unknowns.active, strict=True)}


def list_names(plan: Measurement) -> tuple[str, ...]:
    """(A,) what the active unknowns are called, such as ``node 1 kxx``."""
    unknowns = plan.unknowns
    nodes = ["all bearings"] if unknowns.shared else [f"node {node}" for node in plan.rotor.bearing_nodes]
    return tuple(f"{nodes[m]} {unknowns.names[u]}" for m, u in unknowns.active)
