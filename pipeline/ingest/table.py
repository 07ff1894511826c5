"""Amplitude and phase tables, CSV or Excel.

Wide: a row a speed, two columns a probe. Long: a row a run, probe and speed.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Literal

import numpy as np
from pydantic import Field, PositiveFloat

from pipeline.config.measured import (
    ConventionsConfig,
    MeasuredConfig,
    MeasuredProbeConfig,
    MeasuredRunConfig,
    TachoAngleConfig,
)
from pipeline.config.operating import ConditionColumns
from pipeline.config.runs import check_frequency, find_frequencies
from pipeline.config.section import Section, Text, rule
from pipeline.data.csv_format import CsvConfig, describe_format
from pipeline.data.tables import Columns, is_csv, read_table
from pipeline.errors import DataError, nearest
from pipeline.ingest.conventions import RAD_S, read_vectors
from pipeline.ingest.tracks import RunTracks, Track, sort_track
from pipeline.write_numbers import write_number


class TableColumnsConfig(Section):
    """Names of columns; all but ``speed`` and ``conditions`` are of the long layout."""

    speed: Text
    conditions: ConditionColumns = Field(default_factory=dict)
    run: Text = "run"
    probe: Text = "probe"
    amplitude: Text = "amplitude"
    phase: Text = "phase"


class ColumnPairConfig(Section):
    """The two columns of a probe in the wide layout."""

    amplitude: Text
    phase: Text


class TableProbeConfig(MeasuredProbeConfig):
    """A probe with its columns (wide layout), or with the text that stands for it in the probe column (long)."""

    columns: ColumnPairConfig | None = None
    label: Text | None = None


class TableRunConfig(MeasuredRunConfig):
    """``columns``: of probes that are called otherwise in this file; ``frequency_*``: of forces, not the rotor's."""

    columns: dict[str, ColumnPairConfig] = Field(default_factory=dict)
    frequency_hz: PositiveFloat | None = None
    frequency_ratio: PositiveFloat | None = None

    _synchronous = rule(check_frequency)


class TableRecordingsConfig(MeasuredConfig):
    """Amplitudes and phases over the speed, CSV or Excel: wide (two columns a probe) or long (a row a probe)."""

    format: Literal["table"]
    layout: Literal["wide", "long"]
    conventions: ConventionsConfig
    columns: TableColumnsConfig
    csv: CsvConfig = CsvConfig()
    tacho: TachoAngleConfig = TachoAngleConfig()
    probes: dict[str, TableProbeConfig] = Field(min_length=1)
    runs: tuple[TableRunConfig, ...] = Field(min_length=1)
    leave_out: tuple[str, ...] = ()

    @rule
    def _lawful(self) -> Iterator[str]:
        yield from self.check_units(self.conventions.unit)
        for run in self.runs:
            for name, probe in self.probes.items():
                if self.layout == "wide" and not probe.columns and name not in run.columns:
                    yield f"probe '{name}' must have columns in the wide layout, but it has none"
                pair = run.columns.get(name) or probe.columns
                if pair and pair.amplitude == pair.phase:
                    yield f"probe '{name}' must have another column of phases than '{pair.amplitude}', but has none"
            pairs = [run.columns.get(name) or probe.columns for name, probe in self.probes.items()]
            for column, times in Counter(pair.amplitude for pair in pairs if pair).items():
                if times > 1:
                    yield f"each probe must have columns of its own, but {times} have '{column}': correct one"

    def describe(self) -> str:
        """What the numbers in the files are taken for."""
        said = self.conventions
        return (
            f"{said.unit}, {said.amplitude.replace('_', '-')}, phase {said.phase} in {said.phase_unit}, speed in "
            f"{said.speed}"
        )

    def read_run(self, run: TableRunConfig, path: Path) -> RunTracks:
        """The 1X vectors of a run.

        Raises DataError; see :func:`pipeline.data.tables.read_table` for what a table must be.
        """
        named, wide = self.columns, self.layout == "wide"
        pairs: dict[str, ColumnPairConfig | TableColumnsConfig] = {
            name: (wide and (run.columns.get(name) or probe.columns)) or named for name, probe in self.probes.items()
        }
        columns = [column for pair in pairs.values() for column in (pair.amplitude, pair.phase)]
        columns += [condition.column for condition in named.conditions.values()]
        labels = {} if wide else {named.run: "text", named.probe: "text"}
        kinds, text = labels | dict.fromkeys((named.speed, *columns), "number"), self.csv.on(run.sheet)
        table = read_table(path, kinds, text=text)
        table = table if wide else _select_run(self, run, table, path)
        tracks, phases = {}, []
        for name, pair in pairs.items():
            rows, where = table, f"'{path}'"
            if not wide:
                label = self.probes[name].label or name
                law = f"'{path}' must have rows of probe '{label}' in run '{run.name}'"
                rows, where = _select(table, named.probe, label, law), f"'{path}', run '{run.name}', probe '{label}',"
            tracks[name] = _make_track(self, run, name, rows, pair, where)
            phases.append(rows[pair.phase])
        notes = describe_format(path, kinds, text) + note_cut(path) if is_csv(path) else ()
        notes += _note_unit(np.concatenate(phases), self.conventions.phase_unit, path)
        speeds, at = np.unique(table[named.speed], return_inverse=True)
        conditions = {  # the mean of the rows of a speed
            name: (
                speeds * RAD_S[self.conventions.speed],
                np.bincount(at.ravel(), condition.to_si(table[condition.column])) / np.bincount(at.ravel()),
            )
            for name, condition in named.conditions.items()
        }
        return RunTracks(run.name, f"'{path}'", tracks, tracks, notes, conditions=conditions)


