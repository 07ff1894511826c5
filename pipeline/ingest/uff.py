"""Universal files, datasets 58: complex functions of the rotor speed, and the time signals of a recording."""

from __future__ import annotations

import json
import re
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import Field

from pipeline.config.measured import MeasuredProbeConfig, MeasuredRunConfig, VectorConventionsConfig
from pipeline.config.motion import KINDS, find_motion, to_motion
from pipeline.config.section import Section, Text, rule
from pipeline.data.mat_files import open_measured
from pipeline.errors import DataError, nearest
from pipeline.ingest.conventions import RAD_S, describe_vectors, read_vectors
from pipeline.ingest.order_tracking import Signals
from pipeline.ingest.recordings import check_channels, check_times
from pipeline.ingest.tracks import RunTracks, sort_track
from pipeline.ingest.waveform import Loaded, SignalConfig, SignalRunConfig, TachoSignalConfig

_MARK = re.compile(rb"    -1(?=[ \t]*(?:[\r\n]|$))")
_TIME, _FREQUENCY, _RPM = 17, 18, 19
_ORDERS = {8: 0, 11: 1, 12: 2}
_HELD = ("displacements", "velocities", "accelerations")
_FORCES = (9, 13)
_ABSCISSA = {_FREQUENCY: ("Hz", "rad/s"), _RPM: ("rpm",)}


class UffRecordConfig(Section):
    """A dataset 58 is found by a text that one of its ID lines or its response entity is, or by its response DOF."""

    record: Text | None = None
    response: tuple[int, int] | None = None


class UffProbeConfig(MeasuredProbeConfig, UffRecordConfig):
    """A probe with its record."""

    @rule
    def _named(self) -> Iterator[str]:
        if not (self.record or self.response):
            yield "must give record (an ID) or response ([node, direction] in the file), but got neither"


class UffTachoConfig(TachoSignalConfig, UffRecordConfig):
    """The record of the tacho, where the file has time signals; see :class:`pipeline.ingest.waveform.TachoConfig`."""

    @property
    def recorded(self) -> bool:
        """True where the file has time signals."""
        return bool(self.record or self.response)


class UffRunConfig(SignalRunConfig):
    """``label``: a text among the ID lines of this run's records, where a file has several runs."""

    label: Text | None = None


class UffRecordingsConfig(SignalConfig):
    """Datasets 58 of universal files: complex functions of the speed, or (with the tacho's record) time signals."""

    format: Literal["uff58"]
    conventions: VectorConventionsConfig | None = None
    tacho: UffTachoConfig = UffTachoConfig()
    probes: dict[str, UffProbeConfig] = Field(min_length=1)
    runs: tuple[UffRunConfig, ...] = Field(min_length=1)

    @rule
    def _lawful(self) -> Iterator[str]:
        if not self.tacho.recorded:
            if not self.conventions:
                yield (
                    "must give conventions (length, amplitude, phase, speed) for functions of the speed, but they are "
                    "missing: give them, or the tacho's record for time signals"
                )
            else:
                yield from self.check_units(self.conventions.unit)
            if any(run.files for run in self.runs):
                yield "must give one file a run for functions of the speed, but a run has files"
            return
        if self.conventions:
            yield "must leave conventions out for time signals (signal_unit and scale say all), but it has"
        if not self.tacho.edge:
            yield "must give tacho.edge (rising or falling) where the tacho is recorded, but it is missing"
        yield from self.check_signals()

    def describe(self) -> str:
        """What the numbers in the files are taken for."""
        return describe_vectors(self.conventions) if self.conventions else super().describe()

    def read(self) -> tuple[RunTracks, ...]:
        """The 1X vectors of all runs, of complex functions of the speed or of time signals. Raises DataError."""
        if not self.conventions:
            return super().read()
        paths = [Path(run.sources(self.file)[0]) for run in self.runs]
        files = {path: read_uff(path) for path in dict.fromkeys(paths)}
        return tuple(
            _read_functions(self, self.conventions, run, path, *files[path])
            for run, path in zip(self.runs, paths, strict=True)
        )

    def read_signals(self, run: MeasuredRunConfig) -> list[Signals]:
        """The time signals of a run, a value a file, in m; none of functions of the speed. Raises DataError."""
        return super().read_signals(run) if self.tacho.recorded else []

    def load(self, run: UffRunConfig, path: Path) -> Loaded:
        """One file of a run. Raises DataError."""
        (stored, _), tacho = read_uff(path), "the tacho"
        records = {
            name: find_record(path, stored, probe, run.label, f"probe '{name}' in run '{run.name}'")
            for name, probe in self.probes.items()
        }
        pulses = find_record(path, stored, self.tacho, run.label, f"the tacho in run '{run.name}'")
        for record in (*records.values(), pulses):
            where = f"'{path}', record {record.name},"
            if np.iscomplexobj(record.values) or record.abscissa_type in (_FREQUENCY, _RPM):
                raise DataError(
                    f"{where} must be a time signal (machine.recordings.tacho has a record), but it is a function of "
                    "the speed or the frequency: give machine.recordings.conventions, and the tacho no record"
                )
            if len(record.abscissa) != len(pulses.abscissa) or not np.allclose(record.abscissa, pulses.abscissa):
                raise DataError(f"{where} must have the same times as the tacho {pulses.name}, but it has others")
        for name, record in records.items():
            order, _ = to_motion(self.signal_unit or "", self.probes[name].scale)
            _check_content(record, order, f"'{path}', record {record.name},")
        signals = {name: record.values for name, record in records.items()}
        check_channels(path, signals | {tacho: pulses.values, "time": pulses.abscissa})
        return Loaded(check_times(path, "time", pulses.abscissa), signals, ((tacho, pulses.values),))


