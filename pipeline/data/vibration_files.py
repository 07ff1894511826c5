"""The two files that training reads: ``vibration.parquet`` (or .csv) and ``excitation.csv``.

Vibration: ``run, speed_rpm, node, direction, amplitude_m, phase_deg``, one row a measured displacement; direction x,
y, or the angle of a probe in degrees from x towards y; amplitude zero-to-peak, phase of Q in q(t) = Re(Q e^{jwt}). A
column ``frequency_hz`` gives the excitation frequency where it is not the rotor speed's; without it, and where it is
blank, the response is synchronous.
Excitation: ``run, kind, node, magnitude, phase_deg, whirl``; kind ``unbalance`` (kg m) or ``force`` (N).
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from pipeline.data.dataset import DIRECTIONS, Excitation, VibrationDataset, direction_name, without_baseline
from pipeline.data.tables import read_table, rotor_of, write_table
from pipeline.errors import DataError, nearest
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


def write_vibration(
    path: Path, dataset: VibrationDataset, rotor: RotorModel | None = None, origin: str | None = None
) -> Path:
    """Write the displacements of all runs, the baseline run among them. Raises StorageError.

    Generated data say for which ``rotor`` and from what ``origin``; measured data belong to no model of it.
    """
    import pandas as pd

    n_speeds, n_channels, n_runs = dataset.displacement.shape
    flat = dataset.displacement.transpose(2, 0, 1).ravel()  # run slowest, then speed, then channel
    nodes = np.array([node for node, _ in dataset.channels])
    directions = np.array([direction_name(angle) for _, angle in dataset.channels])
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
    return write_table(path, pd.DataFrame(columns), None if rotor is None else rotor.fingerprint, origin)


def write_excitation(path: Path, dataset: VibrationDataset) -> Path:
    """Write what excited the runs; a run that nothing excites (the baseline) has no row. Raises StorageError."""
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


def read_dataset(vibration: Path, excitation: Path, rotor: RotorModel, baseline: str | None = None) -> VibrationDataset:
    """Read both files and hold them against each other and against the rotor.

    The run ``baseline``, of the machine as it was found, is subtracted from the runs that turn with the rotor.

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
    angles = _angles(table["direction"], vibration)
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
    if baseline is not None:
        _check_baseline(baseline, runs, acting, vibration, excitation)
    for run in runs:
        if run not in acting and run != baseline:
            raise DataError(
                f"'{excitation}' must have a row for every run, but run '{run}' of '{vibration}' has none: add it, or "
                f"name the run of the machine as it was found as data.baseline={run}"
            )
    for run in sorted(acting - set(runs)):
        raise DataError(f"'{vibration}' must have data of every run, but run '{run}' of '{excitation}' has none")
    dataset = _assemble(table.assign(node=nodes, angle=angles), vibration, runs, excitations)
    if dataset.own_frequencies is not None:
        _check_synchronous(dataset, vibration)
    return dataset if baseline is None else without_baseline(dataset, baseline)


def _check_baseline(baseline: str, runs: tuple[str, ...], acting: set[str], vibration: Path, excitation: Path) -> None:
    if baseline not in runs:
        raise DataError(f"data.baseline must be a run of '{vibration}', but it is not: {nearest(baseline, runs)}")
    if baseline in acting:
        raise DataError(
            f"data.baseline must be the machine as it was found, but '{excitation}' has a row for run '{baseline}'"
        )
    if len(runs) == 1:
        raise DataError(f"'{vibration}' must have a run beside the baseline, but it has '{baseline}' alone")


def _assemble(
    table: pd.DataFrame, path: Path, runs: tuple[str, ...], excitations: tuple[Excitation, ...]
) -> VibrationDataset:
    rpm = np.unique(table["speed_rpm"])
    pairs = sorted({(int(n), float(a)) for n, a in zip(table["node"], table["angle"], strict=True)})
    place = {pair: i for i, pair in enumerate(pairs)}
    at_channel = [place[int(n), float(a)] for n, a in zip(table["node"], table["angle"], strict=True)]
    at_run = table["run"].map({run: i for i, run in enumerate(runs)}).to_numpy()
    at_speed = np.searchsorted(rpm, table["speed_rpm"])
    displacement = np.full((len(rpm), len(pairs), len(runs)), np.nan, dtype=complex)
    values = table["amplitude_m"].to_numpy() * np.exp(1j * np.radians(table["phase_deg"].to_numpy()))
    displacement[at_speed, at_channel, at_run] = values
    expected = displacement.size
    if len(table) > expected or table.duplicated(["run", "speed_rpm", "node", "angle"]).any():
        raise DataError(f"'{path}' must have one row a run, speed, node and direction, but some are there twice")
    missing = np.argwhere(np.isnan(displacement))
    if len(missing):
        s, p, r = missing[0]
        raise DataError(
            f"'{path}' must have every channel at every speed of every run, but {len(missing)} of {expected} are "
            "missing "
            f"(the first: run '{runs[r]}', {rpm[s]:g} rpm, node {pairs[p][0]} {direction_name(pairs[p][1])})"
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


def _angles(directions: pd.Series, path: Path) -> np.ndarray:
    """Degrees from x towards y, 0 to 360."""
    import pandas as pd

    numbers = pd.to_numeric(directions, errors="coerce").to_numpy(dtype=float)
    angles = directions.map(DIRECTIONS).to_numpy(dtype=float)
    angles = np.where(np.isnan(angles), numbers % 360.0, angles)
    bad = np.flatnonzero(~np.isfinite(angles))
    if len(bad):
        raise DataError(
            f"'{path}' must have 'x', 'y' or an angle in degrees (from x towards y) in the column 'direction', but got "
            f"{directions.iloc[bad[0]]!r}"
        )
    return angles


def _check_words(values: pd.Series, allowed: tuple[str, ...], path: Path, column: str) -> None:
    for value in values.unique():
        if value not in allowed:
            raise DataError(
                f"'{path}' must have {' or '.join(map(repr, allowed))} in the column '{column}', but got {value!r}"
            )
