"""Operating conditions beside the speed: which points share them, how an engineer writes them, and their tables.

Legend: S operating points, n rows of a table.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from pipeline.config.operating import ConditionColumn, column_of, find_columns
from pipeline.config.quantities import from_base
from pipeline.data.dataset import VibrationDataset
from pipeline.data.tables import Columns, read_table
from pipeline.errors import DataError
from pipeline.write_numbers import write_number

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
        # How many points of the same speed have lower conditions than this one.
        order = np.lexsort((*values.T[::-1], speeds))
        starts = np.r_[True, np.diff(speeds[order]) > 0]
        first = np.maximum.accumulate(np.where(starts, np.arange(len(order)), 0))
        conditions[order] = np.arange(len(order)) - first
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


def name_state(operating: Mapping[str, np.ndarray | float]) -> str:
    """Such as ``45 degC, 500 N``, or ``45 to 52 degC`` of values that differ (SI)."""
    return ", ".join(write_condition(name, values) for name, values in operating.items())


def write_condition(name: str, values: np.ndarray | float) -> str:
    """One condition in the unit that an engineer uses, such as ``45 degC``; with its name where the unit tells less."""
    written = column_of(name).unit
    unit, sign = _SHOWN.get(written, (written, written))
    ends = from_base(np.array([np.min(values), np.max(values)], dtype=float), unit)
    text = f"{' to '.join(dict.fromkeys(f'{write_number(end)}' for end in ends))} {sign}"
    if name.rpartition("_")[2] in _PLAIN:
        return text
    return f"{name.removesuffix(f'_{written}').replace('_', ' ')} {text}"


# --- points: in tables, in their order, joined where they are the same ----------------------------


Operating = Mapping[str, np.ndarray]
"""Name of a condition -> its value at each point, SI."""


def read_with_conditions(
    path: Path, columns: Mapping[str, str], optional: Mapping[str, str]
) -> tuple[Columns, dict[str, np.ndarray]]:
    """A table as :func:`pipeline.data.tables.read_table`, and its operating conditions (n,), SI.

    Raises DataError also for a condition without a unit, with one of another dimension, below absolute zero, or blank
    in some rows.
    """
    conditions: dict[str, ConditionColumn] = {}

    def list_further(names: list[str]) -> dict[str, str]:
        try:
            conditions.update(find_columns(names, (*columns, *optional)))
        except ValueError as error:
            raise DataError(f"'{path}' {error}") from None
        return dict(optional) | {condition.column: "number or blank" for condition in conditions.values()}

    table = read_table(path, columns, list_further)
    operating = {name: condition.to_si(table.pop(condition.column)) for name, condition in conditions.items()}
    for name, condition in conditions.items():
        cold = np.flatnonzero(operating[name] <= 0)
        if len(cold) and column_of(name).unit in ("degC", "degF"):
            raise DataError(
                f"'{path}' must have temperatures above absolute zero in the column '{condition.column}', but row "
                f"{cold[0] + 1} has {condition.from_si(operating[name][cold[:1]])[0]:g}"
            )
    for name, values in operating.items():
        blank = np.flatnonzero(np.isnan(values))
        if len(blank):
            row = int(blank[0])
            which = [f"run '{table['run'][row]}'"] if "run" in table else []
            which += [f"{table['speed_rpm'][row]:g} rpm"] if "speed_rpm" in table else []
            raise DataError(
                f"'{path}' must have {name} in every row, but row {row + 1} has none ({', '.join(which)}; {len(blank)} "
                "rows in all): complete it, or leave the column out"
            )
    return table, operating


def list_columns(operating: Operating) -> dict[str, np.ndarray]:
    """The columns (S,) that a table has the conditions of its points in, by name."""
    columns = {name: column_of(name) for name in operating}
    return {columns[name].column: columns[name].from_si(values) for name, values in operating.items()}


def describe_point(operating: Operating, point: int, before: str = "") -> str:
    """The conditions of a point as people read them, ``before`` in front; no words where there are none."""
    return before + name_state({name: values[point] for name, values in operating.items()}) if operating else ""


def describe_points(dataset: VibrationDataset) -> str:
    """How many speeds there are, and where there are operating conditions how many points, and their ranges."""
    count = len(np.unique(dataset.speeds))
    if not dataset.operating:
        return f"{count} speeds"
    ranges = (f"{name} {write_condition(name, values)}" for name, values in dataset.operating.items())
    return f"{len(dataset.speeds)} operating points ({count} speeds; {'; '.join(ranges)})"


def find_points(
    speeds: np.ndarray, operating: Operating, same: Mapping[str, float] | None = None
) -> tuple[np.ndarray, dict[str, np.ndarray], np.ndarray]:
    """The different points (S,) of rows (n,): speeds, conditions, and the point of each row (n,).

    Ordered by the conditions, then by the speed. Conditions that differ by no more than ``same`` says (SI, by name) are
    one state, with their mean.
    """
    values = [join(operating[name], (same or {}).get(name, 0.0)) for name in operating]
    points, at = np.unique(np.stack([*values, speeds], axis=1), axis=0, return_inverse=True)
    return points[:, -1], dict(zip(operating, points.T[:-1], strict=True)), at.ravel()


def join(values: np.ndarray, within: float, share: float = 0.0) -> np.ndarray:
    """Values (n,), in their place the means of groups that span no more than ``within``, and than the ``share`` of the
    lowest beside it; the lowest begins a group."""
    different, at = np.unique(values, return_inverse=True)
    group, first = np.zeros(len(different), dtype=int), different[0]
    for i in range(1, len(different)):
        begins = different[i] - first > within + share * first
        group[i], first = group[i - 1] + begins, different[i] if begins else first
    # Each reading counts once, in any order of the rows.
    return np.asarray((np.bincount(group, different) / np.bincount(group))[group][at.ravel()])


def spread_states(
    speeds: np.ndarray, states: Mapping[str, Sequence[float]]
) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """All ``speeds`` at every combination of the ``states`` of each condition: speeds (S,) and conditions (S,)."""
    grid = list(itertools.product(*(sorted(values) for values in states.values())))
    conditions = {name: np.repeat([state[c] for state in grid], len(speeds)) for c, name in enumerate(states)}
    return np.tile(speeds, len(grid)), conditions


def space_evenly(count: int, most: int) -> np.ndarray:
    """At most so many indices below the ``count``, ascending, the first and the last among them."""
    return np.unique(np.linspace(0, count - 1, min(count, most)).round().astype(int))


def group_rows(keys: np.ndarray) -> list[np.ndarray]:
    """The indices of equal rows of ``keys`` (n, k), the group of the first row first."""
    _, of = np.unique(keys, axis=0, return_inverse=True)
    groups = [np.flatnonzero(of.ravel() == i) for i in range(of.max() + 1)]
    return sorted(groups, key=lambda group: int(group[0]))
