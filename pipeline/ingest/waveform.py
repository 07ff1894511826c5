"""Recordings with a tacho, and the 1X vectors of each run in them."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from pydantic import Field, PositiveFloat, PositiveInt

from pipeline.config.measured import (
    MeasuredConfig,
    MeasuredRunConfig,
    OrderTrackingConfig,
    ProbeConfig,
    TachoAngleConfig,
    Text,
)
from pipeline.config.motion import SignalUnit, to_motion
from pipeline.config.quantities import Frequency
from pipeline.config.section import rule
from pipeline.data.tables import CsvConfig
from pipeline.errors import DataError
from pipeline.ingest.conventions import to_displacement
from pipeline.ingest.order_tracking import Signals, find_passages, find_range, fit_steady, fit_sweep
from pipeline.ingest.plausibility import note_clipping
from pipeline.ingest.recordings import Clock, Recording, read_recording
from pipeline.ingest.table import note_cut
from pipeline.ingest.tacho import Pulses, find_pulses, fit_angle
from pipeline.ingest.tracks import RunTracks, Track, format_rpm, sort_track
from pipeline.units import RAD_S_PER_RPM

Edge = Literal["rising", "falling"]


@dataclass(frozen=True, eq=False)
class Loaded:
    """What a file of a run has: all channels, which of them the probes and the tacho are, and sentences on it."""

    recording: Recording
    signals: Mapping[str, np.ndarray]  # by probe, (n,) in the file's numbers
    tacho: str  # the channel with its pulses
    notes: tuple[str, ...] = ()


class SignalRunConfig(MeasuredRunConfig):
    """``files``: one a speed, where each is a record at constant speed."""

    files: tuple[Text, ...] = ()

    def sources(self, file: str | None) -> tuple[str, ...]:
        """The files of this run; ``file`` is that of the runs that name none. Raises ValueError for two answers."""
        if self.files and self.file:
            raise ValueError(f"run '{self.name}' must have file or files, but it has both")
        return self.files or super().sources(file)


class TachoSignalConfig(TachoAngleConfig):
    """What is asked of the tacho of time signals."""

    if TYPE_CHECKING:  # each format has its own

        @property
        def edge(self) -> Edge | None:
            """The one at which the mark stands at the probe."""

        @property
        def threshold(self) -> float | None:
            """In the channel's own numbers; None: from its levels."""

        @property
        def hysteresis(self) -> float | None:
            """In the channel's own numbers; None: from its levels."""

        @property
        def mark_channel(self) -> str | None:
            """The channel with one pulse a revolution where the tacho has several."""

        @property
        def pulses_per_revolution(self) -> int:
            """Those of the tacho."""


class SignalConfig(MeasuredConfig):
    """Time signals: in one unit, of records at constant speed or of a run-up or run-down."""

    signal_unit: SignalUnit | None = None
    records: Literal["constant_speed", "run_up"] | None = None
    tracking: OrderTrackingConfig = OrderTrackingConfig()

    if TYPE_CHECKING:

        @property
        def tacho(self) -> TachoSignalConfig:
            """Its angle, and its pulses."""

    def check_signals(self) -> Iterator[str]:
        """What is wrong with what time signals need."""
        if not self.signal_unit:
            yield "must give signal_unit (V, mV, um ...) for time signals, but it is missing"
        if not self.records:
            yield "must give records (constant_speed or run_up) for time signals, but it is missing"
        if self.records == "run_up" and not self.speeds:
            yield "must give speeds (start_rpm, stop_rpm, step_rpm) to track in a run-up, but got null"
        yield from self.check_units(self.signal_unit or "")
        for run in self.runs:
            count = len(run.sources(self.file))
            if count > 1 and self.records == "run_up":
                yield f"run '{run.name}' must have one file for a run-up, but it has {count}"

    @property
    def most_lag(self) -> float:
        """The share of its speed by which a swept peak may lag."""
        return self.tracking.most_lag

    @abstractmethod
    def load(self, run: Any, path: Path) -> Loaded:
        """One file of a run, which is of the format's own class. Raises DataError."""

    def describe(self) -> str:
        """What the numbers in the files are taken for."""
        records = "records at constant speed" if self.records == "constant_speed" else "run-ups"
        return f"time signals in {self.signal_unit}, {records}, tacho edge {self.tacho.edge}"

    def read(self) -> tuple[RunTracks, ...]:
        """The 1X vectors of all runs, fitted to time signals.

        Raises DataError; see :mod:`pipeline.ingest.recordings`, :mod:`pipeline.ingest.tacho` and
        :mod:`pipeline.ingest.order_tracking`.
        """
        runs = []
        for run in self.runs:
            paths = [Path(source) for source in run.sources(self.file)]
            source = f"'{paths[0]}'" + (f" and {len(paths) - 1} more" if len(paths) > 1 else "")
            records = (_read(self, run, path) for path in paths)  # one at a time: they are large
            if self.records == "constant_speed":
                runs.append(_fit_records(self, run.name, source, records))
            else:
                runs.append(_fit_sweep(self, run.name, source, next(records)))
        return tuple(runs)

    def read_signals(self, run: MeasuredRunConfig) -> list[Signals]:
        """The time signals of a run, a value a file, in m.

        Raises DataError as :meth:`read`, and where a probe measures something else: only its 1X vectors become
        displacements.
        """
        for name, probe in self.probes.items():
            if to_motion(self.signal_unit or "", probe.scale)[0]:
                raise DataError(
                    f"time signals must be displacements to be drawn, but probe '{name}' measures another motion"
                )
        return [_read(self, run, Path(source)).signals for source in run.sources(self.file)]


