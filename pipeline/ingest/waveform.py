"""Recordings with a tacho, and the 1X vectors of each run in them."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import Field, PositiveFloat, PositiveInt

from pipeline.config.measured import (
    MeasuredConfig,
    MeasuredProbeConfig,
    MeasuredRunConfig,
    OrderTrackingConfig,
    TachoAngleConfig,
)
from pipeline.config.motion import Unit, to_motion
from pipeline.config.quantities import Frequency
from pipeline.config.section import Section, Text, rule
from pipeline.data.csv_format import CsvConfig, describe_format
from pipeline.errors import DataError
from pipeline.files import hash_file, hash_parts, keep, look_up
from pipeline.ingest.conventions import to_displacement
from pipeline.ingest.order_tracking import Signals, find_range, fit_steady, fit_sweep
from pipeline.ingest.plausibility import note_clipping
from pipeline.ingest.recordings import Channels, read_recording
from pipeline.ingest.table import note_cut
from pipeline.ingest.tacho import find_pulses, fit_angle
from pipeline.ingest.tracks import RunTracks, Track, format_rpm, sort_track, unpack_tracks
from pipeline.units import RAD_S_PER_RPM
from pipeline.write_numbers import write_rough

Edge = Literal["rising", "falling"]
_MADE_BY = sorted(
    path for room in ("config", "data", "ingest") for path in Path(__file__).parents[1].glob(f"{room}/*.py")
)
"""What makes tracks of signals, beside NumPy."""


@dataclass(frozen=True, eq=False)
class Loaded:
    """What a file of a run has, sampled together: the signals of the probes and of the tacho, and sentences on it."""

    time: np.ndarray  # (n,) s, ascending
    signals: dict[str, np.ndarray]  # by probe, (n,) in the file's numbers
    tacho: tuple[tuple[str, np.ndarray], ...]  # channel and (n,): of the marks, if there is one, and of the pulses
    pulses_per_revolution: int = 1
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
    """The pulses of time signals: ``edge`` is the one at which the mark stands at the probe.

    ``threshold`` and ``hysteresis`` are in the channel's own numbers; null: from its levels.
    """

    edge: Edge | None = None
    threshold: float | None = None
    hysteresis: PositiveFloat | None = None


class SignalConfig(MeasuredConfig):
    """Time signals: in one unit, of records at constant speed or of a run-up or run-down."""

    signal_unit: Unit | None = None
    records: Literal["constant_speed", "run_up"] | None = None
    tracking: OrderTrackingConfig = OrderTrackingConfig()

    tacho: TachoSignalConfig = TachoSignalConfig()

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
        """The 1X vectors of all runs, fitted to time signals, and kept: what acted in a run may change without them.

        Raises DataError; see :mod:`pipeline.ingest.recordings`, :mod:`pipeline.ingest.tacho` and
        :mod:`pipeline.ingest.order_tracking`.
        """
        runs, fit = [], _fit_records if self.records == "constant_speed" else _fit_sweep
        for run in self.runs:
            paths = [Path(source) for source in run.sources(self.file)]
            key = hash_parts(
                self.model_dump_json(exclude={"runs"}),
                run.model_dump_json(exclude={"unbalances", "forces"}),
                *map(hash_file, paths),
                np.__version__,
                *(path.read_bytes() for path in _MADE_BY),
            )
            content = look_up("tracks", key)
            if not content:
                source = f"'{paths[0]}'" + (f" and {len(paths) - 1} more" if len(paths) > 1 else "")
                records = (_read(self, run, path) for path in paths)  # one at a time: they are large
                content = fit(self, run.name, source, records).pack()
                keep("tracks", key, content)
            runs.append(unpack_tracks(content))
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
        return [_read(self, run, Path(source)) for source in run.sources(self.file)]


class TachoConfig(TachoSignalConfig):
    """Pulses of the shaft: ``edge`` is the one at which the mark stands at the probe.

    ``threshold`` and ``hysteresis`` are in the channel's own numbers; null: from its levels. With several pulses a
    revolution, ``mark_channel`` has the one pulse a revolution that tells which of them is the mark.
    """

    channel: Text
    edge: Edge
    pulses_per_revolution: PositiveInt = 1
    mark_channel: Text | None = None

    @rule
    def _marked(self) -> Iterator[str]:
        if self.pulses_per_revolution > 1 and not self.mark_channel:
            yield (
                f"must give mark_channel where there are {self.pulses_per_revolution} pulses a revolution "
                "(phases would be relative to any of them), but it is null: give the channel with one pulse a "
                "revolution"
            )


class WaveformProbeConfig(MeasuredProbeConfig):
    """``channel``: a CSV column, an HDF5 path or TDMS ``group/channel``."""

    channel: Text


class WaveformRunConfig(SignalRunConfig):
    """``channels``: of probes that are called otherwise in this run's files; ``tacho``: its tacho channel."""

    channels: dict[str, Text] = Field(default_factory=dict)
    tacho: Text | None = None
    sample_rate: Frequency | None = None


