"""Operating conditions of recordings: given for a run, in a file beside the recordings, or in a column of a table.

Legend: S speeds, R recordings, P channels; then S operating points and R runs of the data set.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from pipeline.config.measured import MeasuredConfig, MeasuredRunConfig
from pipeline.data.dataset import VibrationDataset, place_rows
from pipeline.data.operating import find_points, name_state, read_with_conditions
from pipeline.data.tables import Columns
from pipeline.errors import DataError, nearest
from pipeline.ingest.tracks import ROUNDING, RunTracks
from pipeline.units import RAD_S_PER_RPM
from pipeline.write_numbers import write_number

Conditions = dict[str, np.ndarray]


def find_conditions(config: MeasuredConfig, runs: Sequence[RunTracks], speeds: np.ndarray) -> Conditions:
    """Name -> (S, R) SI at ``speeds`` (S,) rad/s: what ``operating`` of a run says, or the file, or the columns; beyond
    the range of a run, which has no reading there, the value at its end.

    Raises DataError for a condition that some recordings lack, and for speeds or times that the file does not cover.
    """
    logged = _read_log(config)
    conditions = []
    for run, tracks in zip(config.runs, runs, strict=True):
        levels = {name: np.interp(speeds, *condition) for name, condition in tracks.conditions.items()}
        if logged is not None:
            levels |= _look_up(logged, run, tracks, speeds, f"'{config.conditions_file}'")
        levels |= {name: np.full(len(speeds), value) for name, value in run.operating.items()}
        conditions.append(levels)
    names = list(dict.fromkeys(name for levels in conditions for name in levels))
    for name in names:
        without = [run.name for run, levels in zip(config.runs, conditions, strict=True) if name not in levels]
        if without:
            raise DataError(
                f"every run must have every operating condition, but run '{without[0]}' has no {name} "
                f"({len(without)} of {len(conditions)} runs): give it as operating={{{name}: ..}} of the run, or in "
                "machine.recordings.conditions_file"
            )
    return {name: np.stack([levels[name] for levels in conditions], axis=1) for name in names}


def _read_log(config: MeasuredConfig) -> tuple[Columns, Conditions] | None:
    if not config.conditions_file:
        return None
    path = Path(config.conditions_file)
    places = {"speed_rpm": "number", "time_s": "number"}
    table, operating = read_with_conditions(path, {"run": "text"}, places)
    if not operating:
        raise DataError(
            f"'{path}' must have columns of operating conditions, such as oil_temperature_degC, but it has none"
        )
    if places.keys() <= table.keys():
        raise DataError(f"'{path}' must have speed_rpm or time_s, but it has both: leave one out")
    return table, operating


def _look_up(
    logged: tuple[Columns, Conditions], run: MeasuredRunConfig, tracks: RunTracks, speeds: np.ndarray, where: str
) -> Conditions:
    """Name -> (S,) of one recording: straight lines between the rows of its run."""
    table, operating = logged
    rows = np.flatnonzero(table["run"] == run.name)
    if not len(rows):
        if run.operating:
            return {}
        raise DataError(
            f"{where} must have rows of run '{run.name}', but it has {nearest(run.name, set(table['run']))}"
        )
    key = next((name for name in ("speed_rpm", "time_s") if name in table), None)
    if not key:
        if len(rows) > 1:
            raise DataError(
                f"{where} must have one row a run where it has no speed_rpm and no time_s, but run '{run.name}' has "
                f"{len(rows)}: add one of the columns, or give each recording a name of its own"
            )
        return {name: np.full(len(speeds), values[rows[0]]) for name, values in operating.items()}
    if key == "time_s" and tracks.times is None:
        raise DataError(
            f"{where} may have time_s for run-ups alone (records=run_up), which pass each speed once, but run "
            f"'{run.name}' is none: give speed_rpm"
        )
    passed = next(iter(tracks.tracks.values())).speeds
    wanted = np.clip(speeds, passed[0], passed[-1]) / RAD_S_PER_RPM
    if key == "time_s":
        wanted = np.interp(speeds, passed, np.asarray(tracks.times))
    given = table[key][rows]
    order = np.argsort(given, kind="stable")
    given = given[order]
    if (np.diff(given) == 0).any():
        raise DataError(f"{where} must have each {key} of a run once, but run '{run.name}' has one twice")
    if wanted.min() < given[0] * (1 - ROUNDING) or wanted.max() > given[-1] * (1 + ROUNDING):
        raise DataError(
            f"{where} must cover run '{run.name}' ({key} {write_number(wanted.min(), digits=6)} to "
            f"{write_number(wanted.max(), digits=6)}), but it has "
            f"{write_number(given[0], digits=6)} to {write_number(given[-1], digits=6)}: nothing is extrapolated"
        )
    return {name: np.interp(wanted, given, values[rows][order]) for name, values in operating.items()}


def name_recordings(config: MeasuredConfig, conditions: Conditions) -> tuple[str, ...]:
    """R names: that of the run, with its conditions where several recordings have it."""
    names = [run.name for run in config.runs]
    return tuple(
        f"{name}, {name_state({key: condition[:, r] for key, condition in conditions.items()})}"
        if names.count(name) > 1
        else name
        for r, name in enumerate(names)
    )


def _group(recorded: VibrationDataset, place: np.ndarray) -> list[list[int]]:
    """Recordings of one excitation together, where no point holds two of them; ``place`` (S, R) are their points."""
    groups: list[list[int]] = []
    for r in range(place.shape[1]):
        for group in groups:
            held = place[recorded.present[:, r], r]
            apart = not any(np.isin(held, place[:, other]).any() for other in group)
            same = np.array_equal(recorded.frequencies[:, r], recorded.frequencies[:, group[0]])
            if apart and same and recorded.excitation_of(r) == recorded.excitation_of(group[0]):
                group.append(r)
                break
        else:
            groups.append([r])
    return groups


def to_points(
    recorded: VibrationDataset, names: Sequence[str], conditions: Conditions, same: Mapping[str, float]
) -> tuple[VibrationDataset, list[str]]:
    """The data set at operating points, and a note on recordings that became one run.

    Recordings of one excitation are one run where no point holds two of them: it is called by the first of their
    ``names`` (R,). Raises DataError where recordings of one name share a point.
    """
    seen = recorded.present
    flat = {name: values[seen] for name, values in conditions.items()}
    speeds, operating, at = find_points(recorded.speeds[np.nonzero(seen)[0]], flat, same)
    place = np.full(seen.shape, -1)  # the point of each speed in each recording
    place[seen] = at
    groups = _group(recorded, place)
    runs = tuple(names[group[0]] for group in groups)
    if len(set(runs)) < len(runs):
        twice = next(run for run in runs if runs.count(run) > 1)
        raise DataError(
            f"recordings of one run must be at operating conditions of their own, but some of run '{twice}' have a "
            "speed at the same ones: give them other names, or a smaller machine.recordings.same_conditions"
        )
    at_run = np.array([next(g for g, group in enumerate(groups) if r in group) for r in range(seen.shape[1])])
    acting = tuple(
        replace(excitation, run=run)
        for run, group in zip(runs, groups, strict=True)
        for excitation in recorded.excitations
        if excitation.run == recorded.runs[group[0]]
    )
    notes = [
        f"the recordings {', '.join(recorded.runs[r] for r in group)} have the same excitation at other conditions: "
        f"they are one run, '{run}'"
        for run, group in zip(runs, groups, strict=True)
        if len({names[r] for r in group}) > 1
    ]
    made = place_rows(
        speeds,
        runs,
        recorded.channels,
        (at, slice(None), at_run[np.nonzero(seen)[1]]),
        recorded.readings,
        acting,
        () if recorded.own_frequencies is None else recorded.own_frequencies[seen],
        operating=operating,
    )
    return made, notes