class TachoConfig(TachoSignalConfig):
    """Pulses of the shaft: ``edge`` is the one at which the mark stands at the probe.

    ``threshold`` and ``hysteresis`` are in the channel's own numbers; null: from its levels. With several pulses a
    revolution, ``mark_channel`` has the one pulse a revolution that tells which of them is the mark.
    """

    channel: Text
    edge: Edge
    pulses_per_revolution: PositiveInt = 1
    threshold: float | None = None
    hysteresis: PositiveFloat | None = None
    mark_channel: Text | None = None

    @rule
    def _marked(self) -> Iterator[str]:
        if self.pulses_per_revolution > 1 and not self.mark_channel:
            yield (
                f"must give mark_channel where there are {self.pulses_per_revolution} pulses a revolution "
                "(phases would "
                "be relative to any of them), but it is null: give the channel with one pulse a revolution"
            )


class WaveformProbeConfig(ProbeConfig):
    """``channel``: a CSV column, an HDF5 path or TDMS ``group/channel``."""

    channel: Text


class WaveformRunConfig(SignalRunConfig):
    """``channels``: of probes that are called otherwise in this run's files; ``tacho``: its tacho channel."""

    channels: dict[str, Text] = Field(default_factory=dict)
    tacho: Text | None = None
    sample_rate: Frequency | None = None


class WaveformRecordingsConfig(SignalConfig):
    """Time signals with a tacho: CSV, Excel, HDF5 or TDMS, by the file's ending.

    Time is a channel (``time``), ``sample_rate``, the HDF5 attribute ``sample_rate_attribute`` in Hz, or TDMS's own.
    """

    format: Literal["waveform"]
    tacho: TachoConfig
    time: Text | None = None
    time_unit: Literal["s", "ms", "us"] | None = None
    sample_rate: Frequency | None = None
    sample_rate_attribute: Text | None = None
    csv: CsvConfig = CsvConfig()
    probes: dict[str, WaveformProbeConfig] = Field(min_length=1)
    runs: tuple[WaveformRunConfig, ...] = Field(min_length=1)

    @rule
    def _lawful(self) -> Iterator[str]:
        yield from self.check_signals()
        rates = [self.time, self.sample_rate, self.sample_rate_attribute]
        if sum(map(bool, rates)) > 1:
            yield "must give at most one of time, sample_rate and sample_rate_attribute, but got several"
        if self.time and not self.time_unit:
            yield "must give time_unit (s, ms or us) of the time channel, but it is missing"
        for run in self.runs:
            if run.sample_rate and self.time:
                yield f"run '{run.name}' must have no sample_rate where there is a time channel, but it has"

    def load(self, run: WaveformRunConfig, path: Path) -> Loaded:
        """One file of a run. Raises DataError."""
        tacho, marks = run.tacho or self.tacho.channel, [self.tacho.mark_channel] if self.tacho.mark_channel else []
        names = {name: run.channels.get(name, probe.channel) for name, probe in self.probes.items()}
        clock = Clock(self.time, self.time_unit, run.sample_rate or self.sample_rate, self.sample_rate_attribute)
        recording = read_recording(path, [*names.values(), tacho, *marks], clock, self.csv)
        notes = note_cut(path) if path.suffix.lower() in (".csv", ".txt") else ()
        return Loaded(recording, {name: recording.channels[channel] for name, channel in names.items()}, tacho, notes)


