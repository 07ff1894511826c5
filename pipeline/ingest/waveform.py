"""Recordings with a tacho, and the 1X vectors of each run in them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pipeline.config.motion import to_motion
from pipeline.config.recordings import UffRecordingsConfig, UffRunConfig, WaveformRecordingsConfig, WaveformRunConfig
from pipeline.errors import DataError
from pipeline.ingest.conventions import to_displacement
from pipeline.ingest.order_tracking import Signals, find_passages, find_range, fit_steady, fit_sweep
from pipeline.ingest.plausibility import note_clipping
from pipeline.ingest.recordings import Clock, Recording, check_recording, read_recording
from pipeline.ingest.table import note_cut, read_format
from pipeline.ingest.tacho import Pulses, find_pulses, fit_angle
from pipeline.ingest.tracks import RunTracks, Track, format_rpm, sort_track
from pipeline.ingest.uff import find_signals
from pipeline.units import RAD_S_PER_RPM

SLOW_WINDOWS = 10
_TACHO = "the tacho"
_SEEN_ERROR = np.radians(0.1)

SignalRecordingsConfig = WaveformRecordingsConfig | UffRecordingsConfig


@dataclass(frozen=True, eq=False)
class _Record:
    """One file: its signals, and sentences that need attention."""

    signals: Signals
    pulses: Pulses
    notes: tuple[str, ...]


def read_signal_runs(config: SignalRecordingsConfig) -> tuple[RunTracks, ...]:
    """The runs of the configuration, their 1X vectors fitted to time signals.

    Raises DataError; see :mod:`pipeline.ingest.recordings`, :mod:`pipeline.ingest.tacho` and
    :mod:`pipeline.ingest.order_tracking`.
    """
    runs = []
    for run in config.runs:
        paths = [Path(source) for source in run.sources(config.file)]
        source = f"'{paths[0]}'" + (f" and {len(paths) - 1} more" if len(paths) > 1 else "")
        records = (_read(config, run, path) for path in paths)  # one at a time: they are large
        if config.records == "constant_speed":
            runs.append(_fit_records(config, run.name, source, records))
        else:
            runs.append(_fit_sweep(config, run.name, source, next(records)))
    return tuple(runs)


def read_signals(config: SignalRecordingsConfig, run: WaveformRunConfig | UffRunConfig) -> list[Signals]:
    """The time signals of a run, a value a file, in m. Raises DataError as :func:`read_signal_runs`.

    And where a probe measures something else: only its 1X vectors become displacements.
    """
    for name, probe in config.probes.items():
        if to_motion(config.signal_unit or "", probe.scale)[0]:
            raise DataError(
                f"time signals must be displacements to be drawn, but probe '{name}' measures another motion"
            )
    return [_read(config, run, Path(source)).signals for source in run.sources(config.file)]


def _fit_records(config: SignalRecordingsConfig, name: str, source: str, records: Iterable[_Record]) -> RunTracks:
    """Fit one vector for each record."""
    speeds: list[float] = []
    vectors: list[np.ndarray] = []
    notes: list[str] = []
    for record in records:
        speed, steady = fit_steady(record.signals, config.tracking)
        speeds.append(speed)
        vectors.append(steady)
        notes += record.notes
        error = speed * record.pulses.locked_error()
        if error > _SEEN_ERROR:
            notes.append(
                f"{record.signals.where} has tacho edges that are sharper than the sampling, at a whole number of "
                f"samples a revolution: all its phases may be off by {np.degrees(error):.2g} deg together"
            )
    tracks = {
        probe: _make_track(config, probe, np.array(speeds), np.array(vectors)[:, p], f"run '{name}'")
        for p, probe in enumerate(config.probes)
    }
    return RunTracks(name, source, tracks, tracks, tuple(notes))


def _fit_sweep(config: SignalRecordingsConfig, name: str, source: str, record: _Record) -> RunTracks:
    """Fit vectors at the wanted speeds, and at low ones for the slow roll."""
    assert config.speeds is not None  # the schema has seen to it
    wanted = np.array(config.speeds.rpm()) * RAD_S_PER_RPM
    tracks = _track(config, record, wanted)
    slow: dict[str, Track] = {}
    if config.slow_roll is not None and config.slow_roll.below_rpm is not None:
        limit = config.slow_roll.below_rpm * RAD_S_PER_RPM
        lowest, _ = find_range(record.signals, config.tracking)
        if lowest >= limit:
            raise DataError(
                f"{record.signals.where} must have data below machine.recordings.slow_roll.below_rpm="
                f"{config.slow_roll.below_rpm:g}, but windows fit from {format_rpm(lowest)} rpm on: give a larger one, "
                "or slow_roll.vectors"
            )
        slow = _track(config, record, np.linspace(lowest, limit, SLOW_WINDOWS, endpoint=False))
    times = find_passages(record.signals.between_pulses(), np.sort(wanted), config.tracking)
    return RunTracks(name, source, tracks, slow, record.notes, times)


def _track(config: SignalRecordingsConfig, record: _Record, speeds: np.ndarray) -> dict[str, Track]:
    vectors = fit_sweep(record.signals, speeds, config.tracking)
    return {
        probe: _make_track(config, probe, speeds, vectors[:, p], f"{record.signals.where}, probe '{probe}',")
        for p, probe in enumerate(config.probes)
    }


def _read(config: SignalRecordingsConfig, run: WaveformRunConfig | UffRunConfig, path: Path) -> _Record:
    where = f"'{path}' (run '{run.name}')"
    marks = None
    if isinstance(config, UffRecordingsConfig):
        assert isinstance(run, UffRunConfig)
        recording, tacho, per_revolution = _read_uff(config, run, path), _TACHO, 1
        values = recording.channels
        notes: tuple[str, ...] = ()
    else:
        assert isinstance(run, WaveformRunConfig)
        tacho, per_revolution = run.tacho or config.tacho.channel, config.tacho.pulses_per_revolution
        names = {name: run.channels.get(name, probe.channel) for name, probe in config.probes.items()}
        others = [tacho, *([config.tacho.mark_channel] if config.tacho.mark_channel else [])]
        rate = run.sample_rate or config.sample_rate
        clock = Clock(config.time, config.time_unit, rate, config.sample_rate_attribute)
        recording = read_recording(path, [*names.values(), *others], clock, read_format(config.csv))
        values = {name: recording.channels[channel] for name, channel in names.items()}
        notes = note_cut(path) if path.suffix.lower() in (".csv", ".txt") else ()
        if config.tacho.mark_channel is not None:
            channel = config.tacho.mark_channel
            marks = _find_pulses(config, recording, channel, f"{where}, channel '{channel}',").times
    pulses = _find_pulses(config, recording, tacho, f"{where}, channel '{tacho}',")
    angle = fit_angle(pulses.times, per_revolution, f"{where}, channel '{tacho}',", marks)
    notes += tuple(note_clipping(where, {name: values[name] for name in config.probes}))
    return _Record(Signals(recording.time, _to_si(config, values), angle, where), pulses, notes)


def _find_pulses(config: SignalRecordingsConfig, recording: Recording, channel: str, where: str) -> Pulses:
    tacho = config.tacho
    signal = recording.channels[channel]
    return find_pulses(recording.time, signal, tacho.edge or "rising", tacho.threshold, tacho.hysteresis, where)


def _read_uff(config: UffRecordingsConfig, run: UffRunConfig, path: Path) -> Recording:
    records, tacho = find_signals(config, run, path)
    channels = {name: record.values for name, record in zip(config.probes, records, strict=True)}
    return check_recording(path, channels | {_TACHO: tacho.values, "time": tacho.abscissa}, Clock("time", "s"), None)


def _to_si(config: SignalRecordingsConfig, values: Mapping[str, np.ndarray]) -> np.ndarray:
    """(n, P) m, m/s or m/s^2, of the probes in their order."""
    unit = config.signal_unit or ""
    return np.stack([values[name] * to_motion(unit, probe.scale)[1] for name, probe in config.probes.items()], axis=1)


def _make_track(
    config: SignalRecordingsConfig, probe: str, speeds: np.ndarray, vectors: np.ndarray, where: str
) -> Track:
    order, _ = to_motion(config.signal_unit or "", config.probes[probe].scale)
    return sort_track(speeds, to_displacement(vectors, order, speeds), where)