def _select_run(config: TableRecordingsConfig, run: TableRunConfig, table: Columns, path: Path) -> Columns:
    """The rows of a run of the long layout. Raises DataError where there are none, and for runs that nobody named."""
    column, known = config.columns.run, {run.name for run in config.runs} | set(config.leave_out)
    strange = [name for name in dict.fromkeys(table[column]) if name not in known]
    if strange:
        raise DataError(
            f"machine.recordings.runs must name every run of '{path}' with what excited it, but '{strange[0]}' is not "
            "among them: add it (or name it as machine.recordings.baseline too), or put it into "
            "machine.recordings.leave_out"
        )
    return _select(table, column, run.name, f"'{path}' must have rows of run '{run.name}' in the column '{column}'")


def _select(table: Columns, name: str, value: str, law: str) -> Columns:
    rows = table[name] == value
    if not rows.any():
        raise DataError(f"{law}, but it has {nearest(value, set(table[name]))}")
    return {column: values[rows] for column, values in table.items()}


def _make_track(
    config: TableRecordingsConfig,
    run: TableRunConfig,
    probe: str,
    table: Columns,
    pair: ColumnPairConfig | TableColumnsConfig,
    where: str,
) -> Track:
    said, amplitude, phase = config.conventions, table[pair.amplitude], table[pair.phase]
    if (amplitude < 0).any():
        raise DataError(
            f"{where} must have amplitudes of zero or more in the column '{pair.amplitude}', but got "
            f"{amplitude.min():g}: write it positive, with its phase turned by 180 deg"
        )
    angle = np.radians(phase) if said.phase_unit == "deg" else phase
    speeds, values = table[config.columns.speed] * RAD_S[said.speed], amplitude * np.exp(1j * angle)
    shown = read_vectors(values, said, config.probes[probe].scale, find_frequencies(run, speeds))
    return sort_track(speeds, shown, where, at_rest=bool(run.frequency_hz))


def _note_unit(phases: np.ndarray, unit: str, path: Path, broad: float = 2.0) -> tuple[str, ...]:
    """A note on phases, as in the file, that look like the other unit.

    Those that differ by more than ``broad`` pass a resonance if they are radians, and hardly differ if degrees.
    """
    largest = np.abs(phases).max()
    if unit == "deg" and largest <= 2 * np.pi and np.ptp(phases) > broad:
        said, other = "degrees", "radians (machine.recordings.conventions.phase_unit=rad)"
    elif unit == "rad" and largest > 6 * np.pi:
        said, other = "radians", "degrees (machine.recordings.conventions.phase_unit=deg)"
    else:
        return ()
    span = f"{write_number(phases.min(), digits=3)} to {write_number(phases.max(), digits=3)}"
    return (f"'{path}' has phases from {span} that are said to be {said}: are they in {other}?",)


def note_cut(path: Path) -> tuple[str, ...]:
    """A note on a CSV file whose last row may lack digits: nothing else shows it."""
    with path.open("rb") as file:
        file.seek(-1, 2)
        last = file.read(1)
    if last in b"\r\n":
        return ()
    return (f"'{path}' does not end with the end of a line: if it was cut off, its last row may be wrong",)
