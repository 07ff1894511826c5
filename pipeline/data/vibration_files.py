"""The two files that training reads: ``vibration.parquet`` (or .csv) and ``excitation.csv``.

Vibration: ``run, speed_rpm, node, direction, amplitude_m, phase_deg``, one row a measured displacement;
amplitude zero-to-peak, phase of Q in q(t) = Re(Q e^{jwt}). A column ``frequency_hz`` gives the excitation frequency
where it is not the rotor speed's; without it, and where it is blank, the response is synchronous.
Excitation: ``run, kind, node, magnitude, phase_deg, whirl``; kind ``unbalance`` (kg m) or ``force`` (N).
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from pipeline.data.dataset import DIRECTIONS, Excitation, VibrationDataset
from pipeline.data.tables import read_table, rotor_of, write_table
from pipeline.errors import DataError
from pipeline.rotor.model import RotorModel
from pipeline.units import RAD_S_PER_RPM

if TYPE_CHECKING:
    import pandas as pd

_VIBRATION = {
    "run": "text",
    "speed_rpm": "number",
    "node": "number",
    "direction": "text",
    "amplitude_m": "number",
    "phase_deg": "number",
}
_FREQUENCY = "frequency_hz"
_EXCITATION = {
    "run": "text",
    "kind": "text",
    "node": "number",
    "magnitude": "number",
    "phase_deg": "number",
    "whirl": "text",
}


def to_rpm(speeds: np.ndarray) -> np.ndarray:
    """rad/s to rpm, rounded so that 100 rpm is written as 100."""
    return np.round(speeds / RAD_S_PER_RPM, 9)


def write_vibration(path: Path, dataset: VibrationDataset, rotor: RotorModel, origin: str | None = None) -> Path:
    """Write the displacements, with the rotor's fingerprint and generated data's ``origin``. Raises StorageError."""
    import pandas as pd

    n_speeds, n_channels, n_runs = dataset.displacement.shape
    flat = dataset.displacement.transpose(2, 0, 1).ravel()  # run slowest, then speed, then channel
    nodes = np.array([node for node, _ in dataset.channels])
    directions = np.array([DIRECTIONS[direction] for _, direction in dataset.channels])
    columns = {
        "run": np.repeat(np.array(dataset.runs, dtype=object), n_speeds * n_channels),
        "speed_rpm": np.tile(np.repeat(to_rpm(dataset.speeds), n_channels), n_runs),
        "node": np.tile(nodes, n_speeds * n_runs),
        "direction": np.tile(directions, n_speeds * n_runs),
        "amplitude_m": np.abs(flat),
        "phase_deg": np.degrees(np.angle(flat)),
    }
    if dataset.own_frequencies is not None:
        columns[_FREQUENCY] = np.repeat(dataset.own_frequencies.T.ravel() / (2 * np.pi), n_channels)
    return write_table(path, pd.DataFrame(columns), rotor.fingerprint, origin)


def write_excitation(path: Path, dataset: VibrationDataset) -> Path:
    """Write what excited the runs. Raises StorageError."""
    import pandas as pd

    forces = pd.DataFrame(
        {
            "run": [e.run for e in dataset.excitations],
            "kind": [e.kind for e in dataset.excitations],
            "node": [e.node for e in dataset.excitations],
            "magnitude": [e.magnitude for e in dataset.excitations],
            "phase_deg": [float(np.degrees(e.phase)) for e in dataset.excitations],
            "whirl": [e.whirl for e in dataset.excitations],
        }
    )
    return write_table(path, forces)


def read_dataset(vibration: Path, excitation: Path, rotor: RotorModel) -> VibrationDataset:
    """Read both files and hold them against each other and against the rotor.

    Raises DataError with the law that a file breaks; see :func:`pipeline.data.tables.read_table` for those of
    the tables themselves.
    """
    table = read_table(vibration, _VIBRATION, {_FREQUENCY: "number or blank"})
    made_for = rotor_of(vibration)
    if made_for is not None and made_for != rotor.fingerprint:
        raise DataError(
            f"'{vibration}' must have been made for this rotor ({rotor.fingerprint}), but it was made for another "
            f"({made_for}): "
            "make it again with stage=generate, or give the rotor that belongs to it"
        )
    excitations = _excitations(read_table(excitation, _EXCITATION), excitation, rotor)
    nodes = _nodes(table, vibration, rotor)
    _check_words(table["direction"], DIRECTIONS, vibration, "direction")
    if (table["speed_rpm"] <= 0).any():
        raise DataError(f"'{vibration}' must have speeds above zero, but got {table['speed_rpm'].min():g} rpm")
    strange = table["amplitude_m"][(table["amplitude_m"] < 0) | (table["amplitude_m"] > 1)]
    if len(strange):
        raise DataError(f"'{vibration}' must have amplitudes of zero or more, up to 1 m, but got {strange.iloc[0]:g} m")
    for run, rpm in table.groupby("run", sort=False)["speed_rpm"]:
        if (np.diff(rpm.to_numpy()) < 0).any():
            raise DataError(
                f"'{vibration}' must have ascending speeds in every run, but run '{run}' is not sorted by speed_rpm"
            )
    runs = tuple(dict.fromkeys(table["run"]))
    acting = {e.run for e in excitations}
    for run in runs:
        if run not in acting:
            raise DataError(f"'{excitation}' must have a row for every run, but run '{run}' of '{vibration}' has none")
    for run in sorted(acting - set(runs)):
        raise DataError(f"'{vibration}' must have data of every run, but run '{run}' of '{excitation}' has none")
    dataset = _assemble(table.assign(node=nodes), vibration, runs, excitations)
    if dataset.own_frequencies is not None:
        _check_synchronous(dataset, vibration)
    return dataset


def _assemble(
    table: pd.DataFrame, path: Path, runs: tuple[str, ...], excitations: tuple[Excitation, ...]
) -> VibrationDataset:
    rpm = np.unique(table["speed_rpm"])
    pairs = sorted({(int(n), DIRECTIONS.index(d)) for n, d in zip(table["node"], table["direction"], strict=True)})
    place = {pair: i for i, pair in enumerate(pairs)}
    at_channel = [place[int(n), DIRECTIONS.index(d)] for n, d in zip(table["node"], table["direction"], strict=True)]
    at_run = table["run"].map({run: i for i, run in enumerate(runs)}).to_numpy()
    at_speed = np.searchsorted(rpm, table["speed_rpm"])
    displacement = np.full((len(rpm), len(pairs), len(runs)), np.nan, dtype=complex)
    values = table["amplitude_m"].to_numpy() * np.exp(1j * np.radians(table["phase_deg"].to_numpy()))
    displacement[at_speed, at_channel, at_run] = values
    expected = displacement.size
    if len(table) > expected or table.duplicated(["run", "speed_rpm", "node", "direction"]).any():
        raise DataError(f"'{path}' must have one row a run, speed, node and direction, but some are there twice")
    missing = np.argwhere(np.isnan(displacement))
    if len(missing):
        s, p, r = missing[0]
        raise DataError(
            f"'{path}' must have every channel at every speed of every run, but {len(missing)} of {expected} are "
            "missing "
            f"(the first: run '{runs[r]}', {rpm[s]:g} rpm, node {pairs[p][0]} {DIRECTIONS[pairs[p][1]]})"
        )
    speeds = rpm * RAD_S_PER_RPM
    own = None
    if _FREQUENCY in table and table[_FREQUENCY].notna().any():
        own = _frequencies(table, path, speeds, runs, at_speed, at_run)
    return VibrationDataset(speeds, runs, tuple(pairs), displacement, excitations, own)


def _frequencies(
    table: pd.DataFrame, path: Path, speeds: np.ndarray, runs: tuple[str, ...], at_speed: np.ndarray, at_run: np.ndarray
) -> np.ndarray:
    """(S, R) rad/s."""
    given = 2 * np.pi * table[_FREQUENCY].to_numpy()
    if (given <= 0).any():
        raise DataError(f"'{path}' must have frequencies above zero, but got {table[_FREQUENCY].min():g} Hz")
    given = np.where(np.isnan(given), speeds[at_speed], given)
    frequencies = np.zeros((len(speeds), len(runs)))
    frequencies[at_speed, at_run] = given
    unequal = np.flatnonzero(frequencies[at_speed, at_run] != given)
    if len(unequal):
        row = table.iloc[unequal[0]]
        raise DataError(
            f"'{path}' must have one frequency for all channels of a run and speed, but run '{row['run']}' has several "
            f"at {row['speed_rpm']:g} rpm: give every frequency a run of its own"
        )
    return frequencies


def _check_synchronous(dataset: VibrationDataset, path: Path) -> None:
    """An unbalance turns with the rotor."""
    for excitation in dataset.excitations:
        own = dataset.frequencies[:, dataset.runs.index(excitation.run)]
        if excitation.kind == "unbalance" and not np.allclose(own, dataset.speeds, rtol=1e-9):
            raise DataError(
                f"'{path}' must have the rotor's frequency in runs with an unbalance, but run '{excitation.run}' has "
                "another: give its force as kind 'force', or leave the frequency out"
            )


def _excitations(table: pd.DataFrame, path: Path, rotor: RotorModel) -> tuple[Excitation, ...]:
    _check_words(table["kind"], ("unbalance", "force"), path, "kind")
    _check_words(table["whirl"], ("forward", "backward"), path, "whirl")
    nodes = _nodes(table, path, rotor)
    if (table["magnitude"] <= 0).any():
        raise DataError(f"'{path}' must have magnitudes above zero, but got {table['magnitude'].min():g}")
    return tuple(
        Excitation(
            str(row.run),
            row.kind,
            int(node),
            float(row.magnitude),
            float(np.radians(row.phase_deg)),
            row.whirl,
        )
        for row, node in zip(table.itertuples(), nodes, strict=True)
    )


def _nodes(table: pd.DataFrame, path: Path, rotor: RotorModel) -> np.ndarray:
    values = table["node"].to_numpy()
    bad = values[(values != np.round(values)) | (values < 0) | (values >= rotor.n_nodes)]
    if len(bad):
        raise DataError(f"'{path}' must use the rotor's nodes 0 to {rotor.n_nodes - 1}, but got node {bad[0]:g}")
    return values.astype(int)


def _check_words(values: pd.Series, allowed: tuple[str, ...], path: Path, column: str) -> None:
    for value in values.unique():
        if value not in allowed:
            raise DataError(
                f"'{path}' must have {' or '.join(map(repr, allowed))} in the column '{column}', but got {value!r}"
            )
