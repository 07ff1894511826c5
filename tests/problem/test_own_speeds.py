"""Runs that turn at speeds of their own about a nominal one: one block, and the response that each has by itself."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from small_rig import AS_FOUND, CHANNELS, DIRECT, PLANES, SPEEDS, small_rig

from pipeline.problem.condition_noise import spread_conditions, to_dataset
from pipeline.rotor.bearing_table import BearingTable

WITHIN = 0.003
"""Share by which the records of a rig turn faster or slower than the nominal speed."""


def errors(departure: float, bearings: BearingTable) -> np.ndarray:
    """(C, S) share of the response by which runs in one block are off; oracle: each solved alone at its own speed."""
    rng = np.random.default_rng(31)
    own = SPEEDS * (1 + departure * rng.uniform(-1, 1, (3, 2)))
    rig = small_rig(rng, 3, drift=0.0, own_speeds=own)
    (block,) = rig.template.response.blocks
    np.testing.assert_array_equal(np.sort(block.runs), np.arange(3))
    found, apart = rig.template.response.predict(bearings, AS_FOUND), []
    for c in range(3):
        blank = spread_conditions(rig.conditions.unbalance[[c]], PLANES, own[c], CHANNELS)
        table = replace(bearings, speeds=own[c])
        alone = replace(rig.template, dataset=to_dataset(blank), known=table)
        exact = alone.response.predict(table, AS_FOUND)[..., 0]
        apart.append(np.linalg.norm(found[..., c] - exact, axis=1) / np.linalg.norm(exact, axis=1))
    return np.array(apart)


def test_runs_at_their_own_speeds_are_off_by_no_more_than_their_speeds_are() -> None:
    """First order: without departure exact, and a tenth of it leaves a tenth; within 0.3 % it is under 2 %, a few times
    the departure, as near a critical speed it must be."""
    bearings = BearingTable((0, 5), SPEEDS, np.tile(DIRECT, (2, 2, 1)))
    assert errors(0.0, bearings).max() < 1e-10
    whole, tenth = errors(WITHIN, bearings), errors(WITHIN / 10, bearings)
    assert whole.max() < 0.02
    np.testing.assert_allclose(whole, 10 * tenth, rtol=0.15)
