"""Tables of bearing coefficients: ``bearing_node, speed_rpm, kxx, kxy, kyx, kyy, cxx, cxy, cyx, cyy``.

``modelled_coefficients.csv`` is the truth of modelled data, which training never reads;
``known_coefficients.csv`` has just what the experiment takes as known: a coefficient that is unknown at one bearing
is blank there.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from pipeline.coefficients import COEFFICIENTS
from pipeline.data.tables import read_table, write_table
from pipeline.data.vibration_files import to_rpm
from pipeline.errors import DataError
from pipeline.rotor.bearing_table import BearingTable


def write_coefficients(
    path: Path,
    table: BearingTable,
    of: Mapping[int, Sequence[str]] | None = None,
    deviation: np.ndarray | None = None,
) -> Path:
    """Write the coefficients that ``of`` names for each node, or all; the others stay blank. Raises StorageError.

    With standard deviations (B, S, 8) there are columns ``kxx_std`` and so on, blank where a coefficient was known.
    """
    n_bearings, n_speeds = len(table.nodes), len(table.speeds)
    columns = {
        "bearing_node": np.repeat(table.nodes, n_speeds),
        "speed_rpm": np.tile(to_rpm(table.speeds), n_bearings),
    }
    for name in COEFFICIENTS:
        written = np.array([of is None or name in of[node] for node in table.nodes])
        if written.any():
            columns[name] = np.where(written[:, None], table.coefficient(name), np.nan).ravel()
    if deviation is not None:
        columns |= {f"{name}_std": deviation[..., c].ravel() for c, name in enumerate(COEFFICIENTS)}
    return write_table(path, columns)


def read_coefficients(
    path: Path, nodes: Sequence[int], speeds: np.ndarray, of: Mapping[int, Sequence[str]] | None = None
) -> BearingTable:
    """Coefficients of the bearings at ``nodes`` and ``speeds`` (S,) rad/s: those that ``of`` names for each node, or
    all; the others are zero.

    Raises DataError where a bearing or a speed has no row.
    """
    every = [name for name in COEFFICIENTS if of is None or any(name in of[node] for node in nodes)]
    kinds = {"bearing_node": "number", "speed_rpm": "number"}
    for name in every:
        kinds[name] = "number" if of is None or all(name in of[node] for node in nodes) else "number or blank"
    table = read_table(path, kinds)
    # Speeds of two files are the same where they agree to a millionth of an rpm.
    rpm, at_node = np.round(table["speed_rpm"], 6), table["bearing_node"]
    wanted = np.round(to_rpm(speeds), 6)
    if len(set(zip(at_node.tolist(), rpm.tolist(), strict=True))) < len(rpm):
        raise DataError(f"'{path}' must have one row a bearing and speed, but some are there twice")
    values = np.zeros((len(nodes), len(speeds), len(COEFFICIENTS)))
    for b, node in enumerate(nodes):
        rows = np.flatnonzero(at_node == node)
        if not len(rows):
            has = sorted({int(n) for n in at_node})
            raise DataError(f"'{path}' must have rows for the bearing at node {node}, but it has bearings at {has}")
        names = list(COEFFICIENTS if of is None else of[node])
        given = rpm[rows]
        order = np.argsort(given)
        nearest = order[np.searchsorted(given, wanted, sorter=order).clip(max=len(given) - 1)]
        columns = np.stack([at_node, *(table[name] for name in names)])[:, rows[nearest]]
        found = np.where(given[nearest] == wanted, columns, np.nan)
        missing = np.flatnonzero(np.isnan(found).any(axis=0))
        if len(missing):
            raise DataError(
                f"'{path}' must have every speed of the data, but {len(missing)} are missing for the bearing at node "
                f"{node} "
                f"(the first: {wanted[missing[0]]:g} rpm)"
            )
        for name, of_name in zip(names, found[1:], strict=True):
            values[b, :, COEFFICIENTS.index(name)] = of_name
    return BearingTable(tuple(nodes), speeds, values)


_ROUNDING = 1e-9


def read_known(path: Path, nodes: Sequence[int], speeds: np.ndarray, of: Mapping[int, Sequence[str]]) -> BearingTable:
    """The coefficients that ``of`` names for each node, at ``speeds`` (S,) rad/s; the others are zero.

    Between the table's speeds: a cubic spline (linear for less than four). A bearing of one row without a speed has the
    same coefficients at every speed. Raises DataError for a bearing or a coefficient that the table lacks, a speed that
    is there twice, and speeds that it does not cover.
    """
    every = [name for name in COEFFICIENTS if any(name in of[node] for node in nodes)]
    by_all = {name: all(name in of[node] for node in nodes) for name in every}
    kinds = {name: "number" if by_all[name] else "number or blank" for name in every}
    table = read_table(path, {"bearing_node": "number"} | kinds, {"speed_rpm": "number or blank"})
    table.setdefault("speed_rpm", np.full(len(table["bearing_node"]), np.nan))
    values = np.zeros((len(nodes), len(speeds), len(COEFFICIENTS)))
    rpm = to_rpm(speeds)
    for b, node in enumerate(nodes):
        if not of[node]:
            continue
        rows = np.flatnonzero(table["bearing_node"] == node)
        rows = rows[np.argsort(table["speed_rpm"][rows], kind="stable")]
        where = f"'{path}', bearing at node {node},"
        if not len(rows):
            has = sorted({f"{number:g}" for number in table["bearing_node"]})
            raise DataError(f"'{path}' must have rows of the bearing at node {node}, but it has {', '.join(has)}")
        given = table["speed_rpm"][rows]
        if np.isnan(given).any() and len(rows) > 1:
            raise DataError(f"{where} must have speed_rpm in every row, or one row that holds at all speeds")
        if (np.diff(given) == 0).any():
            raise DataError(f"{where} must have one row a bearing and speed, but some are there twice")
        if rpm[0] < given[0] * (1 - _ROUNDING) or rpm[-1] > given[-1] * (1 + _ROUNDING):
            raise DataError(
                f"{where} must cover the speeds of the data ({rpm[0]:.6g} to {rpm[-1]:.6g} rpm), but it has "
                f"{given[0]:.6g} to {given[-1]:.6g} rpm: nothing is extrapolated"
            )
        for name in of[node]:
            column = table[name][rows]
            if np.isnan(column).any():
                raise DataError(f"{where} must have {name} at every speed, but some are blank")
            values[b, :, COEFFICIENTS.index(name)] = _interpolate(given, column, np.clip(rpm, given[0], given[-1]))
    return BearingTable(tuple(nodes), speeds, values)


def _interpolate(given: np.ndarray, column: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    if len(given) == 1:
        return np.full(len(wanted), column[0])
    if len(given) < 4 or np.isin(wanted, given).all():
        return np.interp(wanted, given, column)
    from scipy.interpolate import CubicSpline

    values: np.ndarray = CubicSpline(given, column)(wanted)
    return values
