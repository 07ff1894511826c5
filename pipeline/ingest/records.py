"""A table of records: its rows as vectors of the probes and weights of the planes, and as a data set.

Legend: n records, S nominal speeds, P probes, N planes, R runs.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BeforeValidator, Field

from pipeline.config.measured import (
    MeasuredConfig,
    MeasuredProbeConfig,
    MeasuredRunConfig,
    TachoAngleConfig,
    VectorConventionsConfig,
)
from pipeline.config.quantities import to_si
from pipeline.config.section import NonNegativeInt, Section, Text, rule
from pipeline.data.csv_format import CsvConfig
from pipeline.data.dataset import SYNCHRONOUS, Excitation, VibrationDataset, place_rows
from pipeline.data.tables import read_table
from pipeline.errors import DataError
from pipeline.ingest.conventions import RAD_S, describe_vectors, read_vectors
from pipeline.ingest.tracks import LARGEST, format_rpm
from pipeline.write_numbers import write_number


class ComplexColumnsConfig(Section):
    """The two columns of a complex number."""

    real: Text
    imaginary: Text


class RecordProbeConfig(MeasuredProbeConfig):
    """A probe with its columns."""

    columns: ComplexColumnsConfig


def _check_unit(value: Any) -> str:
    to_si(f"1 {value}", "kg * m", "100 g mm")
    return str(value)


class RecordWeightConfig(Section):
    """The weight that was on one plane in each record: complex, in ``unit``, its angle as ``shaft_angle`` says."""

    node: NonNegativeInt
    unit: Annotated[str, BeforeValidator(_check_unit)]
    columns: ComplexColumnsConfig

    @property
    def size(self) -> float:
        """One unit in kg m."""
        return to_si(f"1 {self.unit}", "kg * m", "100 g mm")


class RecordColumnsConfig(Section):
    """Names of columns. Records of one ``condition`` repeat each other: nothing on the machine was changed."""

    speed: Text
    condition: Text
    record: Text


class RecordsConfig(MeasuredConfig):
    """A table with a row for every record at a constant speed: CSV or Excel.

    Records whose speeds differ by less than :data:`pipeline.data.dataset.SYNCHRONOUS` belong to one nominal speed, and
    keep their own. Each probe stays a channel of its own: its angle may be an uncertain number of the model.
    """

    format: Literal["records"]
    conventions: VectorConventionsConfig
    columns: RecordColumnsConfig
    csv: CsvConfig = CsvConfig()
    tacho: TachoAngleConfig = TachoAngleConfig()
    probes: dict[str, RecordProbeConfig] = Field(min_length=1)
    weights: tuple[RecordWeightConfig, ...] = Field(min_length=1)

    @property
    def vectors(self) -> VectorConventionsConfig:
        """The meaning of the vectors."""
        return self.conventions

    def describe(self) -> str:
        """What the numbers in the files are taken for."""
        return describe_vectors(self.conventions)

    @property
    def planes(self) -> tuple[int, ...]:
        """The nodes of the planes whose weights each record states."""
        return tuple(weight.node for weight in self.weights)

    @property
    def runs(self) -> tuple[MeasuredRunConfig, ...]:
        """None: the table says what the runs are."""
        return ()

    @rule
    def _lawful(self) -> Iterator[str]:
        if not self.file:
            yield "must name the file with the records, but file is missing"
        yield from self.check_angles(
            "angles of weights", "where nobody knows it, give 0 deg and identify.model_parameters.weight_angle"
        )
        for key in ("baseline", "speeds", "slow_roll", "conditions_file", "same_conditions"):
            if getattr(self, key):
                yield f"must have no {key} for a table of records, but it has one: leave it out"
        yield from self.check_units(self.conventions.unit)
        places = [(probe.node, probe.angle, probe.measures) for probe in self.probes.values()]
        if len(set(places)) != len(places):
            yield "must give every probe a place of its own (node and angle), but two have the same"
        nodes = [weight.node for weight in self.weights]
        if len(set(nodes)) != len(nodes):
            yield f"must give every plane of weights once, but weights has the nodes {nodes}"

    def read_records(self, file: str | None = None) -> Records:
        """The records of the configured file, or of another ``file`` with the same columns.

        Columns of probes or of weights that are missing or blank there are read as NaN. Raises DataError.
        """
        path, named = Path(file or self.file or ""), self.columns
        probes = [probe.columns for probe in self.probes.values()]
        weights = [weight.columns for weight in self.weights]
        pairs = [(columns.real, columns.imaginary) for columns in (*probes, *weights)]
        kinds = {named.speed: "number", named.condition: "text", named.record: "text"}
        optional = {name: "number or blank" for pair in pairs for name in pair}
        table = read_table(path, kinds, optional, self.csv)
        blank = np.full(len(table[named.speed]), np.nan)
        parts = [table.get(real, blank) + 1j * table.get(imaginary, blank) for real, imaginary in pairs]
        values = np.stack(parts, axis=1)
        speeds = table[named.speed] * RAD_S[self.conventions.speed]
        if (speeds <= 0).any():
            raise DataError(f"'{path}' must have speeds above zero, but got {format_rpm(speeds.min())} rpm")
        scales = [probe.scale for probe in self.probes.values()]
        seen = [read_vectors(values[:, p], self.conventions, scale, speeds) for p, scale in enumerate(scales)]
        displacement = np.stack(seen, axis=1)
        if np.nanmax(np.abs(displacement), initial=0.0) > LARGEST:
            raise DataError(
                f"'{path}' must have amplitudes below {LARGEST:g} m, but got "
                f"{write_number(np.nanmax(np.abs(displacement)), digits=3)} m: "
                "check machine.recordings.conventions"
            )
        weighed, sizes = values[:, len(scales) :], np.array([weight.size for weight in self.weights])
        angles = np.vectorize(self.angle_from_x)(np.angle(weighed))
        return Records(
            source=f"'{path}'",
            conditions=tuple(table[named.condition].tolist()),
            numbers=tuple(table[named.record].tolist()),
            speeds=speeds,
            probes=tuple(self.probes),
            channels=tuple((probe.node, float(np.degrees(probe.angle)) % 360.0) for probe in self.probes.values()),
            displacement=displacement,
            planes=self.planes,
            unbalance=np.abs(weighed) * sizes * np.exp(1j * angles),
        )


@dataclass(frozen=True, eq=False, kw_only=True)
class Records:
    """The rows of a table, in its order."""

    source: str  # the file, for messages
    conditions: tuple[str, ...]  # n
    numbers: tuple[str, ...]  # n, which record of its condition and speed it is
    speeds: np.ndarray  # (n,) rad/s
    probes: tuple[str, ...]  # P names
    channels: tuple[tuple[int, float], ...]  # P of (node, angle in degrees)
    displacement: np.ndarray  # (n, P) complex, m, zero-to-peak, Q of Re(Q e^{jwt}); NaN where it is blank
    planes: tuple[int, ...]  # N nodes
    unbalance: np.ndarray  # (n, N) complex, kg m e^{jp} with the angle p from x at the pulse; NaN where it is blank


def find_speeds(speeds: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The nominal speeds (S,) of records at ``speeds`` (n,) rad/s, ascending, and the nominal one of each record (n,).

    Speeds that follow each other closely over a wider range than a nominal speed may have stand each for itself.
    """
    ordered = np.sort(speeds)
    starts = np.flatnonzero(np.diff(ordered, prepend=-np.inf) > SYNCHRONOUS * ordered)
    group = np.searchsorted(ordered[starts], speeds, side="right") - 1
    nominal = np.array([speeds[group == s].mean() for s in range(len(starts))])
    wide = np.abs(speeds / nominal[group] - 1) > SYNCHRONOUS
    nominal, group = np.unique(np.where(np.isin(group, group[wide]), speeds, nominal[group]), return_inverse=True)
    return nominal, group


