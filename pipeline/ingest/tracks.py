"""1X vectors of probes over the speed, and the speeds of all runs together.

Legend: S speeds, P probes, R runs.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from pipeline.data.coefficient_files import interpolate
from pipeline.data.operating import join
from pipeline.errors import DataError
from pipeline.units import RAD_S_PER_RPM
from pipeline.write_numbers import write_number

LARGEST = 1.0
"""m, what the file of training takes."""
ROUNDING = 1e-5
"""Speeds in files have few digits: so much may the end of a range be missed by."""


@dataclass(frozen=True, eq=False)
class Track:
    """The 1X vectors of one probe in one run."""

    speeds: np.ndarray  # (S,) rad/s, ascending, each once
    vectors: np.ndarray  # (S,) complex, m, zero-to-peak, towards the probe


@dataclass(frozen=True, eq=False)
class RunTracks:
    """What was read of one run; ``notes`` are sentences that need attention."""

    name: str
    source: str  # its files, for messages
    tracks: Mapping[str, Track]  # by probe, in the order of the configuration
    slow: Mapping[str, Track] = field(default_factory=dict)  # by probe, where slow roll was tracked apart
    notes: tuple[str, ...] = ()
    times: np.ndarray | None = None  # (S,) s, when a run-up passed the speeds of its tracks
    conditions: Mapping[str, tuple[np.ndarray, np.ndarray]] = field(default_factory=dict)  # rad/s and SI (n,) each

    def pack(self) -> bytes:
        """All of it, bit by bit, for :func:`unpack_tracks`; conditions are not there yet."""
        tracks, slow = (
            {name: [track.speeds.tolist(), track.vectors.view(float).tolist()] for name, track in every.items()}
            for every in (self.tracks, self.slow)
        )
        times = np.ravel(() if self.times is None else self.times).tolist()
        return json.dumps([self.name, self.source, tracks, slow, self.notes, times]).encode()


def unpack_tracks(content: bytes) -> RunTracks:
    """What :meth:`RunTracks.pack` made."""
    name, source, *both, notes, times = json.loads(content)
    tracks, slow = (
        {probe: Track(np.array(speeds), np.array(parts).view(complex)) for probe, (speeds, parts) in every.items()}
        for every in both
    )
    return RunTracks(name, source, tracks, slow, tuple(notes), np.array(times) if times else None)


def sort_track(
    speeds: np.ndarray, vectors: np.ndarray, where: str, fastest: float = 1e5, at_rest: bool = False
) -> Track:
    """A track of rows in any order; of a force of its own frequency the rotor may be ``at_rest``.

    Raises DataError for impossible speeds (above ``fastest``, rad/s) and sizes, and speeds there twice.
    """
    if (speeds < 0).any() or (not at_rest and (speeds == 0).any()):
        raise DataError(f"{where} must have speeds above zero, but got {format_rpm(speeds.min())} rpm")
    if (speeds > fastest).any():
        raise DataError(f"{where} must have speeds of a rotor, but got {format_rpm(speeds.max())} rpm: check the unit")
    sizes = np.hypot(vectors.real, vectors.imag)
    if not (sizes <= LARGEST).all():
        raise DataError(
            f"{where} must have amplitudes below {LARGEST:g} m, but got {write_number(np.nanmax(sizes), digits=3)} "
            "m: check the unit (machine.recordings.conventions, or scale and signal_unit)"
        )
    order = np.argsort(speeds, kind="stable")
    speeds, vectors = speeds[order], vectors[order]
    same = np.flatnonzero(np.diff(speeds) == 0)
    if len(same):
        raise DataError(
            f"{where} must have one row a speed, but {format_rpm(speeds[same[0]])} rpm is there twice: leave one out, "
            "or average them"
        )
    return Track(speeds, vectors)


def to_common_speeds(
    runs: Sequence[RunTracks], stated: np.ndarray | None, kind: str, same: float = 1e-3
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The speeds (S,) rad/s of all runs together, their vectors (S, P, R), and which runs have which speed (S, R).

    Each run is interpolated (``kind`` cubic or linear) to those of the ``stated`` speeds (n,) rad/s that all its probes
    cover; None takes the speeds of the runs as they are, where those that differ by less than the share ``same``, and
    than half a step of any track, are one, their mean. Raises DataError for a run that covers none of them, and for
    a probe that lacks a speed of its run.
    """
    every = [(run, probe, track) for run in runs for probe, track in run.tracks.items()]
    if stated is None:
        step = min((np.diff(track.speeds) / track.speeds[1:]).min(initial=2 * same) for _, _, track in every)
        joined = np.split(
            join(np.concatenate([track.speeds for _, _, track in every]), 0.0, step / 2),
            np.cumsum([len(track.speeds) for _, _, track in every])[:-1],
        )
        speeds = np.unique(np.concatenate(joined))
        placed = [(np.searchsorted(speeds, at), each[2].vectors) for at, each in zip(joined, every, strict=True)]
    else:
        speeds, placed = stated, [_interpolate(run, probe, track, stated, kind) for run, probe, track in every]
    columns = np.full((len(speeds), len(every)), np.nan + 0j)
    for column, (at, shown) in zip(columns.T, placed, strict=True):
        column[at] = shown
    vectors = columns.reshape(len(speeds), len(runs), -1).transpose(0, 2, 1)
    seen = ~np.isnan(vectors)
    present = seen.all(axis=1)
    if stated is None and len(alone := np.argwhere(seen & ~present[:, None])):
        s, p, r = alone[0]
        raise DataError(
            f"every probe of a run must have the same speeds, but run '{runs[r].name}' has {format_rpm(speeds[s])} "
            f"rpm at probe '{[*runs[r].tracks][p]}' and not at all others ({runs[r].source}): leave it out, or give "
            "machine.recordings.speeds={start_rpm: .., stop_rpm: .., step_rpm: ..} to interpolate to"
        )
    rows = present.any(axis=1)
    return speeds[rows], np.where(present[:, None], vectors, 0.0)[rows], present[rows]


