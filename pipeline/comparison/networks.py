"""FEM-NN: the network of the speed, trained by the paper's residual, the preconditioned residual, or the response."""

from __future__ import annotations

import numpy as np

from pipeline.comparison.method import Estimate, Task, doubt_of, refuse_undetermined
from pipeline.comparison.parameters import require_determined
from pipeline.config.comparison import FitConfig
from pipeline.equations.identifiability import identifiability
from pipeline.equations.response import ResponseEquations, expansion
from pipeline.equations.unknown_system import unknown_system
from pipeline.identification.response_fit import fit_response
from pipeline.identification.response_preparation import MeasuredResponse, prepare_response
from pipeline.identification.response_start import differences
from pipeline.identification.training import TrainingSetup, initial_parameters, prepare, run_training
from pipeline.identification.uncertainty import uncertainty_of


def residual(task: Task) -> Estimate:
    """The paper's loss (eq. 6)."""
    return _by_residual(task, task.settings.residual)


def preconditioned(task: Task) -> Estimate:
    """The residual, multiplied at each speed by the pseudo-inverse of its derivative by the unknowns."""
    return _by_residual(task, task.settings.preconditioned)


def _by_residual(task: Task, fit: FitConfig) -> Estimate:
    task = task.without_unbalance()
    setup = _setup(task, fit)
    assert task.system  # refuses by name what the runs do not determine
    prepared = prepare(task.equations, task.known, setup)
    result = run_training(prepared, initial_parameters(prepared, setup, task.seed), setup).result()
    return Estimate(result.identified.table(task.known), None, f"{result.outcome.label} after {result.steps} steps")


def response(task: Task) -> Estimate:
    """Output error from whatever sensors there are, and its Cramer-Rao deviations."""
    setup = _setup(task, task.settings.response)
    equations = task.response(task.identify.unbalance_planes)
    _require_determined(task, equations)
    data = MeasuredResponse(equations, task.dataset.displacement, task.noise, task.dataset.subtracted)
    prepared = prepare_response(data, task.known, setup, task.seed, np.array([], dtype=int))
    fit = fit_response(prepared, setup, robust=setup.loss.robust)
    identified = fit.batch.identified()
    deviation = uncertainty_of(fit).deviation(identified, task.dataset.speeds)
    words = f"{fit.outcome.label} after {fit.steps} steps, {fit.problem.n_numbers} numbers"
    # Huber's shares out of the weights: what is far off must show.
    with np.errstate(all="ignore"):  # of a fit that ran away
        plain = [
            deviation[0].numpy() / np.sqrt(share)
            for deviation, share in zip(fit.problem.deviations(fit.free), fit.weights, strict=True)
        ]
    doubt = doubt_of(sum(float((np.abs(of) ** 2).sum()) for of in plain), fit.problem.n_rows)
    return Estimate(identified.table(task.known), deviation, words, doubt)


def _require_determined(task: Task, equations: ResponseEquations) -> None:
    """Raise Refusal where neither the forces at the bearings nor all speeds together determine the unknowns."""
    displacement, deviation = task.dataset.displacement, task.deviation
    if equations.planes:
        equations, displacement, deviation = differences(equations, displacement, deviation)
    expanded = expansion(equations, displacement, deviation)
    if expanded is None:
        require_determined(task, together=True)
        return
    system = unknown_system(expanded.equations, task.unknowns, task.known)
    refuse_undetermined(identifiability(expanded.equations, system, task.alike, task.constant))


def _setup(task: Task, fit: FitConfig) -> TrainingSetup:
    return TrainingSetup(task.identify, fit.model, fit.loss, fit.optimizer, fit.training)
