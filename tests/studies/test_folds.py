"""Splits hold apart what they say, scores follow their definitions, and refusals say why."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from balancing import GRAM, truth
from folds import judge_drift
from judge import judge, score
from peers import influence_peers
from scores import Forward, Inverse, floor_of_drift, score_forward, score_inverse
from splits import list_splits, name_configuration

from pipeline.balance.influence import fit_influence
from pipeline.data.conditions import Conditions
from pipeline.data.dataset import Excitation, VibrationDataset


def conditions_of(rng: np.random.Generator, n: int) -> Conditions:
    """Three that calibrate, then drawn ones."""
    machine = truth(rng)
    drawn = machine.draw(rng, n)
    drawn.unbalance[:3] = np.array([[0, 0], [48, 0], [0, 48]]) * GRAM
    drawn.displacement[:3] = machine.mean(drawn.unbalance[:3]).reshape(3, 2, 3)
    return drawn


def as_dataset(conditions: Conditions) -> VibrationDataset:
    """Two equal records a condition."""
    runs = tuple(f"{name}.{k}" for name in conditions.names for k in (1, 2))
    excitations = tuple(
        Excitation(run, "unbalance", node, float(abs(u)), float(np.angle(u)))
        for run, row in zip(runs, np.repeat(conditions.unbalance, 2, axis=0), strict=True)
        for node, u in zip(conditions.planes, row, strict=True)
        if u
    )
    displacement = np.repeat(conditions.displacement, 2, axis=0).transpose(1, 2, 0)
    names = tuple(np.repeat(np.array(conditions.names, dtype=object), 2))
    return VibrationDataset(conditions.speeds, runs, conditions.channels, displacement, excitations, conditions=names)


def test_no_split_tests_what_it_trains_or_what_calibrates() -> None:
    conditions = conditions_of(np.random.default_rng(0), 24)
    splits = list_splits(conditions, conditions.names[:3], 5, 60 * GRAM, 0)
    assert {split.task for split in splits} == {
        *("folds", "calibration_alone", "configuration_left_out", "heavier", "other_speed")
    }
    for split in splits:
        assert not set(split.test) & {0, 1, 2}
        if split.task == "other_speed":
            assert not set(split.test_speeds) & set(split.train_speeds)
        else:
            assert not set(split.test) & set(split.train)
    folds = np.concatenate([split.test for split in splits if split.task == "folds"])
    assert sorted(folds) == list(range(3, 24))
    heavier = next(split for split in splits if split.task == "heavier")
    total = abs(conditions.unbalance).sum(1)
    assert total[heavier.train].max() < 60 * GRAM <= total[heavier.test].min()


@pytest.mark.parametrize(
    ("weights", "name"),
    [([0, 0], ""), ([0, 3j], "plane 2 at 0"), ([2j, -2j], "plane 1 at 0 plane 2 at 180")],
)
def test_configurations_are_named_by_planes_and_angle_between(weights: list[complex], name: str) -> None:
    assert name_configuration(np.array(weights)) == name


def test_scores_follow_their_definitions() -> None:
    """By hand: two conditions with two records each at one speed and channel."""
    response = np.array([2, 4, 4, 4], dtype=complex).reshape(4, 1, 1)
    error = np.array([0.2, 0.4, 2, 2j], dtype=complex).reshape(4, 1, 1)
    part = Forward(("a", "a", "b", "b"), response, error, np.full((4, 1, 1), 0.5))
    scores = score_forward([part])
    assert scores["median_relative_error"] == pytest.approx(np.median([0.1, 0.5]))
    assert (scores["r2"], scores["coverage"]) == (pytest.approx(1 - (0.04 + 0.16 + 4 + 4) / 3), pytest.approx(6 / 8))
    assert score_forward([part], without=["b"])["median_relative_error"] == pytest.approx(0.1)
    true = np.array([[30e-6, 3e-6], [0, 30e-6]])
    read = np.array([[31e-6j, 9e-6], [1e-6, 27e-6]])
    whole = np.full((2, 2), 1.0)
    inverse = score_inverse([Inverse(("a", "b"), true, read, whole, np.stack([0 * whole, whole], -1), whole)])
    assert inverse["magnitude_error"] == pytest.approx(2e-6)  # planes of 6 g mm or more
    assert inverse["angle_error_deg"] == pytest.approx(45)  # planes of 24 g mm or more
    assert inverse["coverage"] == inverse["magnitude_coverage"] == 1
    assert inverse["angle_coverage"] == pytest.approx(2 / 3)


def test_the_floor_of_drift_is_what_noise_of_that_size_leaves() -> None:
    """Residuals of one size against responses of another: their ratio, larger where a calibration drifts, too."""
    rng = np.random.default_rng(1)
    conditions = conditions_of(rng, 30)
    size = np.sqrt(3) * 1e-7  # of three channels
    residual = 1e-7 * np.exp(2j * np.pi * rng.random((30, 6)))
    tested = replace(conditions.of(range(3, 30)), displacement=np.full((27, 2, 3), 1e-6 + 0j))
    baseline = np.zeros((2, 3))
    low, median, high = floor_of_drift(conditions, residual, tested, baseline, rng)["median_relative_error"]
    assert low == pytest.approx(high) == pytest.approx(median) == pytest.approx(size / np.sqrt(3) / 1e-6)
    more = floor_of_drift(conditions, residual, tested, baseline, rng, conditions.of([0, 1, 2]))
    assert more["median_relative_error"][0] > median


def test_a_drift_in_the_order_is_seen() -> None:
    rng = np.random.default_rng(4)
    conditions = truth(rng).draw(rng, 50)
    assert judge_drift(conditions, fit_influence(conditions)) > 0.01
    conditions.displacement[:] += np.linspace(0, 2e-6, 50)[:, None, None]
    assert judge_drift(conditions, fit_influence(conditions)) < 1e-6


@pytest.mark.slow
def test_methods_are_scored_or_say_why_not() -> None:
    """A perfect machine is predicted; influence coefficients refuse a speed that they have not seen."""
    rng = np.random.default_rng(2)
    machine = truth(rng)
    conditions = conditions_of(rng, 24)
    conditions = replace(conditions, displacement=machine.mean(conditions.unbalance).reshape(24, 2, 3))
    splits = list_splits(conditions, conditions.names[:3], 3, None, 0)
    kept = [split for split in splits if split.task in ("folds", "calibration_alone", "other_speed")]
    peers = influence_peers(conditions.names[:3], 0.01)
    peers.pop("influence")  # no noise to estimate
    for one in judge(as_dataset(conditions), conditions.planes, kept, peers, conditions.displacement[0]):
        if one.task == "other_speed":
            assert "at the speeds that they predict" in one.refusal
            continue
        scores = score(one)
        assert scores["forward"]["median_relative_error"] < 1e-9
        assert scores["inverse"]["magnitude_error"] < 1e-12
        assert scores["forward"]["r2"] == pytest.approx(1)
