"""How many features each unknown gets, and how large they may be: ties, what vanished, and the likeliest sizes."""

from __future__ import annotations

from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from conftest import Machine
from scipy.stats import multivariate_normal

from identification.test_output_error_fit import fit_of, noisy
from pipeline.identification.linear_start import start_at
from pipeline.identification.selection import Evidence, revive


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


@dataclass(frozen=True)
class _Features:
    """As much of an output error as the choice of its features reads: one unknown, three of them."""

    kept: Any

    @property
    def basis(self) -> Any:
        return SimpleNamespace(n_trend=1)

    def fitted(self) -> Any:
        return self.kept.flatten()


@pytest.mark.parametrize(
    ("last", "kept"),
    [(2.0, 2), (2.0 + 1e-6, 2), (2.0 - 1e-6, 2), (2.5, 3), (1.5, 2)],
)
def test_a_tie_goes_to_fewer_features(last: float, kept: int) -> None:
    """``last`` is what the third feature lowers chi-square by: 2 is Akaike's price of a number."""
    from pipeline.identification.selection import drop_features

    free = torch.tensor([[[9.0, 9.0, last**0.5]]], dtype=torch.float64)
    problem: Any = _Features(torch.ones(1, 3, dtype=torch.bool))
    chosen, start = drop_features(problem, free, np.eye(3))
    assert int(chosen.kept.sum()) == kept
    assert bool((start[0, 0, kept:] == 0).all())


def test_an_unknown_that_vanished_is_put_back(rotor_of: Machine) -> None:
    problem = fit_of(rotor_of, noisy(rotor_of, 0.01, 0), 0.01).problem
    values = np.full((2, len(rotor_of.speeds), 2), 2e7)
    assert len(revive(problem, start_at(problem, values))) == 0
    values[1, :, 1] = 1e4
    found = problem.unknowns(revive(problem, start_at(problem, values)))[0][0].median(dim=0).values.numpy()
    np.testing.assert_allclose(found[:3], 2e7, rtol=1e-9)
    assert found[3] > 2e6