def _interpolate(
    run: RunTracks, probe: str, track: Track, speeds: np.ndarray, kind: str
) -> tuple[np.ndarray, np.ndarray]:
    """Which of ``speeds`` (S,) rad/s lie in the range of the ``track``, and its vectors there; never beyond it."""
    low, high = track.speeds[0] * (1 - ROUNDING), track.speeds[-1] * (1 + ROUNDING)
    at = np.flatnonzero((low <= speeds) & (speeds <= high))
    confused = _name_confusion(track.speeds, speeds)
    if not len(at) or (confused and len(at) < len(speeds)):
        raise DataError(
            f"every run must cover some of machine.recordings.speeds ({format_rpm(speeds[0])} to "
            f"{format_rpm(speeds[-1])} rpm), but the speed range of run '{run.name}' is {len(track.speeds)} speeds "
            f"from {format_rpm(track.speeds[0])} to {format_rpm(track.speeds[-1])} rpm at probe '{probe}' "
            f"({run.source}): {confused}nothing is extrapolated, choose machine.recordings.speeds within it"
        )
    wanted = speeds[at]
    if len(wanted) == len(track.speeds) and np.allclose(wanted, track.speeds, rtol=1e-9, atol=0):
        return at, track.vectors
    inside = np.clip(wanted, track.speeds[0], track.speeds[-1])
    steps = np.diff(track.speeds)
    # A cubic through noise between two speeds that are nearly one would swing far out.
    if kind == "linear" or len(track.speeds) < 4 or steps.min() < np.median(steps) / 5:
        return at, np.interp(inside, track.speeds, track.vectors)
    return at, interpolate(track.speeds, track.vectors, inside)


_CONFUSED = {60.0: "rpm called Hz", 1 / 60: "Hz called rpm", 1 / RAD_S_PER_RPM: "rpm called rad/s"}
"""Unit of speed that is taken for another, by the factor that speeds are then too large by."""


def _name_confusion(speeds: np.ndarray, wanted: np.ndarray) -> str:
    """The unit that ``speeds`` are in if another one makes them cover those that are ``wanted``; else nothing."""
    for factor, confused in _CONFUSED.items():
        low, high = speeds[[0, -1]] / factor
        if low * (1 - ROUNDING) <= wanted[0] and wanted[-1] <= high * (1 + ROUNDING):
            times = (
                f"{write_number(factor, digits=3)} times too large"
                if factor > 1
                else f"{write_number(1 / factor, digits=3)} times too small"
            )
            return f"speeds that are {times} are {confused} (machine.recordings.conventions.speed); "
    return ""


def format_rpm(speed: float) -> str:
    """Write a speed in rad/s as rpm."""
    return write_number(speed / RAD_S_PER_RPM, digits=6)
