"""Ties go by name, whatever the last bits are."""

from __future__ import annotations

import math

import numpy as np
import pytest

from pipeline.problem.ranking import find_least, rank, rank_indices


def test_the_largest_comes_first_and_ties_go_by_name() -> None:
    """Also where no size is positive, and where one is infinite or no number."""
    assert rank({"b": 1.0, "a": 1.0, "c": 2.0}) == ["c", "a", "b"]
    assert rank({"b": -1.0, "a": -1.0 - 1e-9, "c": -2.0}) == ["a", "b", "c"]
    assert rank({"b": math.nan, "a": 1.0, "c": math.inf, "d": math.inf}) == ["c", "d", "a", "b"]
    assert find_least({"b": 1.0, "a": 1.0, "c": 2.0}) == "a"
    assert rank({}) == []


@pytest.mark.parametrize("seed", range(5))
def test_rounding_does_not_change_the_order(seed: int) -> None:
    """Sizes of which many tie, each moved by some last bits."""
    rng = np.random.default_rng(seed)
    sizes = rng.integers(1, 5, size=12).astype(float)
    moved = sizes * (1 + 1e-14 * rng.normal(size=12))
    assert rank_indices(moved) == rank_indices(sizes) == sorted(range(12), key=lambda i: (-sizes[i], i))


def test_of_equal_minima_the_first_goes_on() -> None:
    """Starts that ended in one valley differ by rounding; those of other valleys follow, the best first."""
    from pipeline.problem.ranking import find_distinct

    for tie in (1e-9, -1e-9):
        assert find_distinct([3.0, 1.0, 1.0 + tie, 2.0, 1.005]) == [1, 3, 0]
    assert find_distinct([1.00001, 1.0]) == [1], "the better of two that differ"
    assert find_distinct([float("inf"), 1.0]) == [1, 0]
