"""A table of bearing coefficients at its own speeds, brought to those of the measurement."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from pipeline.coefficients import COEFFICIENTS
from pipeline.data.tables import read_table
from pipeline.errors import DataError
from pipeline.rotor.bearing_table import BearingTable
from pipeline.units import RAD_S_PER_RPM

_ROUNDING = 1e-9


def read_known(path: Path, nodes: Sequence[int], speeds: np.ndarray, of: Mapping[int, Sequence[str]]) -> BearingTable:
    """The coefficients that ``of`` names for each node, at ``speeds`` (S,) rad/s; the others are zero.

    Between the table's speeds: a cubic spline (linear for less than four). Raises DataError for a bearing or a
    coefficient that the table lacks, a speed that is there twice, and speeds that it does not cover.
    """
    every = [name for name in COEFFICIENTS if any(name in of[node] for node in nodes)]
    kinds = {"bearing_node": "number", "speed_rpm": "number"}
    by_all = {name: all(name in of[node] for node in nodes) for name in every}
    table = read_table(path, kinds | {name: "number" if by_all[name] else "number or blank" for name in every})
    values = np.zeros((len(nodes), len(speeds), len(COEFFICIENTS)))
    rpm = speeds / RAD_S_PER_RPM
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
        if (np.diff(given) == 0).any():
            raise DataError(f"{where} must have one row a speed, but some are there twice")
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
    if len(given) < 4:
        return np.interp(wanted, given, column)
    from scipy.interpolate import CubicSpline

    values: np.ndarray = CubicSpline(given, column)(wanted)
    return values