class StoredSignalsConfig(Section):
    """Time signals in CSV, Excel, HDF5 or TDMS, by the file's ending.

    Time is a channel (``time``), ``sample_rate``, the HDF5 attribute ``sample_rate_attribute`` in Hz, or TDMS's own.
    """

    time: Text | None = None
    time_unit: Literal["s", "ms", "us"] | None = None
    sample_rate: Frequency | None = None
    sample_rate_attribute: Text | None = None
    csv: CsvConfig = CsvConfig()

    @rule
    def _timed(self) -> Iterator[str]:
        rates = [self.time, self.sample_rate, self.sample_rate_attribute]
        if sum(map(bool, rates)) > 1:
            yield "must give at most one of time, sample_rate and sample_rate_attribute, but got several"
        if self.time and not self.time_unit:
            yield "must give time_unit (s, ms or us) of the time channel, but it is missing"

    def read_channels(
        self, path: Path, run: MeasuredRunConfig, wanted: list[str], rate: float | None = None
    ) -> tuple[np.ndarray, Channels, tuple[str, ...]]:
        """Times (n,) s and the ``wanted`` channels (n,) of a file of a run, and what is to be said of the file.

        A ``rate`` (Hz) takes the place of the configured one. Raises DataError.
        """
        text, times = self.csv.on(run.sheet), (self.time, self.time_unit, rate or self.sample_rate)
        time, channels = read_recording(path, wanted, text, *times, self.sample_rate_attribute)
        said = describe_format(path, wanted, text) + note_cut(path) if path.suffix.lower() in (".csv", ".txt") else ()
        return time, channels, said


class WaveformRecordingsConfig(StoredSignalsConfig, SignalConfig):
    """Time signals with a tacho."""

    format: Literal["waveform"]
    tacho: TachoConfig
    probes: dict[str, WaveformProbeConfig] = Field(min_length=1)
    runs: tuple[WaveformRunConfig, ...] = Field(min_length=1)

    @rule
    def _lawful(self) -> Iterator[str]:
        yield from self.check_signals()
        for run in self.runs:
            if run.sample_rate and self.time:
                yield f"run '{run.name}' must have no sample_rate where there is a time channel, but it has"

    def load(self, run: WaveformRunConfig, path: Path) -> Loaded:
        """One file of a run. Raises DataError."""
        tacho = [name for name in (self.tacho.mark_channel, run.tacho or self.tacho.channel) if name]
        names = {name: run.channels.get(name, probe.channel) for name, probe in self.probes.items()}
        time, channels, said = self.read_channels(path, run, [*names.values(), *reversed(tacho)], run.sample_rate)
        return Loaded(
            time,
            {name: channels[channel] for name, channel in names.items()},
            tuple((name, channels[name]) for name in tacho),
            self.tacho.pulses_per_revolution,
            said,
        )


