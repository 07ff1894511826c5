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
    import pandas as pd

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
    return write_table(path, pd.DataFrame(columns))


def read_coefficients(
    path: Path, nodes: Sequence[int], speeds: np.ndarray, of: Mapping[int, Sequence[str]] | None = None
) -> BearingTable:
    """Coefficients of the bearings at ``nodes`` and ``speeds`` (S,) rad/s: those that ``of`` names for each node, or
    all; the others are zero.

    Raises DataError where a bearing or a speed has no row.
    """
    every = [name for name in COEFFICIENTS if of is None or any(name in of[node] for node in nodes)]
    kinds = {"bearing_node": "number", "speed_rpm": "number"}
    table = read_table(
        path, kinds | {name: "number" if _by_all(name, nodes, of) else "number or blank" for name in every}
    )
    # Speeds of two files are the same where they agree to a millionth of an rpm.
    table["speed_rpm"] = table["speed_rpm"].round(6)
    wanted = np.round(to_rpm(speeds), 6)
    if table.duplicated(["bearing_node", "speed_rpm"]).any():
        raise DataError(f"'{path}' must have one row a bearing and speed, but some are there twice")
    values = np.zeros((len(nodes), len(speeds), len(COEFFICIENTS)))
    for b, node in enumerate(nodes):
        rows = table[table["bearing_node"] == node].set_index("speed_rpm")
        if rows.empty:
            has = sorted({int(n) for n in table["bearing_node"]})
            raise DataError(f"'{path}' must have rows for the bearing at node {node}, but it has bearings at {has}")
        found = rows.reindex(wanted)
        names = list(COEFFICIENTS if of is None else of[node])
        missing: np.ndarray = np.flatnonzero(found[["bearing_node", *names]].isna().any(axis=1).to_numpy())
        if len(missing):
            raise DataError(
                f"'{path}' must have every speed of the data, but {len(missing)} are missing for the bearing at node "
                f"{node} "
                f"(the first: {wanted[missing[0]]:g} rpm)"
            )
        for name in names:
            values[b, :, COEFFICIENTS.index(name)] = found[name].to_numpy()
    return BearingTable(tuple(nodes), speeds, values)


def _by_all(name: str, nodes: Sequence[int], of: Mapping[int, Sequence[str]] | None) -> bool:
    return of is None or all(name in of[node] for node in nodes)
