"""Tables of bearing coefficients: ``bearing_node, speed_rpm, kxx, kxy, kyx, kyy, cxx, cxy, cyx, cyy``.

Where there are operating conditions, their columns follow the speed (:mod:`pipeline.config.operating`).
``modelled_coefficients.csv`` is the truth of modelled data, which training never reads;
``known_coefficients.csv`` has just what the experiment takes as known: a coefficient that is unknown at one bearing
is blank there.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from pipeline.coefficients import COEFFICIENTS
from pipeline.data.operating import (
    Operating,
    describe_point,
    list_columns,
    read_with_conditions,
)
from pipeline.data.tables import Columns, write_table
from pipeline.data.vibration_files import to_rpm
from pipeline.errors import DataError
from pipeline.rotor.bearing_table import BearingTable
from pipeline.write_numbers import write_number


def write_coefficients(path: Path, table: BearingTable, of: Mapping[int, Sequence[str]] | None = None) -> Path:
    """Write the coefficients that ``of`` names for each node, or all; the others stay blank. Raises StorageError."""
    return write_table(path, tabulate_coefficients(table, of))


def tabulate_coefficients(table: BearingTable, named: Mapping[int, Sequence[str]] | None = None) -> Columns:
    """The columns of :func:`write_coefficients`, bearing by bearing.

    Where standard deviations are stated there are columns ``kxx_std`` and so on, blank where a coefficient was known.
    """
    n_bearings, n_speeds = len(table.nodes), len(table.speeds)
    columns = {
        "bearing_node": np.repeat(table.nodes, n_speeds),
        "speed_rpm": np.tile(to_rpm(table.speeds), n_bearings),
        **{name: np.tile(values, n_bearings) for name, values in list_columns(table.operating).items()},
    }
    named = named or dict.fromkeys(table.nodes, COEFFICIENTS)
    for name in _list_kinds(named, table.nodes):
        written = np.array([name in named[node] for node in table.nodes])
        columns[name] = np.where(written[:, None], table.coefficient(name), np.nan).ravel()
    if table.deviation is not None:
        columns |= {f"{name}_std": table.deviation[..., c].ravel() for c, name in enumerate(COEFFICIENTS)}
    return columns


def read_coefficients(
    path: Path,
    nodes: Sequence[int],
    speeds: np.ndarray,
    of: Mapping[int, Sequence[str]] | None = None,
    operating: Operating | None = None,
    between: bool = False,
) -> BearingTable:
    """Coefficients of the bearings at ``nodes``, ``speeds`` (S,) rad/s and ``operating`` conditions (S,) each: those
    that ``of`` names for each node, or all; the others are zero.

    The table must have every speed. With ``between`` a cubic spline goes through its speeds (straight lines through
    less than four), and a bearing of one row without a speed has the same coefficients at every speed. A table without
    operating conditions holds at all of them. Raises DataError for a bearing or a coefficient that the table lacks, a
    speed that is there twice, and speeds and conditions that it does not cover.
    """
    operating, of = operating or {}, of or dict.fromkeys(nodes, COEFFICIENTS)
    kinds = {"bearing_node": "number"} | ({} if between else {"speed_rpm": "number"}) | _list_kinds(of, nodes)
    table, states = _read_states(path, kinds, {"speed_rpm": "number or blank"} if between else {}, operating)
    table.setdefault("speed_rpm", np.full(len(table["bearing_node"]), np.nan))
    values = np.zeros((len(nodes), len(speeds), len(COEFFICIENTS)))
    used = {name: operating[name] for name in states}
    given, wanted = _make_keys(len(table["bearing_node"]), states), _make_keys(len(speeds), used)
    for b, node in enumerate(nodes):
        if not of[node]:
            continue
        own = np.flatnonzero(table["bearing_node"] == node)
        if not len(own):
            has = sorted({f"{number:g}" for number in table["bearing_node"]})
            raise DataError(f"'{path}' must have rows of the bearing at node {node}, but it has {', '.join(has)}")
        for state in np.unique(wanted, axis=0):
            at = np.flatnonzero((wanted == state).all(axis=1))
            rows = own[(given[own] == state).all(axis=1)]
            where = f"'{path}', bearing at node {node}{describe_point(used, at[0], ', ')},"
            if between and not len(rows):
                raise DataError(f"{where} must have rows at the conditions of the data, but it has none: add them")
            columns = {name: table[name][rows] for name in ("speed_rpm", *of[node])}
            known = _interpolate(columns, to_rpm(speeds[at]), where, between)
            for name, column in known.items():
                values[b, at, COEFFICIENTS.index(name)] = column
    return BearingTable(tuple(nodes), speeds, values, operating)


def _list_kinds(of: Mapping[int, Sequence[str]], nodes: Sequence[int]) -> dict[str, str]:
    """The columns of the coefficients that ``of`` names at some node: one that others lack may be blank."""
    return {
        name: "number" if all(name in of[node] for node in nodes) else "number or blank"
        for name in COEFFICIENTS
        if any(name in of[node] for node in nodes)
    }


def _read_states(
    path: Path, kinds: Mapping[str, str], optional: Mapping[str, str], operating: Operating
) -> tuple[Columns, dict[str, np.ndarray]]:
    """The table, and its conditions (n,); a table without any holds at all of them.

    Raises DataError for conditions that the data lack, for some that the table alone lacks, and for blanks.
    """
    table, states = read_with_conditions(path, kinds, optional)
    strange = [name for name in states if name not in operating]
    if strange:
        raise DataError(
            f"'{path}' must have the operating conditions of the vibration, but it has {strange[0]}, which that lacks: "
            "leave the column out, and the rows of all but one value"
        )
    lacking = [name for name in operating if states and name not in states]
    if lacking:
        raise DataError(
            f"'{path}' must have every operating condition of the vibration or none, but it has {', '.join(states)} "
            f"and not {lacking[0]}: add it"
        )
    return table, states


def _make_keys(count: int, states: Operating) -> np.ndarray:
    """(n, 1 + conditions) what tells conditions apart: they are the same where nine digits agree."""
    digits = ([float(f"{value:.9g}") for value in values] for values in states.values())
    return np.stack([np.zeros(count), *map(np.array, digits)], axis=1)


def _interpolate(
    table: Columns, rpm: np.ndarray, where: str, between: bool, rounding: float = 1e-9, same: int = 6
) -> Columns:
    """The coefficients of one bearing at one state, at speeds in rpm: those of the table, which are the ``same`` where
    so many decimals agree, or ``between`` them; ends may be missed by the share ``rounding``."""
    order = np.argsort(table["speed_rpm"], kind="stable")
    given = table["speed_rpm"][order]
    if np.isnan(given).any() and len(given) > 1:
        raise DataError(f"{where} must have speed_rpm in every row, or one row that holds at all speeds")
    if (np.diff(given) == 0).any():
        raise DataError(f"{where} must have one row a bearing and speed, but some are there twice")
    if not between:
        given, rpm = np.round(given, same), np.round(rpm, same)
        if len(missing := np.flatnonzero(~np.isin(rpm, given))):
            raise DataError(
                f"{where} must have every speed of the data, but {len(missing)} are missing (the first: "
                f"{rpm[missing[0]]:g} rpm)"
            )
    if rpm.min() < given[0] * (1 - rounding) or rpm.max() > given[-1] * (1 + rounding):
        raise DataError(
            f"{where} must cover the speeds of the data ({write_number(rpm.min(), digits=6)} to "
            f"{write_number(rpm.max(), digits=6)} rpm), but it has "
            f"{write_number(given[0], digits=6)} to {write_number(given[-1], digits=6)} rpm: nothing is extrapolated"
        )
    columns: Columns = {}
    for name in table.keys() - {"speed_rpm"}:
        column = table[name][order]
        if np.isnan(column).any():
            raise DataError(f"{where} must have {name} at every speed, but some are blank")
        columns[name] = interpolate(given, column, np.clip(rpm, given[0], given[-1]))
    return columns


def interpolate(given: np.ndarray, column: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """The ``column`` (n,) at ``given`` speeds (n,), ascending, at those that are ``wanted`` (m,), by a cubic spline; of
    less than four by straight lines."""
    if len(given) < 4 or np.isin(wanted, given).all():
        return np.interp(wanted, given, column)
    from scipy.interpolate import CubicSpline

    return np.asarray(CubicSpline(given, column)(wanted))
