"""Operating conditions beside the speed: which points share them, and how an engineer writes them.

Legend: S operating points.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from pipeline.config.operating import column_of
from pipeline.config.quantities import from_base

_SHOWN = {"Pa": ("bar", "bar"), "percent": ("percent", "%")}
"""By the unit of files: the one that is shown, and how it is written, where these differ."""
_PLAIN = ("temperature", "pressure", "load")
"""Conditions that their unit tells, by the last word of their names: ``45 degC``."""


def split_states(speeds: np.ndarray, operating: Mapping[str, np.ndarray]) -> list[tuple[str, np.ndarray]]:
    """Lines over the speed: a label such as ``45 degC``, and the indices of its points, by ascending speed.

    Points of equal conditions belong together; without conditions all do, and the label is empty. Conditions that
    change from point to point, as in a run-up whose oil warms, make a line too (``45 to 52 degC``): where a speed comes
    more than once, each time on a line of its own, the lowest condition on the first. No line has a speed twice.

    Args:
        speeds: (S,) rad/s.
        operating: name -> (S,) SI, temperatures in K.
    """
    if not operating:
        return [("", np.arange(len(speeds)))]
    values = np.stack([np.asarray(level, dtype=float) for level in operating.values()], axis=1)  # (S, conditions)
    unique, conditions = np.unique(values, axis=0, return_inverse=True)
    conditions = conditions.ravel()
    repeated = any(len(np.unique(speeds[conditions == i])) < (conditions == i).sum() for i in range(len(unique)))
    if repeated or np.bincount(conditions).min() < 2:
        conditions = _rank_conditions(speeds, values)
    states = []
    for i in range(conditions.max() + 1):
        points = np.flatnonzero(conditions == i)
        points = points[np.argsort(speeds[points], kind="stable")]
        states.append((name_state({name: levels[points] for name, levels in operating.items()}), points))
    return states


def find_nearest(
    speeds: np.ndarray, operating: Mapping[str, np.ndarray], wanted: Mapping[str, float]
) -> tuple[str, np.ndarray]:
    """The line of :func:`split_states` whose conditions lie nearest to those that are ``wanted`` (SI)."""
    states = split_states(speeds, operating)
    away = np.zeros(len(states))
    for name, values in operating.items():
        span = float(np.ptp(values)) or 1.0
        away += [abs(float(np.mean(values[points])) - wanted[name]) / span for _, points in states]
    return states[int(np.argmin(away))]


def _rank_conditions(speeds: np.ndarray, values: np.ndarray) -> np.ndarray:
    """(S,) how many points of the same speed have lower conditions than this one."""
    order = np.lexsort((*values.T[::-1], speeds))
    starts = np.r_[True, np.diff(speeds[order]) > 0]
    first = np.maximum.accumulate(np.where(starts, np.arange(len(order)), 0))
    rank = np.empty(len(order), dtype=int)
    rank[order] = np.arange(len(order)) - first
    return rank


def name_state(operating: Mapping[str, np.ndarray | float]) -> str:
    """Such as ``45 degC, 500 N``, or ``45 to 52 degC`` of values that differ (SI)."""
    return ", ".join(write_condition(name, values) for name, values in operating.items())


def write_condition(name: str, values: np.ndarray | float) -> str:
    """One condition in the unit that an engineer uses, such as ``45 degC``; with its name where the unit tells less."""
    written = column_of(name).unit
    unit, sign = _SHOWN.get(written, (written, written))
    ends = from_base(np.array([np.min(values), np.max(values)], dtype=float), unit)
    text = f"{' to '.join(dict.fromkeys(f'{end:.4g}' for end in ends))} {sign}"
    if name.rpartition("_")[2] in _PLAIN:
        return text
    return f"{name.removesuffix(f'_{written}').replace('_', ' ')} {text}"
