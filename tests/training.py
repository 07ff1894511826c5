"""What the tests of training share: a machine's measurement, phases of an optimiser, and models trained by them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from conftest import Machine, unknown_at_all

from pipeline.config.identification import (
    AdamConfig,
    LBFGSConfig,
    LevenbergMarquardtConfig,
    LossConfig,
    OptimizerConfig,
    TrainingConfig,
)
from pipeline.identification.model import CoefficientModel
from pipeline.identification.problem import OutputError
from pipeline.identification.residual_loss import ResidualTraining, initial_parameters, prepare_residual
from pipeline.identification.training import FitSetup, Minimum, Progress, Watch, minimise
from pipeline.problem.measurement import Measurement


def dense_jacobian(problem: OutputError, weights: torch.Tensor) -> torch.Tensor:
    """(rows + N, Z) derivative of the rows of one state, as they order them: :meth:`normal` does without it."""
    return torch.cat([problem.columns(weights)[0, :, :-1], problem.prior.rows.reshape(-1, problem.places.size)])


def assert_columns(problem: OutputError, weights: torch.Tensor, at_once: bool = True) -> None:
    """The columns are those of automatic differentiation of the rows, all ``at_once`` where torch can do that."""
    wanted = torch.autograd.functional.jacobian(lambda z: problem.rows(z)[0, 0], weights, vectorize=at_once)[:, 0, 0]
    assert float((dense_jacobian(problem, weights) - wanted).abs().max()) < 1e-10 * float(wanted.abs().max())


def assert_normal(problem: OutputError, weights: torch.Tensor) -> None:
    """The normal equations are those of the columns, number by number; a step leaves what is not fitted."""
    columns, rows = dense_jacobian(problem, weights), problem.rows(weights)[0, 0, :, None]
    gradient, matrix = problem.normal(weights)
    left = torch.diag((~problem.fitted()).to(columns.dtype))
    for found, other, beside in ((matrix[0, 0], columns, left), (gradient[0, 0, :, None], rows, 0.0)):
        size = columns.abs().T @ other.abs()
        assert bool(((found - columns.T @ other - beside).abs() <= 1e-10 * size).all())


def differences(evaluate: Callable[[Any], Any], at: np.ndarray, step: float) -> np.ndarray:
    """(.., n) central differences of what is evaluated at numbers (n,), by each of them."""
    moves = step * np.eye(len(at))
    return np.stack([np.asarray(evaluate(at + move) - evaluate(at - move)) / (2 * step) for move in moves], axis=-1)


def assert_slopes(slopes: Any, wanted: np.ndarray, share: float) -> None:
    """Derivatives (.., n) by each number, within a ``share`` of the largest of its own."""
    sizes = np.abs(wanted).reshape(-1, wanted.shape[-1]).max(axis=0)
    off = np.abs(np.asarray(slopes) - wanted).reshape(-1, wanted.shape[-1]).max(axis=0)
    assert (off <= share * sizes).all(), np.flatnonzero(off > share * sizes)


def optimizer(
    adam: int = 0,
    lbfgs: int = 0,
    lm: int = 0,
    rate: float = 0.1,
    final: float = 1e-3,
    patience: int = 100_000,  # no early stopping
) -> OptimizerConfig:
    """Phases of so many steps."""
    return OptimizerConfig(
        adam=AdamConfig(steps=adam, patience=patience, learning_rate=rate, final_rate_fraction=final),
        lbfgs=LBFGSConfig(steps=lbfgs, patience=patience, history=10),
        levenberg_marquardt=LevenbergMarquardtConfig(steps=lm, patience=patience, initial_damping=0.01),
    )


def setup_of(
    machine: Machine,
    phases: OptimizerConfig,
    parametrisation: str = "log",
    scaling: str = "per_speed",
    holdout_every: int = 0,
    tolerance: float = 0.0,
) -> FitSetup:
    """The experiment's model, trained by ``phases``."""
    return FitSetup(
        machine.config.model.model_copy(update={"parametrisation": parametrisation}),
        LossConfig(kind="residual", scaling=scaling, regularisation=0.0),
        phases,
        TrainingConfig(holdout_every=holdout_every, tolerance=tolerance),
    )


def asked(machine: Machine, *unknowns: str, shared: bool = False) -> Measurement:
    """The machine's clean data, with these coefficients unknown (kxx and kyy)."""
    names = unknowns or ("kxx", "kyy")
    return replace(machine.measurement, unknowns=unknown_at_all(machine.rotor.bearing_nodes, names, shared))


def starts(training: ResidualTraining, setup: FitSetup, guesses: list[float]) -> torch.Tensor:
    """(G, M, P) one training a guess, N/m."""
    return torch.cat([initial_parameters(training, setup, 0, guess) for guess in guesses])


def minimised(
    training: ResidualTraining,
    start: torch.Tensor,
    setup: FitSetup,
    progress: Progress | None = None,
    watch: Watch | None = None,
) -> Minimum:
    """Train from there."""
    return minimise(
        training.problem,
        start,
        setup,
        held_out=training.held_out,
        progress=progress,
        watch=watch,
    )


def trained(measurement: Measurement, setup: FitSetup, guesses: list[float]) -> tuple[ResidualTraining, Minimum]:
    """All guesses at once."""
    training = prepare_residual(measurement, setup)
    return training, minimised(training, starts(training, setup, guesses), setup)


def errors(machine: Machine, training: ResidualTraining, found: Minimum) -> np.ndarray:
    """(G,) the largest relative error of any coefficient and speed."""
    worst = []
    for parameters in found.parameters:
        values = training.identified(parameters).values(machine.speeds)
        true = np.stack([machine.bearings.coefficient(n) for n in training.problem.model.unknowns], axis=-1)
        worst.append(np.abs(values / true - 1).max())
    return np.array(worst)


def a_model(
    depth: int | None,
    activation: str = "tanh",
    parametrisation: str = "log",
    unknowns: int = 3,
    members: int = 2,
) -> CoefficientModel:
    """A small model; depth None for constants."""
    return CoefficientModel(
        unknowns=("kxx", "kyy", "cxx", "cyy")[:unknowns],
        inputs=("speed",),
        parametrisation=parametrisation,
        scale=tuple(tuple(10.0 ** (6 + u + m) for u in range(unknowns)) for m in range(members)),
        hidden=None if depth is None else tuple(3 + layer for layer in range(depth)),
        activation=activation,
        input_scaling="log_rpm",
        ranges=((10.0, 600.0),),
    )


CHAINS = {
    # phases, largest relative error: first order reaches what its last learning rate allows
    "adam": (optimizer(adam=800), 4e-5),
    "lbfgs": (optimizer(lbfgs=60), 1e-12),
    "levenberg_marquardt": (optimizer(lm=40), 1e-12),
    "adam, lbfgs": (optimizer(adam=300, lbfgs=30), 1e-12),
    "adam, levenberg_marquardt": (optimizer(adam=300, lm=20), 1e-12),
    "all three": (optimizer(adam=250, lbfgs=10, lm=10), 1e-12),
}


def assert_close(found: Any, wanted: Any, rtol: float = 1e-7, atol: float = 1e-7) -> None:
    """Tensors, or tuples of them; ``torch.testing`` imports what serves many machines, for seconds."""
    for one, other in zip(found, wanted, strict=True) if isinstance(found, tuple) else [(found, wanted)]:
        np.testing.assert_allclose(one.detach(), other.detach(), rtol=rtol, atol=atol, equal_nan=False)