@dataclass(frozen=True, eq=False, kw_only=True)
class UffRecord:
    """One dataset 58."""

    texts: tuple[str, ...]  # ID lines and response entity
    response: tuple[int, int]  # node and direction in the file
    abscissa: np.ndarray  # (n,)
    values: np.ndarray  # (n,) real or complex
    abscissa_type: int
    abscissa_label: str
    ordinate_type: int
    ordinate_label: str
    denominator_type: int

    def is_called(self, text: str | None) -> bool:
        """True where ``text`` is one of the texts; None is any."""
        return not text or text.strip() in self.texts

    @property
    def name(self) -> str:
        """How messages call the record."""
        return f"{self.texts[0] if self.texts else 'no ID'} {list(self.response)}"


def read_uff(path: Path) -> tuple[tuple[UffRecord, ...], float]:
    """The datasets 58 of a universal file, and the length unit of its dataset 164 in m (0: it has none).

    Raises DataError for a missing, damaged or truncated file, or one without datasets 58.
    """
    import pyuff

    with open_measured(path, "complete universal file"):
        content = path.read_bytes()
        stored = pyuff.UFF(str(path))
        count = int(stored.get_n_sets())
        if len(_MARK.findall(content)) != 2 * count or not content.rstrip().endswith(b"-1"):
            raise DataError(f"'{path}' must be a complete universal file, but it ends within a dataset: copy it again")
        sets: list[dict[str, Any]] = [stored.read_sets(i) for i in range(count)]
    records = tuple(_make_record(path, dataset) for dataset in sets if dataset.get("type") == 58)
    if not records:
        raise DataError(
            f"'{path}' must have datasets 58 (functions at nodal DOF), but it has "
            + (f"datasets {', '.join(str(dataset.get('type')) for dataset in sets[:10])}" if sets else "no dataset")
        )
    units = [dataset for dataset in sets if dataset.get("type") == 164]
    factor = float(units[0].get("length", 0.0)) if units else 0.0
    return records, 1 / factor if factor > 0 else 0.0


def list_records(path: Path) -> tuple[dict[str, str], list[str], bool]:
    """How each record of a run is found, by its name; the labels of the runs; whether they are time signals.

    A label is a text that a record of every response has; what else stands as often as there are runs is the name of
    a record. Raises DataError as :func:`read_uff`.
    """
    records, _ = read_uff(path)
    counts, responses = Counter(text for record in records for text in record.texts), {r.response for r in records}
    holders = {text: {record.response for record in records if record.is_called(text)} for text in counts}
    labels = [text for text in counts if len(holders[text]) == counts[text] == len(responses) < len(records)]
    places = {}
    for record in records:
        name = next((text for text in record.texts if counts[text] == (len(labels) or 1) and text not in labels), "")
        node, direction = record.response
        place = f"record: {json.dumps(name)}" if name else f"response: [{node}, {direction}]"
        places[name or f"node_{node}_{direction}"] = place
    return places, labels, records[0].abscissa_type == _TIME


def find_record(
    path: Path, records: Sequence[UffRecord], wanted: UffRecordConfig, label: str | None, what: str
) -> UffRecord:
    """The one record that fits. Raises DataError where there is none, or more than one."""
    fits = [
        record
        for record in records
        if record.is_called(wanted.record)
        and record.is_called(label)
        and record.response == (wanted.response or record.response)
    ]
    words = " and ".join(
        [f"ID '{text}'" for text in (wanted.record, label) if text]
        + ([f"response {list(wanted.response)}"] if wanted.response else [])
    )
    if not fits:
        every = {text for record in records for text in (*record.texts, str(list(record.response)))}
        asked = wanted.record or label or str(list(wanted.response or ()))
        raise DataError(f"'{path}' must have a record with {words} for {what}, but it has not: {nearest(asked, every)}")
    if len(fits) > 1:
        raise DataError(
            f"'{path}' must have one record with {words} for {what}, but it has {len(fits)}: tell them apart by "
            "the run's label, or by record and response together"
        )
    return fits[0]


