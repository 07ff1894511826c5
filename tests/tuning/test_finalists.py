"""Finalists: seeds decide, and the best so far leaves the default out."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from samplers import track_best

from pipeline.tuning.finalists import Finalist, TrialSummary, choose
from tuning.test_space import untuned

TIES, EQUAL = ((1e-3, 4), (1e-14, 0)), ((1e-15, 9e-16), (9e-16, 1e-15))
"""The default's loss and what is promoted; losses of two other trials that differ by rounding alone."""


def _finalist(trial: int, *losses: float) -> Any:

    return Finalist(trial, {"model.width": trial}, np.array(losses), (), (), 0.0)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("default", "others", "chosen"),
    [
        ([1.0, 1.0, 1.0], [(7, 0.4, 0.4, 0.4)], 7),
        ([1.0, 1.0, 1.0], [(7, 0.6, 0.6, 0.6)], 0),  # less than the least gain
        ([1.0, 1.0, 1.0], [(7, 0.01, 2.0, 2.0)], 0),  # one lucky seed
        ([0.3, 1.0, 1.5], [(7, 0.4, 0.4, 0.4)], 0),  # within the luck of the default's seeds
        ([1.0, 1.0, 1.0], [(7, 0.4, 0.4, 0.4), (8, 0.3, 0.3, 9.0)], 7),  # training has one seed: the unluckiest counts
        ([1.0, 1.0, 1.0], [(7, 0.4, 0.4, 0.4), (8, 0.3, 0.3, 0.3)], 8),
        ([1.0, 1.0, 1.0], [(7, math.nan, math.nan, 0.1)], 0),  # most seeds diverged
        ([math.nan, math.nan, 1.0], [(7, 3.0, 3.0, 3.0)], 7),
        ([1e-15, 1e-15, 1e-15], [(7, 1e-16, 1e-16, 1e-16)], 0),  # rounding, where the order of the trials decides
        *(([loss] * 3, [(4, *[one] * 3), (9, *[other] * 3)], trial) for loss, trial in TIES for one, other in EQUAL),
        ([1.0, 1.0, 1.0], [], 0),
    ],
)
def test_seeds_decide(default: list[float], others: list[tuple[float, ...]], chosen: int) -> None:
    """Promoted is the best of the unluckiest seeds, where the median falls enough; luck and rounding do not count."""

    finalists = [_finalist(0, *default), *(_finalist(int(number), *losses) for number, *losses in others)]
    assert choose(finalists, untuned().tuning).trial == chosen


@pytest.mark.slow
def test_the_best_so_far_leaves_the_default_out() -> None:
    """Samplers are compared by what they found themselves; rounding counts as equal, pruned trials not at all."""
    from pipeline.tuning.worker import ROUNDING

    losses = [1e-9, 1e-2, None, 1e-3, 1e-1, 1e-20]
    states = ["complete", "complete", "failed", "complete", "pruned", "complete"]
    trials = [
        TrialSummary(number=i, state=state, loss=loss, parameters={}, curve={})
        for i, (state, loss) in enumerate(zip(states, losses, strict=True))
    ]
    assert track_best(trials).tolist() == [1e-2, 1e-2, 1e-3, 1e-3, ROUNDING]
