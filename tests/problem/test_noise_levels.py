"""Levels of noise against what data were drawn with, one-way analysis of variance, and a single bad condition."""

from __future__ import annotations

import numpy as np
import pytest
from balancing import circular

from pipeline.data.conditions import Conditions
from pipeline.errors import IdentifiabilityError
from pipeline.problem.condition_noise import condition_noise
from pipeline.problem.noise_levels import NoiseLevels, estimate_noise_levels, shrinkage_share, spread_blocks

SPEEDS, CHANNELS = 2, 2


def square(rng: np.random.Generator, size: int) -> np.ndarray:
    """A root of a covariance with strong correlations."""
    return 0.3 * np.eye(size) + circular(rng, size, 1) @ circular(rng, 1, size)


def draw(
    rng: np.random.Generator, n: int, counts: np.ndarray, level: np.ndarray, record: np.ndarray
) -> tuple[Conditions, np.ndarray]:
    """Conditions of a baseline and one plane; the roots (D, D) of the level and (S, P, P) of the records are given."""
    size = SPEEDS * CHANNELS
    design = np.column_stack([np.ones(n), circular(rng, n)])
    mean = design @ circular(rng, 2, size) + circular(rng, n, size) @ level.T
    records, scatter, freedom = [], np.zeros_like(record), 0
    for c, count in enumerate(counts):
        noise = np.einsum("spq,nsq->nsp", record, circular(rng, count, SPEEDS, CHANNELS))
        own = mean[c].reshape(SPEEDS, CHANNELS) + noise
        records.append(own.mean(0))
        apart = own - own.mean(0)
        scatter = scatter + np.einsum("nsp,nsq->spq", apart, apart.conj())
        freedom += count - 1
    conditions = Conditions(
        names=tuple(f"C{c}" for c in range(n)),
        speeds=np.array([100.0, 120.0]),
        own_speeds=np.tile([100.0, 120.0], (n, 1)),
        displacement=np.array(records),
        counts=counts,
        channels=((2, 0.0), (2, 90.0)),
        planes=(5,),
        unbalance=design[:, 1:],
        record_covariance=scatter / max(freedom, 1),
    )
    return conditions, design


@pytest.mark.parametrize("counts", [(3,), (1, 2, 5)], ids=["equal", "unequal"])
@pytest.mark.parametrize("robust", [False, True], ids=["gaussian", "student"])
def test_levels_of_clean_data_are_those_that_they_were_drawn_with(counts: tuple[int, ...], robust: bool) -> None:
    """On average over data sets, in every entry: neither the weights nor the EM leave a bias."""
    rng = np.random.default_rng(0)
    level, record = square(rng, 4), 0.3 * np.stack([square(rng, 2), square(rng, 2)])
    truth = level @ level.conj().T
    found = []
    for _ in range(12):
        conditions, design = draw(rng, 90, np.resize(counts, 90), level, record)
        found.append(estimate_noise_levels(conditions, design, robust=robust)[0].condition)
    size = np.sqrt(np.outer(np.diag(truth), np.diag(truth)).real)
    assert abs(np.mean(found, axis=0) - truth).max() < 0.1 * size.max()
    # The trace has the least scatter: weights without their correction would leave it a tenth too small or more.
    assert np.trace(np.mean(found, axis=0)).real == pytest.approx(np.trace(truth).real, rel=0.07)


def test_one_way_analysis_of_variance_is_the_closed_form() -> None:
    """One channel, a mean alone: between less within over n, as in every textbook."""
    rng = np.random.default_rng(1)
    n, count = 12, 4
    records = (circular(rng, n, 1) + 0.4 * circular(rng, n, count))[..., None, None]
    mean = records.mean(1)
    within = (abs(records - mean[:, None]) ** 2).sum() / (n * (count - 1))
    between = count * (abs(mean - mean.mean(0)) ** 2).sum() / (n - 1)
    conditions = Conditions(
        names=tuple("abcdefghijkl"),
        speeds=np.array([100.0]),
        own_speeds=np.full((n, 1), 100.0),
        displacement=mean,
        counts=np.full(n, count),
        channels=((2, 0.0),),
        planes=(),
        unbalance=np.zeros((n, 0)),
        record_covariance=np.array([[[within]]]),
    )
    levels, _ = estimate_noise_levels(conditions, np.ones((n, 1)), robust=False)
    assert (levels.condition[0, 0], levels.freedom) == (pytest.approx((between - within) / count, rel=1e-12), n - 1)


def test_a_bad_condition_moves_the_levels_little() -> None:
    """Its weight is small, and the level is near that without it; unweighted it is many times larger."""
    rng = np.random.default_rng(2)
    conditions, design = draw(rng, 60, np.full(60, 3), square(rng, 4), 0.1 * np.stack([np.eye(2), np.eye(2)]))
    clean = np.trace(estimate_noise_levels(conditions, design)[0].condition).real
    conditions.displacement[7] += 60.0
    levels, weights = estimate_noise_levels(conditions, design)
    assert np.argmin(weights) == 7
    assert weights[7] < 0.02
    assert np.trace(levels.condition).real == pytest.approx(clean, rel=0.25)
    assert np.trace(estimate_noise_levels(conditions, design, robust=False)[0].condition).real > 10 * clean


def test_few_conditions_shrink_towards_the_diagonal_and_none_is_refused() -> None:
    """The share follows its law, the matrix stays regular; of too few, the path of a configuration refuses them too."""
    rng = np.random.default_rng(3)
    conditions, design = draw(rng, 6, np.full(6, 3), square(rng, 4), 0.01 * np.stack([np.eye(2)] * 2))
    levels, _ = estimate_noise_levels(conditions, design)
    assert np.linalg.eigvalsh(levels.condition).min() > 0
    assert shrinkage_share(np.array([[2.0, 1.0], [1.0, 2.0]]), 8.0) == pytest.approx(1 / 8 / 0.25)
    few = conditions.of([0, 1])
    with pytest.raises(IdentifiabilityError, match="more conditions than the 2 columns"):
        estimate_noise_levels(few, design[:2])
    with pytest.raises(IdentifiabilityError, match=r"more conditions than the 3 columns.*: measure more conditions$"):
        condition_noise(few)


def test_the_covariance_of_means_has_both_levels() -> None:
    record = np.stack([np.diag([1.0, 2.0]), np.diag([3.0, 4.0])]).astype(complex)
    two = NoiseLevels(record, np.eye(4, dtype=complex), 10.0).covariance(np.array([1, 4]))
    assert np.diag(two[0]).real == pytest.approx([2, 3, 4, 5])
    assert np.diag(two[1]).real == pytest.approx([1.25, 1.5, 1.75, 2.0])
    assert spread_blocks(record)[0, 2] == 0
