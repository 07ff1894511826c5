"""The two files that training reads: ``vibration.parquet`` (or .csv) and ``excitation.csv``.

Vibration: ``run, speed_rpm, node, direction, amplitude_m, phase_deg``, one row a measured displacement; direction x,
y, or the angle of a probe in degrees from x towards y; amplitude zero-to-peak, phase of Q in q(t) = Re(Q e^{jwt}). A
column ``frequency_hz`` gives the excitation frequency where it is not the rotor speed's; without it, and where it is
blank, the response is synchronous; a synchronous run may be off the nominal speed by 1 %. A standing rotor (0 rpm)
needs it: each frequency of its force is a run; along x push a forward and a backward force of half the size together. A
column ``condition`` names what was on the machine in each run: runs of one condition repeat each other. The order of
the rows means nothing. Further columns are operating conditions (:mod:`pipeline.config.operating`), such as
``oil_temperature_degC``: a run may have a speed once at each of them. A run has all channels at each of its speeds, and
need not have the speeds of others. A column ``deviation_m`` is the root mean square of a reading's own noise, in place
of the stated one where it is not blank.
Excitation: see :mod:`pipeline.data.excitation_files`.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from contextlib import suppress
from pathlib import Path

import numpy as np

from pipeline.data.dataset import (
    DIRECTIONS,
    Excitation,
    VibrationDataset,
    name_direction,
    place_rows,
    subtract_baseline,
    synchronous,
)
from pipeline.data.excitation_files import read_excitations, read_nodes
from pipeline.data.mat_files import require_room
from pipeline.data.operating import (
    describe_point,
    find_points,
    list_columns,
    read_with_conditions,
)
from pipeline.data.tables import Columns, read_marks, write_table
from pipeline.errors import ConfigError, DataError, nearest
from pipeline.rotor.model import RotorModel
from pipeline.units import RAD_S_PER_RPM

_VIBRATION = {
    "run": "text",
    "speed_rpm": "number",
    "node": "number",
    "direction": "text",
    "amplitude_m": "number",
    "phase_deg": "number",
}
_FREQUENCY = "frequency_hz"
_CONDITION = "condition"
_DEVIATION = "deviation_m"


def to_rpm(speeds: np.ndarray) -> np.ndarray:
    """rad/s to rpm, rounded so that 100 rpm is written as 100."""
    return np.round(speeds / RAD_S_PER_RPM, 9)


def write_range(speeds: np.ndarray) -> str:
    """Such as ``900 to 5700 rpm``, of speeds (S,) in rad/s."""
    rpm = to_rpm(speeds)
    return f"{rpm.min():g} to {rpm.max():g} rpm"


def place_speed(rpm: float, speeds: np.ndarray, within: float = 1e-3) -> tuple[np.ndarray, int]:
    """``speeds`` (S,) rad/s, ascending, with machine.prediction.speed_rpm among them, and its index.

    One that is as near as the share ``within`` stands for it: nominal speeds of records are means with many digits.
    Raises ConfigError outside of the speeds.
    """
    every = to_rpm(speeds)
    nearest = int(np.abs(every - rpm).argmin())
    if abs(every[nearest] - rpm) <= within * rpm:
        return speeds, nearest
    if not every[0] < rpm < every[-1]:
        raise ConfigError(
            f"machine.prediction.speed_rpm must lie within the data's speeds, {write_range(speeds)}, but got {rpm:g}: "
            "choose one there, since nothing is extrapolated"
        )
    at = int(np.searchsorted(every, rpm))
    return np.insert(speeds, at, rpm * RAD_S_PER_RPM), at


def write_vibration(path: Path, dataset: VibrationDataset, marks: Mapping[str, str] | None = None) -> Path:
    """Write the displacements of all runs, the baseline run among them. Raises StorageError.

    Generated data have ``marks`` (see :func:`pipeline.data.tables.read_marks`); measured data belong to no model.
    """
    channels = len(dataset.channels)
    r, s = np.repeat(np.nonzero(dataset.present.T), channels, axis=1)  # run slowest, then speed, then channel
    p = np.resize(np.arange(channels), len(s))
    readings = dataset.displacement[s, p, r]
    columns = {
        "run": np.array(dataset.runs, dtype=object)[r],
        "speed_rpm": to_rpm(dataset.speeds)[s],
        **{name: values[s] for name, values in list_columns(dataset.operating).items()},
        "node": np.array([node for node, _ in dataset.channels])[p],
        "direction": np.array([name_direction(angle) for _, angle in dataset.channels])[p],
        "amplitude_m": np.abs(readings),
        "phase_deg": np.degrees(np.angle(readings)),
    }
    if dataset.own_frequencies is not None:
        columns[_FREQUENCY] = dataset.own_frequencies[s, r] / (2 * np.pi)
    if dataset.noise.any():
        columns[_DEVIATION] = dataset.noise[s, p, r]
    if dataset.conditions:
        columns[_CONDITION] = np.array(dataset.conditions, dtype=object)[r]
    return write_table(path, columns, marks)


def read_dataset(
    vibration: Path,
    excitation: Path,
    rotor: RotorModel,
    baseline: str | None = None,
    same: Mapping[str, float] | None = None,
) -> VibrationDataset:
    """Read both files and hold them against each other and against the rotor.

    The ``baseline``, the machine as found, is subtracted from runs that turn with the rotor; ``same``: read_measured.

    Raises DataError with the law that a file breaks; see :func:`pipeline.data.tables.read_table` for those of
    the tables themselves.
    """
    dataset = read_measured(vibration, excitation, baseline, rotor.n_places, same, len(rotor.casings))
    require_made_for(vibration, rotor)
    return dataset


def require_made_for(vibration: Path, rotor: RotorModel) -> None:
    """Raise DataError where the file says that it was generated for another rotor."""
    made_for = (read_marks(vibration) or {}).get("rotor")
    if made_for and made_for != rotor.fingerprint:
        raise DataError(
            f"'{vibration}' must have been made for this rotor ({rotor.fingerprint}), but it was made for another "
            f"({made_for}): "
            "make it again with stage=generate, or give the rotor that belongs to it"
        )


def require_nodes_of(dataset: VibrationDataset, rotor: RotorModel, vibration: Path, excitation: Path) -> None:
    """Raise DataError for a node of either file that the ``rotor`` lacks."""
    read_nodes(np.array([node for node, _ in dataset.channels]), vibration, rotor.n_views)
    read_nodes(np.array([acting.node for acting in dataset.excitations]), excitation, rotor.n_places)


def read_measured(
    vibration: Path,
    excitation: Path,
    baseline: str | None = None,
    n_nodes: int | None = None,
    same: Mapping[str, float] | None = None,
    n_casings: int = 0,
) -> VibrationDataset:
    """Read both files as :func:`read_dataset` does, where at most the number of the rotor's nodes is known.

    Of the ``n_nodes`` so many are casings, for each of which a probe may have one number more, of the shaft less it.
    Operating conditions that differ by no more than ``same`` says (SI, by name) are taken for one, their mean.
    """
    optional = {_FREQUENCY: "number or blank", _CONDITION: "text", _DEVIATION: "number or blank"}
    table, operating = read_with_conditions(vibration, _VIBRATION, optional)
    excitations = read_excitations(excitation, n_nodes)
    nodes = read_nodes(table["node"], vibration, n_nodes and n_nodes + n_casings)
    angles = _read_angles(table["direction"], vibration)
    rpm, amplitude = table["speed_rpm"], table["amplitude_m"]
    if not ((rpm > 0) | (rpm == 0) & (np.asarray(table.get(_FREQUENCY, 0 * rpm)) > 0)).all():
        raise DataError(
            f"'{vibration}' must have speeds above zero, or zero with a {_FREQUENCY}, but got {rpm.min():g} rpm"
        )
    strange = amplitude[(amplitude < 0) | (amplitude > 1)]
    if len(strange):
        raise DataError(f"'{vibration}' must have amplitudes of zero or more, up to 1 m, but got {strange[0]:g} m")
    acting = dict.fromkeys(e.run for e in excitations)
    measured = dict.fromkeys(table["run"].tolist())
    # The order of the rows means nothing: that of the runs is the excitations', then the alphabet's.
    runs = (*(run for run in acting if run in measured), *sorted(measured.keys() - acting.keys()))
    if baseline:
        _check_baseline(baseline, runs, acting, vibration, excitation)
    for run in runs:
        if run not in acting and run != baseline:
            raise DataError(
                f"'{excitation}' must have a row for every run, but run '{run}' of '{vibration}' has none: add it, or "
                f"name the run of the machine as it was found as data.baseline={run}"
            )
    for run in sorted(acting.keys() - measured.keys()):
        raise DataError(f"'{vibration}' must have data of every run, but run '{run}' of '{excitation}' has none")
    points = find_points(table["speed_rpm"], operating, same)
    dataset = _assemble(table, points, (nodes, angles), vibration, runs, excitations)
    for load in dataset.excitations if dataset.own_frequencies is not None else ():
        frequencies = dataset.frequencies[:, dataset.runs.index(load.run)]
        if load.kind == "unbalance" and not synchronous(frequencies, dataset.speeds).all():  # it turns with the rotor
            raise DataError(
                f"'{vibration}' must have the rotor's frequency in runs with an unbalance, but run '{load.run}' has "
                "another: give its force as kind 'force', or leave the frequency out"
            )
    if (dataset.noise < 0).any() or (baseline and dataset.noise.any()):
        raise DataError(
            f"'{vibration}' must have a {_DEVIATION} above zero, and none where a baseline is subtracted, whose noise "
            f"all runs share, but has: correct it, or leave out {f'data.baseline={baseline}' if baseline else 'it'}"
        )
    return subtract_baseline(dataset, baseline) if baseline else dataset


def _check_baseline(
    baseline: str, runs: tuple[str, ...], acting: Collection[str], vibration: Path, excitation: Path
) -> None:
    if baseline not in runs:
        raise DataError(f"data.baseline must be a run of '{vibration}', but it is not: {nearest(baseline, runs)}")
    if baseline in acting:
        raise DataError(
            f"data.baseline must be the machine as it was found, but '{excitation}' has a row for run '{baseline}'"
        )
    if len(runs) == 1:
        raise DataError(f"'{vibration}' must have a run beside the baseline, but it has '{baseline}' alone")


def _assemble(
    table: Columns,
    points: tuple[np.ndarray, dict[str, np.ndarray], np.ndarray],
    places: tuple[np.ndarray, np.ndarray],
    path: Path,
    runs: tuple[str, ...],
    excitations: tuple[Excitation, ...],
) -> VibrationDataset:
    """The data set of rows at ``points`` (see :func:`find_points`, in rpm) and ``places`` (nodes and angles)."""
    rpm, operating, at_point = points
    channels_read, at_channel = np.unique(np.stack(places, axis=1), axis=0, return_inverse=True)
    pairs = [(int(node), float(angle)) for node, angle in channels_read]
    order = {run: r for r, run in enumerate(runs)}
    at_run = np.array([order[run] for run in table["run"].tolist()])
    shape = (len(rpm), len(pairs), len(runs))
    require_room(path, 16 * math.prod(shape))
    at = at_point, at_channel.ravel(), at_run
    counts = np.bincount(np.ravel_multi_index(at, shape), minlength=np.prod(shape)).reshape(shape)

    def describe_first(index: np.ndarray) -> str:
        s, p, r = index
        channel = f"node {pairs[p][0]} {name_direction(pairs[p][1])}"
        return f"the first: run '{runs[r]}', {rpm[s]:g} rpm{describe_point(operating, s, ', ')}, {channel}"

    if counts.max() > 1:
        law = f"a run, speed, {'operating conditions, ' if operating else ''}node and direction"
        raise DataError(
            f"'{path}' must have one row {law}, but some are there twice ({describe_first(np.argwhere(counts > 1)[0])})"
        )
    present = np.asarray(counts.any(axis=1))  # (S, R)
    missing = np.argwhere((counts == 0) & present[:, None])
    if len(missing):
        raise DataError(
            f"'{path}' must have every channel at every speed of a run, but {len(missing)} of "
            f"{len(pairs) * present.sum()} are missing ({describe_first(missing[0])})"
        )
    speeds = rpm * RAD_S_PER_RPM
    asynchronous = _FREQUENCY in table and not np.isnan(table[_FREQUENCY]).all()
    frequencies = _read_frequencies(table, path, speeds[at_point]) if asynchronous else np.zeros(0)
    dataset = place_rows(
        speeds,
        runs,
        tuple(pairs),
        at,
        table["amplitude_m"] * np.exp(1j * np.radians(table["phase_deg"])),
        excitations,
        frequencies,
        np.nan_to_num(table[_DEVIATION]) if _DEVIATION in table else (),
        conditions=_read_conditions(table, path, runs) if _CONDITION in table else None,
        operating=operating,
    )
    unequal = np.flatnonzero(asynchronous and dataset.frequencies[at_point, at_run] != frequencies)
    if len(unequal):
        run, at_rpm = table["run"][unequal[0]], table["speed_rpm"][unequal[0]]
        raise DataError(
            f"'{path}' must have one frequency for all channels of a run and speed, but run '{run}' has several "
            f"at {at_rpm:g} rpm: give every frequency a run of its own"
        )
    return dataset


def _read_conditions(table: Columns, path: Path, runs: tuple[str, ...]) -> tuple[str, ...]:
    """(R,) the condition of each run."""
    labels: dict[str, str] = {}
    for run, condition in zip(table["run"].tolist(), table[_CONDITION].tolist(), strict=True):
        if labels.setdefault(run, condition) != condition or not condition:
            raise DataError(
                f"'{path}' must have one condition for all rows of a run, but run '{run}' has '{labels[run]}' and "
                f"'{condition}'"
            )
    return tuple(labels[run] for run in runs)


def _read_frequencies(table: Columns, path: Path, speeds: np.ndarray) -> np.ndarray:
    """(n,) rad/s, that of the rotor, at ``speeds`` (n,) rad/s, where none is given."""
    given = 2 * np.pi * table[_FREQUENCY]
    if (given <= 0).any():
        raise DataError(f"'{path}' must have frequencies above zero, but got {np.nanmin(table[_FREQUENCY]):g} Hz")
    return np.where(np.isnan(given), speeds, given)


def _read_angles(directions: np.ndarray, path: Path) -> np.ndarray:
    """Degrees from x towards y, 0 to 360."""
    angles = dict(DIRECTIONS)
    for direction in dict.fromkeys(directions.tolist()):
        with suppress(ValueError):
            angles.setdefault(direction, float(direction) % 360.0)
        if not np.isfinite(angles.get(direction, np.nan)):
            raise DataError(
                f"'{path}' must have 'x', 'y' or an angle in degrees (from x towards y) in the column 'direction', but "
                f"got {direction!r}"
            )
    return np.array([angles[direction] for direction in directions.tolist()])