def to_dataset(records: Records, most_places: int = 1_000_000, most_empty: float = 100.0) -> VibrationDataset:
    """The data set with a run for every record of a condition, called ``CONDITION.RECORD``.

    A condition need not have every record at every speed. Raises DataError for blank cells, for a record that is there
    twice at a speed, for a condition with two different weights, and where speeds and runs have more places than
    ``most_places`` and than ``most_empty`` for each record: each would take memory.
    """
    _require_complete(records)
    nominal, group = find_speeds(records.speeds)
    names = [f"{c}.{r}" for c, r in zip(records.conditions, records.numbers, strict=True)]
    runs = tuple(dict.fromkeys(names))
    if len(nominal) * len(runs) > max(most_places, most_empty * len(names)):
        raise DataError(
            f"{records.source} must have records that share speeds or runs, but its {len(names):,} records are of "
            f"{len(runs):,} runs at {len(nominal):,} speeds: give repeated records of a condition the same names "
            "(columns.record), or fewer records"
        )
    place = {run: r for r, run in enumerate(runs)}
    at_run = np.array([place[name] for name in names])
    counts = np.zeros((len(nominal), len(runs)), dtype=int)
    np.add.at(counts, (group, at_run), 1)
    if (counts > 1).any():
        s, r = np.argwhere(counts > 1)[0]
        raise DataError(
            f"{records.source} must have every record of a condition at most once at each speed, but '{runs[r]}' is "
            f"there {counts[s, r]} times near {format_rpm(nominal[s])} rpm: number them apart (columns.record)"
        )
    first = {name: i for i, name in reversed(list(enumerate(names)))}
    conditions = tuple(records.conditions[first[run]] for run in runs)
    excitations = tuple(
        Excitation(run, "unbalance", node, float(np.abs(u)), float(np.angle(u)))
        for run in runs
        for node, u in zip(records.planes, records.unbalance[first[run]], strict=True)
    )
    at = group, slice(None), at_run
    return place_rows(
        nominal, runs, records.channels, at, records.displacement, excitations, records.speeds, conditions=conditions
    )


def _require_complete(records: Records) -> None:
    for values, what in (
        (records.displacement, "the vector of every probe"),
        (records.unbalance, "the weights of every plane"),
    ):
        rows = np.flatnonzero(np.isnan(values).any(axis=1))
        if len(rows):
            raise DataError(
                f"{records.source} must have {what} in every row, but row {rows[0] + 1} has not ({len(rows)} rows in "
                "all): complete it, or leave the row out"
            )
    weights: dict[str, np.ndarray] = {}
    for condition, unbalance in zip(records.conditions, records.unbalance, strict=True):
        if not np.allclose(weights.setdefault(condition, unbalance), unbalance, rtol=1e-6):
            raise DataError(
                f"{records.source} must have the same weights in all records of a condition, but '{condition}' has two"
            )
