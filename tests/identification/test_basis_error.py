"""Deviations where the functions of the speed can't follow the coefficients: local functions say by how much."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from running import composed
from scipy.stats import multivariate_normal
from small_rotor import fitted_beside_truth

from pipeline.identification.model_error import count_local, evaluate_local
from pipeline.identification.output_error_fit import OutputErrorFit
from pipeline.identification.selection import Evidence

NOISE = ["stated_noise.additive=0.05 um", "stated_noise.multiplicative=0.005"]
DIRECT = "identify.unknowns=[kxx,kyy,cxx,cyy]"


def fitted(name: str, *overrides: str) -> tuple[OutputErrorFit, np.ndarray]:
    """The fit of a machine of studies/coverage, its cross terms known, and the true unknowns (S, A)."""
    config = composed("stage=train", f"machine.file=studies/coverage/{name}.yaml", *NOISE, DIRECT, *overrides)
    return fitted_beside_truth(config, 3)


def held(fit: OutputErrorFit, truth: np.ndarray, matrix: np.ndarray, n_local: int) -> float:
    """Share of coefficients and speeds inside their 95 % intervals."""
    problem = fit.problem
    values, slope = (part[0].numpy() for part in problem.unknowns(fit.weights)[:2])
    local = evaluate_local(problem.basis.model, problem.measurement.dataset.points, n_local)
    count = problem.features.shape[-1] + n_local
    inside = []
    for a, (m, _) in enumerate(problem.active):
        functions = np.concatenate([problem.features[m].numpy(), local], axis=1)
        own = slice(a * count, (a + 1) * count)
        spread = np.sqrt(np.einsum("sk,kl,sl->s", functions, matrix[own, own], functions))
        inside.append(np.abs(values[:, a] - truth[:, a]) <= 1.96 * spread * np.abs(slope[:, a, a]))
    return float(np.mean(inside))


@pytest.mark.parametrize("seed", range(6))
def test_the_size_of_what_is_not_followed_is_the_likeliest(seed: int) -> None:
    """Against the likelihood of the data themselves, by the density of SciPy, at sizes about the answer."""
    rng, true, smallest = np.random.default_rng(seed), np.array([0.0, 0.3, 2.0]), 1e-6
    rows = rng.standard_normal((80, 30)) / 3
    data = rows @ (np.repeat(true, 10) * rng.standard_normal(30)) + rng.standard_normal(80)
    evidence = Evidence(rows.T @ rows, rows.T @ data, np.ones((3, 10)), np.eye(3), np.full(3, 0.03))
    sigma = evidence.maximise(still=1e-4, smallest=smallest)

    def likelihood(sizes: np.ndarray) -> float:
        return float(multivariate_normal(cov=np.eye(80) + rows * np.repeat(sizes**2, 10) @ rows.T).logpdf(data))

    vanished = sigma == smallest
    for move in np.eye(3):
        assert likelihood(np.where(vanished, 0.05 * move, sigma * np.exp(0.05 * move))) < likelihood(sigma)
        assert vanished @ move or likelihood(sigma * np.exp(-0.05 * move)) < likelihood(sigma)


@pytest.mark.slow
def test_intervals_hold_coefficients_with_kinks() -> None:
    """The inverse of the information is too narrow by far; the mean square error is not."""
    fit, truth = fitted("overhung_kinked")
    narrow, wide = held(fit, truth, fit.covariance(), 0), held(fit, truth, fit.error().matrix, fit.error().n_local)
    print(f"inside: {narrow:.3f} by the information, {wide:.3f} by the mean square error")
    assert narrow < 0.8
    assert 0.88 < wide <= 1.0


@pytest.mark.slow
def test_where_the_functions_suffice_the_deviations_hardly_change() -> None:
    """Tables over the Sommerfeld number are nearly power laws."""
    fit, _ = fitted("rigid")
    assert fit.problem.places.n_rest == 0
    n_features, n_local = fit.problem.features.shape[-1], fit.error().n_local
    own = np.arange(len(fit.error().matrix)) % (n_features + n_local) < n_features
    before, after = np.diag(fit.covariance()), np.diag(fit.error().matrix[np.ix_(own, own)])
    kept = fit.problem.fitted().numpy()
    ratio = np.sqrt(after[kept] / before[kept])
    assert ratio.min() >= 1.0
    assert np.median(ratio) < 1.02
    assert np.allclose(after[~kept], before[~kept])


def test_constants_and_few_speeds_have_no_local_functions() -> None:
    """A constant is one by assumption; few readings can't tell a local function from noise."""
    from pipeline.identification.model import CoefficientModel

    model = CoefficientModel(
        unknowns=("kxx",),
        inputs=("speed",),
        parametrisation="log",
        scale=((1e6,),),
        hidden=(4,),
        ranges=((10.0, 500.0),),
    )
    assert {count: count_local(model, count) for count in (91, 30, 7)} == {91: 30, 30: 15, 7: 0}
    assert count_local(replace(model, hidden=None), 91) == 0
    functions = evaluate_local(model, {"speed": np.array([10.0, 200.0, 500.0])}, 10)
    np.testing.assert_allclose(functions.sum(axis=1), 1.0)  # they add up to a constant
    assert evaluate_local(model, {"speed": np.array([10.0])}, 0).shape == (1, 0)
