"""Where a fit of bearing laws starts: the best of many guesses of their numbers.

Laws have few numbers, and the readings depend on them far from linearly: a clearance that is wrong by three times makes
other critical speeds. So many guesses, spread evenly over what was thought possible, are judged at a few operating
points; the best of them, and the guess itself, are fitted there, and the whole fit goes on from the best answer.

Legend: G starts, M members, S operating points, U unknowns, Th numbers, Z weights.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from pipeline.coefficients import is_direct
from pipeline.config.identification import LevenbergMarquardtConfig
from pipeline.identification.basis import Basis
from pipeline.identification.optimizers import levenberg_marquardt, until_still
from pipeline.identification.problem import OutputError, output_error
from pipeline.identification.training import FitSetup
from pipeline.problem.measurement import Measurement

if TYPE_CHECKING:
    import torch

_JUDGED, _FITTED = 255, 7
"""So many guesses are judged beside the configured one, and so many of them fitted: with these, guesses that are 3
times off in every clearance and 5 times in the viscosity lead to the same answer.
"""
_SPREAD = 2.0
"""Prior deviations to either side that the starts cover."""
_POINTS = 24
_STEPS, _STILL = 60, 1e-4
_SAME = 1e-3
"""Starts whose losses differ by less than this share of the lowest ended at the same answer."""


@dataclass(frozen=True)
class LawStart:
    """Where the numbers start, and how many of the guesses led there."""

    theta: np.ndarray  # (Th,)
    n_starts: int
    n_same: int  # starts that ended at the lowest loss


def start_laws(training: Measurement, basis: Basis, plane_scale: float) -> LawStart:
    """The numbers (Th,) from which the readings are explained best; the correction stays zero."""
    import torch

    count = len(training.dataset.speeds)
    few = np.unique(np.linspace(0, count - 1, min(count, _POINTS)).round().astype(int))
    problem = without_correction(output_error(training.select(few), basis, plane_scale))
    section = LevenbergMarquardtConfig(steps=_STEPS, patience=1, initial_damping=1e-2)
    judged = _spread(problem)
    order = problem.loss(judged)[1:, 0].nan_to_num(float("inf")).argsort()[:_FITTED]
    starts = torch.cat([judged[:1], judged[1:][order]])
    fitted = levenberg_marquardt(problem, starts, section, until_still(_STILL), by_diagonal=True)
    losses = problem.loss(fitted)[:, 0].nan_to_num(float("inf"))
    best = int(losses.argmin())
    same = int((losses < losses[best] * (1 + _SAME)).sum())
    return LawStart(problem.theta(fitted)[best].numpy(), len(fitted), same)


def _spread(problem: OutputError) -> torch.Tensor:
    """(G, 1, Z) the guess, and starts that fill the space of the numbers evenly (Sobol 1967)."""
    import torch
    from scipy.stats import qmc

    law = problem.law
    assert law is not None
    deviation = law.prior_precision().rsqrt()
    weights = torch.zeros(1 + _JUDGED, 1, problem.size, dtype=deviation.dtype)
    drawn = qmc.Sobol(law.n_numbers, scramble=False).random(_JUDGED + 1)[1:]
    places = torch.as_tensor(_SPREAD * (2 * drawn - 1)) * deviation
    weights[1:, 0, problem.places.numbers] = places
    weights[..., problem.places.parameters] = problem.sensors.solved_at
    return weights


def without_correction(problem: OutputError) -> OutputError:
    """The same with the laws alone: no feature is kept."""
    import torch

    return replace(problem, kept=torch.zeros_like(problem.kept))


def scale_by_laws(problem: OutputError, theta: np.ndarray) -> tuple[tuple[float, ...], ...]:
    """(M, U) sizes of the unknowns by the laws: of a cross-coupled one, that of the direct ones of its kind."""
    import torch

    law = problem.law
    assert law is not None
    values, _ = law.evaluate(torch.as_tensor(theta)[None])
    median = values[0].abs().median(dim=1).values.numpy()  # (M, U)
    names = problem.measurement.unknowns.names
    rows = []
    for sizes_by_law in median:
        direct = {
            kind: [v for v, n in zip(sizes_by_law, names, strict=True) if n[0] == kind and is_direct(n)]
            for kind in "kc"
        }
        mean = {
            kind: float(np.exp(np.mean(np.log(kind_values))))
            for kind, kind_values in direct.items()
            if kind_values and min(kind_values) > 0
        }
        sizes = [
            float(v) if is_direct(n) else mean.get(n[0], float(v)) for v, n in zip(sizes_by_law, names, strict=True)
        ]
        rows.append(tuple(v if v > 0 else 1.0 for v in sizes))
    return tuple(rows)


def first_weights(problem: OutputError, theta: np.ndarray) -> torch.Tensor:
    """(1, 1, Z) the numbers, without a correction."""
    import torch

    weights = torch.zeros(1, 1, problem.size, dtype=torch.float64)
    weights[0, 0, problem.places.numbers] = torch.as_tensor(theta)
    weights[..., problem.places.parameters] = problem.sensors.solved_at
    return weights


def corrects(setup: FitSetup) -> bool:
    """Whether a network corrects the laws."""
    return setup.model.corrects_laws
