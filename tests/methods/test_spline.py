"""The spline of the comparison, by SciPy, against the output error with B-splines: two authors of one idea."""

from __future__ import annotations

import numpy as np
import pytest
from comparing import FILM, composed, errors, options, task
from conftest import assert_says

from pipeline.comparison.cases import Case
from pipeline.identification.fit import fit
from pipeline.identification.training import FitSetup
from pipeline.methods.method import Estimate
from pipeline.methods.spline import _spread, differentiate, enlarge, identify_by_spline, make_basis, pose
from pipeline.problem.slopes import stack_rows

BALLS = ("experiment=ball_bearing", "machine.speeds.step_rpm=100")


def setup_of(*overrides: str) -> FitSetup:
    """The output error as the comparison has it, with another model."""
    own = composed(*overrides).comparison.response
    return FitSetup(own.model, own.loss, own.optimizer, own.training)


@pytest.mark.slow
def test_the_spline_is_as_good_as_the_output_error_with_b_splines() -> None:
    """Over some data sets of 1 % noise, eight functions each: neither has a median error a third above the other."""
    few = ("model@comparison.response.model=b_spline", "comparison.response.model.count=8")
    ours, theirs = [], []
    for i in range(6):
        case = Case(0.01, "bearings", 60, i)
        data = task(case, *FILM)
        ours.append(errors(identify_by_spline(data, options(*FILM)), case, *FILM).mean())
        found = fit(data, setup_of(*FILM, *few)).table(data.known)
        theirs.append(errors(Estimate(found), case, *FILM).mean())
    assert 3 / 4 < np.mean(ours) / np.mean(theirs) < 4 / 3


def test_constants_are_the_same_minimum() -> None:
    """Constants leave nothing to choose: the two minimise the same sum of squares, weighed by the same noise."""
    data = task(Case(0.01, "bearings", 60), *BALLS)
    one = identify_by_spline(data, options(*BALLS)).coefficients.values
    np.testing.assert_allclose(one, fit(data, setup_of(*BALLS)).table(data.known).values, rtol=3e-4)


BLOWS = ("experiment=impulses", "machine.speeds.step_rpm=1000")


@pytest.mark.slow
def test_the_spline_finds_the_residual_unbalance() -> None:
    """On clean data exactly, and the runs that turn with the rotor count as the others do."""
    case = Case(0.0, "bearings", 6)
    found = identify_by_spline(task(case, *BLOWS), options(*BLOWS))
    hidden = {one.node: 1e6 * one.magnitude for one in composed(*BLOWS).machine.residual_unbalance}
    assert_says(found.words, *(f"{size:.3g} g mm at node {node}" for node, size in hidden.items()))
    assert errors(found, case, *BLOWS).max() < 1e-6


def test_its_problem_is_that_of_the_response_equations(rng: np.random.Generator) -> None:
    """Chi-square, gradient and information are those of the predicted readings over their noise, by the chain rule."""
    import torch

    data = task(Case(0.01, "bearings", 6), *BLOWS)
    basis, active, planes = make_basis(data.dataset.speeds, 4), data.unknowns.active, data.unknowns.planes
    sizes = data.guess.sizes(data.unknowns)
    problem = enlarge(pose(data, sizes), basis)
    weights = 0.1 * rng.standard_normal(problem.places.size)
    numbers, pairs = np.split(weights, [len(active) * 4])
    outputs = (numbers.reshape(-1, 4) @ basis.T).T  # (S, A)
    direct = np.array([data.unknowns.names[u][1] == data.unknowns.names[u][2] for _, u in active])
    size = np.array([sizes[m, u] for m, u in active])
    values = data.unknowns.from_active(size * np.where(direct, np.exp(outputs), outputs))
    unbalance, weight = 1e-4 * (pairs[::2] + 1j * pairs[1::2]), np.sqrt(2) / data.deviation
    off = data.response.predict(data.table(values), unbalance) - data.dataset.displacement
    slope = size * np.where(direct, np.exp(outputs), 1.0)
    by_coefficient = data.response.sensitivity(data.table(values), unbalance)
    by_output = np.einsum("sprbc,bca->spra", by_coefficient, data.unknowns.influence) * slope[:, None, None]
    by_number = (by_output[..., None] * basis[:, None, None, None]).reshape(*by_output.shape[:3], -1)
    by_plane = 1e-4 * data.response.derive_by_unbalance(data.table(values))
    by_pair = np.stack([by_plane, 1j * by_plane], axis=-1).reshape(*by_plane.shape[:-1], 2 * len(planes))
    rows = stack_rows(off * weight).ravel()
    columns = stack_rows(np.concatenate([by_number, by_pair], axis=-1) * weight[..., None]).reshape(len(rows), -1)
    local = differentiate(problem, torch.as_tensor(weights)[None, None])
    got, jacobian = local[..., -1].ravel(), _spread(local[..., :-1], basis, len(pairs)).toarray()
    assert got @ got == pytest.approx(rows @ rows, rel=1e-9)
    scale = np.linalg.norm(columns, axis=0)
    np.testing.assert_allclose(
        jacobian.T @ got / scale, columns.T @ rows / scale, rtol=1e-8, atol=1e-9 * abs(rows).max()
    )
    outer = scale[:, None] * scale
    np.testing.assert_allclose(jacobian.T @ jacobian / outer, columns.T @ columns / outer, atol=1e-9)
