"""Records that repeat a condition become one row; what contradicts that is refused."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pipeline.data.conditions import gather_conditions
from pipeline.data.dataset import Excitation, VibrationDataset
from pipeline.errors import DataError


def records() -> VibrationDataset:
    """Two records with a weight, one without, at two speeds and one channel."""
    return VibrationDataset(
        speeds=np.array([100.0, 120.0]),
        runs=("a.1", "b.1", "a.2"),
        channels=((3, 0.0),),
        displacement=np.array([[[1 + 0j, 5.0, 3.0]], [[2j, 6.0, 4j]]]),
        excitations=tuple(Excitation(run, "unbalance", 4, 2e-5, np.pi / 2) for run in ("a.1", "a.2")),
        own_frequencies=np.array([[100.0, 101.0, 102.0], [120.0, 120.0, 120.0]]),
        conditions=("a", "b", "a"),
    )


def test_means_scatter_and_weights() -> None:
    conditions = gather_conditions(records())
    assert (conditions.names, conditions.vectors) == (("a", "b"), pytest.approx(np.array([[2, 3j], [5, 6]])))
    assert (conditions.own_speeds[0], conditions.counts.tolist(), conditions.unbalance) == (
        pytest.approx([101, 120]),
        [2, 1],
        pytest.approx(np.array([[2e-5j], [0]])),
    )
    # Two records that are 2 apart have the variance 2, with the one degree of freedom that they have.
    assert conditions.record_covariance[:, 0, 0] == pytest.approx([2, 2])
    assert (conditions.at([1]).vectors, conditions.of([1]).names) == (pytest.approx(np.array([[3j], [6]])), ("b",))


def test_without_conditions_every_run_is_one() -> None:
    conditions = gather_conditions(replace(records(), conditions=None), planes=(4, 8))
    assert (conditions.names, conditions.unbalance.shape, conditions.record_covariance.any()) == (
        ("a.1", "b.1", "a.2"),
        (3, 2),
        False,
    )


def test_selected_runs_keep_their_conditions() -> None:
    assert records().of_runs(np.array([1, 2])).conditions == ("b", "a")
    assert records().fingerprint != replace(records(), conditions=None).fingerprint


@pytest.mark.parametrize(
    ("change", "planes", "words"),
    [
        ({"excitations": records().excitations[:1]}, None, "runs of one condition must have the same weights"),
        ({"excitations": (Excitation("a.1", "force", 4, 1.0, 0.0),)}, None, "has a force"),
        ({"own_frequencies": np.full((2, 3), 50.0)}, None, "turn with the rotor"),
        ({}, (8,), "at node 4"),
    ],
)
def test_what_is_no_condition_is_refused(change: dict, planes: tuple[int, ...] | None, words: str) -> None:
    with pytest.raises(DataError, match=words):
        gather_conditions(replace(records(), **change), planes)