def _fit_records(
    config: SignalConfig, name: str, source: str, records: Iterable[Signals], seen_error: float = np.radians(0.1)
) -> RunTracks:
    """Fit one vector for each record; phases that may be off by more than ``seen_error`` (rad) are named."""
    speeds: list[float] = []
    vectors: list[np.ndarray] = []
    notes: list[str] = []
    for record in records:
        speed, steady = fit_steady(record, config.tracking)
        speeds.append(speed)
        vectors.append(steady)
        notes += record.notes
        error = speed * record.late
        if error > seen_error:
            notes.append(
                f"{record.where} has tacho edges that are sharper than the sampling, at a whole number of "
                f"samples a revolution: all its phases may be off by {write_rough(np.degrees(error))} deg together"
            )
    tracks = _make_tracks(config, np.array(speeds), np.array(vectors), f"run '{name}'")
    return RunTracks(name, source, tracks, tracks, tuple(notes))


def _fit_sweep(
    config: SignalConfig, name: str, source: str, records: Iterable[Signals], slow_windows: int = 10
) -> RunTracks:
    """Fit vectors to a single record at the wanted speeds that it covers, and at so many low ones for the slow roll."""
    assert config.speeds  # the schema has seen to it
    (record,), wanted = records, config.speeds.rad_s()
    low, high = find_range(record, config.tracking)
    inside = (wanted > low * (1 - 1e-6)) & (wanted < high * (1 + 1e-6))
    wanted = wanted[inside] if inside.any() else wanted
    vectors, times = fit_sweep(record, wanted, config.tracking)
    tracks = _make_tracks(config, wanted, vectors, record.where)
    slow: dict[str, Track] = {}
    if config.slow_roll and config.slow_roll.below_rpm:
        limit = config.slow_roll.below_rpm * RAD_S_PER_RPM
        if low >= limit:
            raise DataError(
                f"{record.where} must have data below machine.recordings.slow_roll.below_rpm="
                f"{config.slow_roll.below_rpm:g}, but windows fit from {format_rpm(low)} rpm on: give a larger one, "
                "or slow_roll.vectors"
            )
        below = np.linspace(low, limit, slow_windows, endpoint=False)
        slow = _make_tracks(config, below, fit_sweep(record, below, config.tracking)[0], record.where)
    return RunTracks(name, source, tracks, slow, record.notes, times)


def _read(config: SignalConfig, run: MeasuredRunConfig, path: Path) -> Signals:
    """The signals of a file in m, m/s or m/s^2, the probes in their order."""
    where, loaded, tacho = f"'{path}' (run '{run.name}')", config.load(run, path), config.tacho
    pulses = [
        find_pulses(
            loaded.time,
            signal,
            tacho.edge or "rising",
            tacho.threshold,
            tacho.hysteresis,
            f"{where}, channel '{name}',",
        )
        for name, signal in loaded.tacho
    ]
    marks = pulses[0][0] if len(pulses) > 1 else None
    times, late = pulses[-1]
    angle = fit_angle(times, loaded.pulses_per_revolution, f"{where}, channel '{loaded.tacho[-1][0]}',", marks)
    notes = loaded.notes + tuple(note_clipping(where, loaded.signals))
    sizes = np.array([to_motion(config.signal_unit or "", probe.scale)[1] for probe in config.probes.values()])
    # A long record is not held twice: a signal leaves when it is taken over.
    values = np.empty((len(sizes), len(loaded.time)), np.result_type(*loaded.signals.values())).T
    for p, name in enumerate(config.probes):
        values[:, p] = loaded.signals.pop(name)
    return Signals(loaded.time, values, angle, where, late, notes, sizes)


def _make_tracks(config: SignalConfig, speeds: np.ndarray, vectors: np.ndarray, where: str) -> dict[str, Track]:
    """By probe, of ``vectors`` (S, P) in m, m/s or m/s^2 at ``speeds`` (S,) rad/s."""
    orders = [to_motion(config.signal_unit or "", probe.scale)[0] for probe in config.probes.values()]
    return {
        name: sort_track(speeds, to_displacement(vectors[:, p], orders[p], speeds), f"{where}, probe '{name}',")
        for p, name in enumerate(config.probes)
    }