@dataclass(frozen=True, eq=False)
class _Record:
    """One file: its signals, and sentences that need attention."""

    signals: Signals
    pulses: Pulses
    notes: tuple[str, ...]


def _fit_records(
    config: SignalConfig, name: str, source: str, records: Iterable[_Record], seen_error: float = np.radians(0.1)
) -> RunTracks:
    """Fit one vector for each record; phases that may be off by more than ``seen_error`` (rad) are named."""
    speeds: list[float] = []
    vectors: list[np.ndarray] = []
    notes: list[str] = []
    for record in records:
        speed, steady = fit_steady(record.signals, config.tracking)
        speeds.append(speed)
        vectors.append(steady)
        notes += record.notes
        error = speed * record.pulses.locked_error()
        if error > seen_error:
            notes.append(
                f"{record.signals.where} has tacho edges that are sharper than the sampling, at a whole number of "
                f"samples a revolution: all its phases may be off by {np.degrees(error):.2g} deg together"
            )
    tracks = {
        probe: _make_track(config, probe, np.array(speeds), np.array(vectors)[:, p], f"run '{name}'")
        for p, probe in enumerate(config.probes)
    }
    return RunTracks(name, source, tracks, tracks, tuple(notes))


def _fit_sweep(config: SignalConfig, name: str, source: str, record: _Record, slow_windows: int = 10) -> RunTracks:
    """Fit vectors at the wanted speeds, and at so many low ones for the slow roll."""
    assert config.speeds  # the schema has seen to it
    wanted = np.array(config.speeds.rpm()) * RAD_S_PER_RPM
    tracks = _track(config, record, wanted)
    slow: dict[str, Track] = {}
    if config.slow_roll and config.slow_roll.below_rpm:
        limit = config.slow_roll.below_rpm * RAD_S_PER_RPM
        lowest, _ = find_range(record.signals, config.tracking)
        if lowest >= limit:
            raise DataError(
                f"{record.signals.where} must have data below machine.recordings.slow_roll.below_rpm="
                f"{config.slow_roll.below_rpm:g}, but windows fit from {format_rpm(lowest)} rpm on: give a larger one, "
                "or slow_roll.vectors"
            )
        slow = _track(config, record, np.linspace(lowest, limit, slow_windows, endpoint=False))
    times = find_passages(record.signals.between_pulses(), np.sort(wanted), config.tracking)
    return RunTracks(name, source, tracks, slow, record.notes, times)


def _track(config: SignalConfig, record: _Record, speeds: np.ndarray) -> dict[str, Track]:
    vectors = fit_sweep(record.signals, speeds, config.tracking)
    return {
        probe: _make_track(config, probe, speeds, vectors[:, p], f"{record.signals.where}, probe '{probe}',")
        for p, probe in enumerate(config.probes)
    }


def _read(config: SignalConfig, run: MeasuredRunConfig, path: Path) -> _Record:
    where, loaded = f"'{path}' (run '{run.name}')", config.load(run, path)
    marks = config.tacho.mark_channel
    once = _find_pulses(config, loaded.recording, marks, f"{where}, channel '{marks}',").times if marks else None
    named = f"{where}, channel '{loaded.tacho}',"
    pulses = _find_pulses(config, loaded.recording, loaded.tacho, named)
    angle = fit_angle(pulses.times, config.tacho.pulses_per_revolution, named, once)
    notes = loaded.notes + tuple(note_clipping(where, loaded.signals))
    return _Record(Signals(loaded.recording.time, _to_si(config, loaded.signals), angle, where), pulses, notes)


def _find_pulses(config: SignalConfig, recording: Recording, channel: str, where: str) -> Pulses:
    tacho = config.tacho
    signal = recording.channels[channel]
    return find_pulses(recording.time, signal, tacho.edge or "rising", tacho.threshold, tacho.hysteresis, where)


def _to_si(config: SignalConfig, values: Mapping[str, np.ndarray]) -> np.ndarray:
    """(n, P) m, m/s or m/s^2, of the probes in their order."""
    unit = config.signal_unit or ""
    return np.stack([values[name] * to_motion(unit, probe.scale)[1] for name, probe in config.probes.items()], axis=1)


def _make_track(config: SignalConfig, probe: str, speeds: np.ndarray, vectors: np.ndarray, where: str) -> Track:
    order, _ = to_motion(config.signal_unit or "", config.probes[probe].scale)
    return sort_track(speeds, to_displacement(vectors, order, speeds), where)
