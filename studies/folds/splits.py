"""Ways to train on some conditions of a machine and to predict others.

Legend: C conditions, S speeds.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.data.conditions import Conditions


@dataclass(frozen=True, eq=False)
class Split:
    """Conditions and speeds (indices) that a method sees, and those that it is asked for."""

    task: str
    train: np.ndarray
    test: np.ndarray
    train_speeds: np.ndarray
    test_speeds: np.ndarray


def list_splits(
    conditions: Conditions, calibration: tuple[str, ...], folds: int, heavy: float | None, seed: int
) -> list[Split]:
    """Folds by condition, the ``calibration`` alone, each configuration left out, heavy weights, the other speed.

    Conditions of the ``calibration`` are never tested; in the folds they belong to every training part. ``heavy`` is
    the sum of magnitudes in kg m from which on a condition is tested by lighter ones. ``seed`` draws the folds.
    """
    every, speeds = np.arange(len(conditions.names)), np.arange(len(conditions.speeds))
    fixed = np.array([name in calibration for name in conditions.names])
    tested = every[~fixed]

    def split(task: str, test: np.ndarray, train: np.ndarray) -> Split:
        return Split(task, train, test, speeds, speeds)

    fold = np.random.default_rng(seed).permutation(len(tested)) % folds
    drawn = [split("folds", tested[fold == k], np.setdiff1d(every, tested[fold == k])) for k in range(folds)]
    few = [split("calibration_alone", tested, every[fixed])] if fixed.any() else []
    kinds = np.array([name_configuration(u) for u in conditions.unbalance])
    apart = [
        split("configuration_left_out", tested[kinds[tested] == kind], every[kinds != kind])
        for kind in dict.fromkeys(kinds[kinds != ""])
    ]
    total = abs(conditions.unbalance).sum(1)
    limit = np.inf if heavy is None else heavy * (1 - 1e-9)
    light = [split("heavier", tested[total[tested] >= limit], every[total < limit])]
    other = [Split("other_speed", every, tested, speeds[[s]], np.delete(speeds, s)) for s in speeds if len(speeds) > 1]
    return [
        candidate
        for candidate in [*drawn, *few, *apart, *light, *other]
        if len(candidate.test) and len(candidate.train)
    ]


def name_configuration(unbalance: np.ndarray) -> str:
    """Which planes carry weights (N,), and at which angles to the first; empty for none."""
    loaded = np.flatnonzero(unbalance)
    angles = np.degrees(np.angle(unbalance[loaded] / unbalance[loaded[0]])).round() % 360 if len(loaded) else []
    return " ".join(f"plane {n + 1} at {angle:g}" for n, angle in zip(loaded, angles, strict=True))
