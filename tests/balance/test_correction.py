"""Correction weights: the exact search against every choice tried, the law of rotation, and the split of a vector."""

from __future__ import annotations

from itertools import combinations, product

import numpy as np
import pytest
from conftest import examples
from hypothesis import given
from hypothesis import strategies as st

from pipeline.balance.correction import Holes, Weight, choose_weights, split_vector
from pipeline.errors import ConfigError


def _holes(count: int, most: int, masses: tuple[float, ...] | None, first: float = 0.3) -> Holes:
    return Holes(first + 2 * np.pi * np.arange(count) / count, 0.03, masses, most)


def _every_choice(one: Holes) -> list[complex]:
    return [
        complex(sum(m * one.unit[h] for h, m in zip(at, of, strict=True)))
        for k in range(one.most + 1)
        for at in combinations(range(len(one.angles)), k)
        for of in product(one.masses, repeat=k)
    ]


def _random(seed: int, rows: int, planes: int) -> tuple[np.ndarray, np.ndarray]:
    draw = np.random.default_rng(seed)
    values = draw.normal(size=(rows, planes + 1)) + 1j * draw.normal(size=(rows, planes + 1))
    return values[:, :planes], 1e-4 * values[:, planes]


def _chosen_as_tried(
    acting: np.ndarray, there: np.ndarray, planes: list[Holes]
) -> tuple[tuple[tuple[Weight, ...], ...], np.ndarray]:
    """The weights and their unbalances, which leave as little as the best of all choices."""
    tried = [np.linalg.norm(acting @ list(c) + there) for c in product(*map(_every_choice, planes))]
    chosen, unbalance = choose_weights(acting, there, planes)
    assert np.linalg.norm(acting @ unbalance + there) == pytest.approx(min(tried), rel=1e-9)
    return chosen, unbalance


@pytest.mark.slow
@given(st.integers(0, 10_000), st.sampled_from([(6, 2, 2), (5, 3, 1), (4, 2, 2)]))
@examples(20)
def test_the_search_finds_what_trying_every_choice_finds(seed: int, size: tuple[int, int, int]) -> None:
    count, masses, most = size
    planes = [_holes(count, most, tuple(1e-3 * (1 + np.arange(masses)))), _holes(count, 1, (2e-3, 5e-3), 1.0)]
    _chosen_as_tried(*_random(seed, 5, 2), planes)


def test_three_planes_and_the_masses_of_the_answer() -> None:
    planes = [_holes(4, 1, (1e-3, 3e-3))] * 3
    chosen, unbalance = _chosen_as_tried(*_random(1, 6, 3), planes)
    for weights, one, made in zip(chosen, planes, unbalance, strict=True):
        assert all(w.mass in (1e-3, 3e-3) for w in weights)
        assert sum(w.mass * one.unit[w.hole - 1] for w in weights) == pytest.approx(made)


@given(st.integers(0, 10_000), st.integers(1, 15))
@examples(20)
def test_a_vector_turned_by_holes_turns_the_weights_by_as_many(seed: int, turn: int) -> None:
    planes = [_holes(16, 2, (1e-3, 2e-3, 3e-3))] * 2
    acting, there = _random(seed, 4, 2)
    chosen, made = choose_weights(acting, there, planes)
    turned, unbalance = choose_weights(acting, there * np.exp(2j * np.pi * turn / 16), planes)
    np.testing.assert_allclose(unbalance, made * np.exp(2j * np.pi * turn / 16), atol=1e-12)
    for before, after in zip(chosen, turned, strict=True):
        assert {((w.hole - 1 + turn) % 16 + 1, w.mass) for w in before} == {(w.hole, w.mass) for w in after}


def test_fewer_and_lighter_weights_are_preferred_where_they_make_the_same() -> None:
    """Two weights in opposite holes make what a single one makes."""
    chosen, _ = choose_weights(np.eye(1), np.array([-0.03e-3]), [_holes(4, 3, (1e-3, 2e-3), 0.0)])
    assert chosen == ((Weight(1, 1e-3),),)
    assert choose_weights(np.eye(1), np.zeros(1), [_holes(4, 3, (1e-3,))])[0] == ((),)


@given(st.floats(1e-6, 1e-2), st.floats(-10, 10), st.integers(3, 40))
def test_two_neighbouring_holes_make_any_vector(size: float, angle: float, count: int) -> None:
    one, vector = _holes(count, 2, None), size * np.exp(1j * angle)
    weights = split_vector(vector, one)
    assert sum(w.mass * one.unit[w.hole - 1] for w in weights) == pytest.approx(vector, rel=1e-7)
    assert all(w.mass > 0 for w in weights)
    assert {abs(a.hole - b.hole) for a, b in combinations(weights, 2)} <= {1, count - 1}


def test_a_vector_towards_a_hole_takes_one_weight() -> None:
    one = _holes(12, 2, None)
    (weight,) = split_vector(2e-5 * np.exp(1j * one.angles[7]), one)
    assert (weight.hole, weight.mass) == (8, pytest.approx(2e-5 / 0.03))
    assert split_vector(0j, one) == ()


@pytest.mark.slow
@given(st.integers(0, 10_000))
@examples(5)
def test_one_weight_of_any_mass_a_plane(seed: int) -> None:
    """No hole with any mass of a fine list is better, and two weights a plane leave least squares' remainder."""
    planes = [_holes(5, 1, None), _holes(4, 1, None, 0.9)]
    acting, there = _random(seed, 4, 2)

    def remain(holes: list[Holes]) -> float:
        return float(np.linalg.norm(acting @ choose_weights(acting, there, holes)[1] + there))

    found, fine = remain(planes), tuple(np.linspace(1e-4, 2e-2, 40))
    assert found <= remain([Holes(p.angles, p.radius, fine, 1) for p in planes]) * (1 + 1e-12)
    split = remain([Holes(p.angles, p.radius, None, 2) for p in planes])
    assert split == pytest.approx(np.linalg.norm(acting @ np.linalg.lstsq(acting, -there, rcond=None)[0] + there))
    assert split <= found * (1 + 1e-12)


@pytest.mark.parametrize(
    ("acting", "planes", "words"),
    [
        (np.eye(1), [_holes(72, 3, tuple(np.arange(1, 30)))], "at most 3000000 choices"),
        (np.ones((3, 2)), [_holes(4, 1, (1.0,))] * 2, "act alike"),
        (np.eye(2), [_holes(360, 1, None)] * 2, r"machine\.balance\.most=2"),
    ],
)
def test_mistakes_are_named(acting: np.ndarray, planes: list[Holes], words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        choose_weights(acting, np.ones(len(acting)), planes)