def _read_functions(
    config: UffRecordingsConfig,
    said: VectorConventionsConfig,
    run: UffRunConfig,
    path: Path,
    records: Sequence[UffRecord],
    metre: float,
) -> RunTracks:
    tracks, notes = {}, []
    for name, probe in config.probes.items():
        record = find_record(path, records, probe, run.label, f"probe '{name}' in run '{run.name}'")
        where = f"'{path}', record {record.name},"
        if record.abscissa_type == _TIME:
            raise DataError(
                f"{where} must be a function of the speed, but it is one of the time: give the record of the tacho "
                "(machine.recordings.tacho), machine.recordings.signal_unit and machine.recordings.records in place of "
                "machine.recordings.conventions"
            )
        if not np.iscomplexobj(record.values):
            raise DataError(
                f"{where} must have complex values (amplitude and phase), but they are real: export order 1 as complex"
            )
        _check_content(record, to_motion(said.unit, probe.scale)[0], where)
        notes += _note_contradictions(record, metre, said, where)
        speeds = record.abscissa * RAD_S[said.speed]
        tracks[name] = sort_track(speeds, read_vectors(record.values, said, probe.scale, speeds), where)
    return RunTracks(run.name, f"'{path}'", tracks, tracks, tuple(dict.fromkeys(notes)))


def _check_content(record: UffRecord, order: int, where: str) -> None:
    """Raise DataError where the file says that it holds something else than the ``order`` of the configuration."""
    kind = record.ordinate_type
    if kind in _FORCES or _ORDERS.get(kind, order) != order:
        held = "forces" if kind in _FORCES else _HELD[_ORDERS[kind]]
        key = "length" if kind in _FORCES else KINDS[_ORDERS[kind]]
        raise DataError(
            f"{where} must hold {_HELD[order]}, but it says that it holds {held}: give its unit as "
            f"machine.recordings.conventions.{key} (of time signals, signal_unit and scale), or name another record"
        )


def _note_contradictions(record: UffRecord, metre: float, said: VectorConventionsConfig, where: str) -> list[str]:
    """Sentences on what the file says otherwise than the configuration, which is followed."""
    notes = []
    labelled_size, followed = _read_unit(record.ordinate_label), find_motion(said.unit)
    stated = labelled_size or (metre if said.unit != "g" else 0.0)
    if followed and stated and not np.isclose(stated, followed[1], rtol=1e-3):
        text = f"'{record.ordinate_label}'" if labelled_size else f"{stated:g} m (dataset 164)"
        key = KINDS[followed[0]]
        notes.append(
            f"{where} says that its {'lengths are' if key == 'length' else f'{key} is'} in {text}, and "
            f"machine.recordings.conventions.{key} is {said.unit}, which is followed"
        )
    units = _ABSCISSA.get(record.abscissa_type, ())
    label = record.abscissa_label.strip().lower()
    labelled = next((unit for unit in ("rpm", "Hz", "rad/s") if label == unit.lower()), None)
    if (labelled or units) and said.speed not in ((labelled,) if labelled else units):
        notes.append(
            f"{where} says that its abscissa is in {labelled or ' or '.join(units)}, and "
            f"machine.recordings.conventions.speed is {said.speed}, which is followed"
        )
    if record.denominator_type in _FORCES:
        notes.append(f"{where} is per force: its numbers are right for a force of 1 N in this run")
    return notes


def _read_unit(label: str) -> float | None:
    """Size in SI units of what a label names; None where it names nothing that a probe measures."""
    label = re.sub(r"(?i)\s*(pk-?pk|p-?p|0-?p|pk|rms)$", "", label.strip())
    motion = find_motion(label) if re.fullmatch(r"[^\W\d_][^\d_]*\^?2?", label) else None
    return motion[1] if motion else None


def _make_record(path: Path, content: dict[str, Any]) -> UffRecord:
    texts = [str(content.get(key, "")).strip() for key in ("id1", "id2", "id3", "id4", "id5", "rsp_ent_name")]
    record = UffRecord(
        texts=tuple(text for text in texts if text not in ("", "NONE")),
        response=(int(content["rsp_node"]), int(content["rsp_dir"])),
        abscissa=np.asarray(content["x"], dtype=float),
        values=np.asarray(content["data"]),
        abscissa_type=int(content.get("abscissa_spec_data_type", 0)),
        abscissa_label=str(content.get("abscissa_axis_units_lab", "")),
        ordinate_type=int(content.get("ordinate_spec_data_type", 0)),
        ordinate_label=str(content.get("ordinate_axis_units_lab", "")),
        denominator_type=int(content.get("orddenom_spec_data_type", 0)),
    )
    n = int(content["num_pts"])
    if not n == len(record.values) == len(record.abscissa) or n == 0:
        raise DataError(
            f"'{path}' must have {n} values in record {record.name}, as its header says, but it has "
            f"{len(record.values)}: the file is damaged, copy it again"
        )
    if not (np.isfinite(record.abscissa).all() and np.isfinite(record.values).all()):
        raise DataError(f"'{path}' must have finite numbers, but record {record.name} has NaN or infinite ones")
    return record
