"""Amplitude and phase tables, CSV or Excel.

Wide: a row a speed, two columns a probe. Long: a row a run, probe and speed.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from pipeline.config.measured import CsvConfig
from pipeline.config.motion import to_motion
from pipeline.config.recordings import TableRecordingsConfig, TableRunConfig
from pipeline.data.tables import Columns, TextFormat, read_table
from pipeline.errors import DataError, nearest
from pipeline.ingest.conventions import RAD_S, to_displacement, to_vectors
from pipeline.ingest.tracks import RunTracks, Track, sort_track

_BROAD = 2.0
"""Phases that differ by more than this pass a resonance if they are radians, and hardly differ if they are degrees."""


def read_table_runs(config: TableRecordingsConfig) -> tuple[RunTracks, ...]:
    """The runs of the configuration, each from its file.

    Raises DataError; see :func:`pipeline.data.tables.read_table` for what a table must be.
    """
    runs = []
    for run in config.runs:
        path = Path(run.sources(config.file)[0])
        rows = _read_wide(config, run, path) if config.layout == "wide" else _read_long(config, run, path)
        tracks = {name: _make_track(config, run, name, row) for name, row in rows.items()}
        phases = np.concatenate([phase for _, _, phase, _ in rows.values()])
        notes = note_cut(path) + _note_unit(phases, config.conventions.phase_unit, path)
        conditions = _read_conditions(config, run, path)
        runs.append(RunTracks(run.name, f"'{path}'", tracks, tracks, notes, conditions=conditions))
    return tuple(runs)


def _read_conditions(
    config: TableRecordingsConfig, run: TableRunConfig, path: Path
) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Name -> speeds (n,) rad/s, ascending, and the condition there, SI: the mean of the rows of a speed."""
    named = config.columns
    if not named.conditions:
        return {}
    columns = {name: condition.column for name, condition in named.conditions.items()}
    kinds = dict.fromkeys((named.speed, *columns.values()), "number")
    kinds |= {named.run: "text"} if config.layout == "long" else {}
    table = read_table(path, kinds, text=read_format(config.csv))
    if config.layout == "long":
        table = _select(table, named.run, run.name)
    speeds, at = np.unique(table[named.speed], return_inverse=True)
    count = np.bincount(at.ravel())
    return {
        name: (
            speeds * RAD_S[config.conventions.speed],
            np.bincount(at.ravel(), named.conditions[name].to_si(table[column])) / count,
        )
        for name, column in columns.items()
    }


_Rows = tuple[np.ndarray, np.ndarray, np.ndarray, str]
"""Speed, amplitude and phase (S,) of one probe in one run, in the file's units; and its name in messages."""


def read_format(csv: CsvConfig) -> TextFormat:
    """How the configuration says that CSV files are written."""
    return TextFormat(csv.delimiter, csv.decimal, csv.skip_rows)


def _read_wide(config: TableRecordingsConfig, run: TableRunConfig, path: Path) -> dict[str, _Rows]:
    pairs = {name: run.columns.get(name) or probe.columns for name, probe in config.probes.items()}
    columns = [config.columns.speed, *(c for pair in pairs.values() if pair for c in (pair.amplitude, pair.phase))]
    table = read_table(path, dict.fromkeys(columns, "number"), text=read_format(config.csv))
    return {
        name: _take_rows(table, config.columns.speed, pair.amplitude, pair.phase, f"'{path}'")
        for name, pair in pairs.items()
        if pair is not None  # the schema has seen to it
    }


def _read_long(config: TableRecordingsConfig, run: TableRunConfig, path: Path) -> dict[str, _Rows]:
    names = config.columns
    kinds = {names.run: "text", names.probe: "text"}
    kinds |= dict.fromkeys((names.speed, names.amplitude, names.phase), "number")
    table = read_table(path, kinds, text=read_format(config.csv))
    _check_runs(config, list(dict.fromkeys(table[names.run])), path)
    mine = _select(table, names.run, run.name)
    if not len(mine[names.run]):
        raise DataError(
            f"'{path}' must have rows of run '{run.name}' in the column '{names.run}', but it has "
            f"{nearest(run.name, set(table[names.run]))}"
        )
    runs_read = {}
    for name, probe in config.probes.items():
        label = probe.label or name
        rows = _select(mine, names.probe, label)
        if not len(rows[names.probe]):
            raise DataError(
                f"'{path}' must have rows of probe '{label}' in run '{run.name}', but it has "
                f"{nearest(label, set(mine[names.probe]))}"
            )
        where = f"'{path}', run '{run.name}', probe '{label}',"
        runs_read[name] = _take_rows(rows, names.speed, names.amplitude, names.phase, where)
    return runs_read


def _select(table: Columns, name: str, value: str) -> Columns:
    rows = table[name] == value
    return {column: values[rows] for column, values in table.items()}


def _take_rows(table: Columns, speed: str, amplitude: str, phase: str, where: str) -> _Rows:
    if (table[amplitude] < 0).any():
        raise DataError(
            f"{where} must have amplitudes of zero or more in the column '{amplitude}', but got "
            f"{table[amplitude].min():g}"
        )
    return table[speed], table[amplitude], table[phase], where


def _make_track(config: TableRecordingsConfig, run: TableRunConfig, probe: str, rows: _Rows) -> Track:
    said = config.conventions
    speed, amplitude, phase, where = rows
    angle = np.radians(phase) if said.phase_unit == "deg" else phase
    order, size = to_motion(said.unit, config.probes[probe].scale)
    vectors = to_vectors(amplitude, angle, size, said.amplitude, said.phase)
    speeds = speed * RAD_S[said.speed]
    return sort_track(speeds, to_displacement(vectors, order, run.frequencies(speeds)), where)


def _note_unit(phases: np.ndarray, unit: str, path: Path) -> tuple[str, ...]:
    """A note on phases, as in the file, that look like the other unit."""
    largest = np.abs(phases).max()
    if unit == "deg" and largest <= 2 * np.pi and np.ptp(phases) > _BROAD:
        said, other = "degrees", "radians (machine.recordings.conventions.phase_unit=rad)"
    elif unit == "rad" and largest > 6 * np.pi:
        said, other = "radians", "degrees (machine.recordings.conventions.phase_unit=deg)"
    else:
        return ()
    span = f"{phases.min():.3g} to {phases.max():.3g}"
    return (f"'{path}' has phases from {span} that are said to be {said}: are they in {other}?",)


def _check_runs(config: TableRecordingsConfig, present: Sequence[str], path: Path) -> None:
    named = {run.name for run in config.runs} | set(config.leave_out)
    strange = [name for name in present if name not in named]
    if strange:
        raise DataError(
            f"machine.recordings.runs must name every run of '{path}' with what excited it, but '{strange[0]}' is not "
            "among them: add it (or name it as machine.recordings.baseline too), or put it into "
            "machine.recordings.leave_out"
        )


def note_cut(path: Path) -> tuple[str, ...]:
    """A note on a CSV file whose last row may lack digits: nothing else shows it."""
    if path.suffix.lower() in (".parquet", ".xlsx", ".xlsm", ".mat"):
        return ()
    with path.open("rb") as file:
        file.seek(-1, 2)
        last = file.read(1)
    if last in b"\r\n":
        return ()
    return (f"'{path}' does not end with the end of a line: if it was cut off, its last row may be wrong",)
