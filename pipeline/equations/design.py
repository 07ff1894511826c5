"""Choosing the runs that determine the unknowns best, before anything is measured.

Each run adds its Fisher information to that of the others, ``I = sum A_r' S_r^-1 A_r`` with the covariance S_r of its
residual (least squares at each speed, :mod:`pipeline.equations.noise`): a set of runs is judged without a simulation.

Legend: C candidate runs, S speeds, U unknowns, M members (see :mod:`pipeline.equations.unknown_system`).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np

from pipeline.equations.unknown_system import UnknownSystem

Criterion = Literal["A", "D"]

PRIOR_DEVIATION = 1e3
"""Every unknown is taken as known beforehand to within so many times its size, so that sets too small to determine all
of them compare."""


def run_information(white: UnknownSystem, n_runs: int, size: np.ndarray) -> np.ndarray:
    """(C, M, S, U, U) information of each run on the unknowns relative to their ``size`` (M, S, U).

    ``white`` is a :func:`pipeline.equations.noise.whitened` system of all candidates as its runs.
    """
    members, n_speeds, _, n_unknowns = white.matrix.shape
    rows = (white.matrix * size[:, :, None]).reshape(members, n_speeds, 2, n_runs, -1, n_unknowns)
    return np.einsum("mscriu,mscriv->rmsuv", rows, rows)


def merit(information: np.ndarray, present: np.ndarray, criterion: Criterion) -> float:
    """What a design minimises, from the information (M, S, U, U) of its runs; ``present`` (M, U).

    A: logarithm of the mean variance; D: of the volume of the confidence region; means over speeds and bearings.
    """
    total = 0.0
    for m, there in enumerate(present):
        own = information[m][:, there][:, :, there] + np.eye(int(there.sum())) / PRIOR_DEVIATION**2
        if criterion == "D":
            total -= float(np.linalg.slogdet(own)[1].mean()) / there.sum()
        else:
            total += float(np.log(np.trace(np.linalg.inv(own), axis1=1, axis2=2) / there.sum()).mean())
    return total / len(present)


def choose(information: np.ndarray, present: np.ndarray, count: int, criterion: Criterion) -> tuple[int, ...]:
    """Indices of the best ``count`` candidates: greedily one after the other, then exchanged while that improves."""
    chosen: list[int] = []
    for _ in range(count):
        free = [c for c in range(len(information)) if c not in chosen]
        chosen.append(min(free, key=lambda c: _merit_of(information, present, [*chosen, c], criterion)))
    improved = True
    while improved:
        improved = False
        for place in range(count):
            others = [*chosen[:place], *chosen[place + 1 :]]
            free = [c for c in range(len(information)) if c not in others]
            best = min(free, key=lambda c: _merit_of(information, present, [*others, c], criterion))
            gain = _merit_of(information, present, chosen, criterion) - _merit_of(
                information, present, [*others, best], criterion
            )
            if gain > _LEAST_GAIN:
                chosen, improved = [*others, best], True
    return tuple(sorted(chosen))


_LEAST_GAIN = 1e-9


def _merit_of(information: np.ndarray, present: np.ndarray, runs: Sequence[int], criterion: Criterion) -> float:
    return merit(information[list(runs)].sum(axis=0), present, criterion)
