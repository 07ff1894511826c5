"""From the 1X vectors of probes to displacements in x and y, and what excited them.

Probes at any mounting angle show v_i = x cos a_i + y sin a_i at each node, solved by least squares; those of one
direction stay as they are. How much the sweep of a run-up biases the peak that its vectors show: the rate from the
tacho, the bias from the model.

Legend: S speeds, P probes, R runs, N nodes.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import Field

from pipeline.config.measured import MeasuredConfig, NoRecordingsConfig, SlowRollConfig
from pipeline.config.runs import ProbeConfig, find_frequencies
from pipeline.data.dataset import DIRECTIONS, VibrationDataset, place_rows
from pipeline.data.excitation_files import run_excitations
from pipeline.data.sensors import list_directions, name_channel
from pipeline.errors import DataError
from pipeline.ingest.conventions import to_lead
from pipeline.ingest.exciter import ExciterRecordingsConfig, FrequencyResponse
from pipeline.ingest.operating import find_conditions, name_recordings, to_points
from pipeline.ingest.plausibility import note_dead
from pipeline.ingest.records import RecordsConfig
from pipeline.ingest.ross_results import RossRecordingsConfig
from pipeline.ingest.table import TableRecordingsConfig
from pipeline.ingest.tracks import LARGEST, RunTracks, Track, format_rpm, to_common_speeds
from pipeline.ingest.uff import UffRecordingsConfig
from pipeline.ingest.waveform import WaveformRecordingsConfig
from pipeline.sweep.bias import SweepBias, describe_bias, find_mode, measure_bias, read_peak
from pipeline.units import RAD_S_PER_RPM
from pipeline.write_numbers import write_number, write_rough

RecordingsConfig = Annotated[
    NoRecordingsConfig
    | TableRecordingsConfig
    | RecordsConfig
    | UffRecordingsConfig
    | WaveformRecordingsConfig
    | ExciterRecordingsConfig
    | RossRecordingsConfig,
    Field(discriminator="format"),
]
"""Every format of recordings."""


@dataclass(frozen=True, eq=False)
class MeasuredRuns:
    """What was read: the data set of training, the recordings it came from, and sentences that need attention."""

    dataset: VibrationDataset
    recorded: VibrationDataset  # a run for each recording, without operating conditions
    runs: tuple[RunTracks, ...]  # of the recordings
    notes: tuple[str, ...]
    sweeps: Mapping[str, SweepBias] = field(default_factory=dict)
    """By run: of the run-ups that show a peak."""


def read_measured_runs(config: MeasuredConfig, contradiction: float = 0.05) -> MeasuredRuns:
    """Read all runs, each at the speeds that it has, and bring them to x and y. Raises DataError and ConfigError.

    Probes at a node that miss each other by more than the share ``contradiction`` of what they measure are named.
    """
    runs = config.read()
    notes = [note for run in runs for note in run.notes]
    notes += [  # missing values may have been written as zeros
        f"probe '{probe}' of run '{run.name}' is exactly zero at {count} of {len(track.speeds)} speeds: are values "
        "missing?"
        for run in runs
        for probe, track in run.tracks.items()
        if (count := int((track.vectors == 0).sum()))
    ]
    for run in runs:
        sizes = {probe: float(np.sqrt((np.abs(track.vectors) ** 2).mean())) for probe, track in run.tracks.items()}
        notes += note_dead(run.name, sizes)
    asynchronous = {run.name for run in config.runs if any(config.state_frequency(run).values())}
    if slow := config.slow_roll:  # runout turns with the shaft
        runs = tuple(run if run.name in asynchronous else remove_runout(run, slow) for run in runs)
    sweeps = {run.name: bias for run in runs if (bias := measure_sweep(run, config.most_lag))}
    notes += [
        f"run '{name}' is no sequence of steady states: {describe_bias(bias)}; run it slower, or fit the ramp with "
        "stage=runup"
        for name, bias in sweeps.items()
        if abs(bias.peak_shift) > bias.most
    ]
    wanted = config.speeds.rad_s() if config.speeds else None
    speeds, vectors, present = to_common_speeds(runs, wanted, config.interpolation)
    channels, displacement, misfits = resolve([*config.probes.values()], vectors)
    largest = np.abs(displacement).max(axis=(0, 1))
    if largest.max() > LARGEST:
        raise DataError(
            f"displacements must be below {LARGEST:g} m, but run '{runs[int(largest.argmax())].name}' has "
            f"{write_number(largest.max(), digits=3)} m: check the unit (machine.recordings.conventions, or scale "
            "and signal_unit)"
        )
    conditions = find_conditions(config, runs, speeds)
    labels = name_recordings(config, conditions)
    acting = [
        replace(excitation, run=label)
        for label, run in zip(labels, config.runs, strict=True)
        for excitation in run_excitations(run, config.angle_from_x)
    ]
    recorded = VibrationDataset(
        speeds,
        labels,
        channels,
        displacement,
        tuple(acting),
        np.stack([find_frequencies(run, speeds) for run in config.runs], axis=1) if asynchronous else None,
        present=present,
    )
    dataset = recorded
    asked = len(config.speeds.rpm()) if config.speeds else len(speeds)
    rows = [min(len(track.speeds) for track in run.tracks.values()) for run in runs]
    notes += _note_counts(labels, rows, present.sum(axis=0).tolist(), asked)
    if conditions:
        names = [run.name for run in config.runs]
        dataset, merged = to_points(recorded, names, conditions, config.same_conditions)
        notes += merged
    notes += [
        f"the probes at node {node} contradict each other by {write_rough(100 * misfit)} % of what they measure: check "
        "their angles, polarity and scale"
        for node, misfit in misfits.items()
        if misfit > contradiction
    ]
    notes += [
        f"the probes at node {node} look along one line: check their angles, or let stage=diagnose say what one "
        "direction leaves open"
        for node in dict.fromkeys(node for node, _ in channels)
        if not set(list_directions((node,))) <= set(channels)
    ]
    return MeasuredRuns(dataset, recorded, runs, _join_alike(notes), sweeps)


def join_responses(config: MeasuredConfig, tests: Sequence[FrequencyResponse]) -> VibrationDataset:
    """Responses to 1 N: each line of each of the ``tests`` is a run, with the noise of its readings."""
    rpm, at_speed = np.unique([test.run.speed_rpm for test in tests], return_inverse=True)
    lines = [(t, hz) for t, test in enumerate(tests) for hz in test.frequencies]
    names = [f"{tests[t].run.name} {write_number(hz, digits=8)} Hz" for t, hz in lines]
    channels, shares, _ = resolve([*config.probes.values()], np.eye(len(config.probes))[..., None])  # (P, Q, 1)
    acting = [
        replace(excitation, run=name)
        for (t, _), name in zip(lines, names, strict=True)
        for excitation in run_excitations(tests[t].run, config.angle_from_x)
    ]
    return place_rows(
        rpm * RAD_S_PER_RPM,
        tuple(names),
        channels,
        (at_speed[[t for t, _ in lines]], slice(None), np.arange(len(lines))),
        np.concatenate([test.response for test in tests]) @ shares[..., 0],
        tuple(acting),
        [2 * np.pi * hz for _, hz in lines],
        np.sqrt(np.concatenate([test.noise for test in tests]) ** 2 @ shares[..., 0] ** 2),
    )


def _join_alike(notes: Sequence[str]) -> tuple[str, ...]:
    """Each once: what is said of several files in the same words is said of the first, with the names of the others."""
    alike: dict[str, list[str]] = {}
    for note in dict.fromkeys(notes):
        file = re.match(r"'[^']+' ", note)
        alike.setdefault(note[file.end() :] if file else note, []).append(file[0].strip(" '") if file else "")
    return tuple(
        (f"'{files[0]}' {said}" if files[0] else said)
        + "".join(f"; so for '{Path(other).name}'" for other in files[1:])
        for said, files in alike.items()
    )


def remove_runout(run: RunTracks, slow_roll: SlowRollConfig) -> RunTracks:
    """The run with the runout of every probe subtracted. Raises DataError where nothing was measured that slowly."""
    tracks = {}
    for probe, track in run.tracks.items():
        if not slow_roll.below_rpm:
            assert slow_roll.amplitude  # the schema has seen to it
            assert slow_roll.phase
            given = slow_roll.vectors[probe]
            vector = given.amplitude * np.exp(1j * np.array(given.phase))
            runout = complex(to_lead(vector, 1.0, slow_roll.amplitude, slow_roll.phase))
        else:
            slow = run.slow[probe]
            vectors = slow.vectors[slow.speeds < slow_roll.below_rpm * RAD_S_PER_RPM]
            if not len(vectors):
                raise DataError(
                    f"run '{run.name}' must have speeds below machine.recordings.slow_roll.below_rpm="
                    f"{slow_roll.below_rpm:g}, but the lowest is {format_rpm(slow.speeds[0])} rpm "
                    f"({run.source}): give a larger one, or slow_roll.vectors, or slow_roll=null"
                )
            runout = complex(vectors.mean())
        tracks[probe] = Track(track.speeds, track.vectors - runout)
    return replace(run, tracks=tracks)


def _note_counts(labels: Sequence[str], rows: Sequence[int], counts: Sequence[int], asked: int) -> list[str]:
    """Runs that lack some of the speeds ``asked``, and those that were interpolated to more than their ``rows``."""
    notes = []
    if sum(counts) < asked * len(labels):
        notes.append(
            f"not every run was measured at each of the {asked} speeds: "
            + ", ".join(f"'{label}' at {count}" for label, count in zip(labels, counts, strict=True))
            + "; what is not there is left out, not extrapolated"
        )
    told = zip(labels, rows, counts, strict=True)
    if stretched := [f"'{label}' from {few} to {count}" for label, few, count in told if few < count]:
        notes.append(
            f"runs were interpolated to more speeds than they were measured at ({', '.join(stretched)}), and what is "
            "between them may be wrong near a resonance: give machine.recordings.speeds a larger step_rpm, or null to "
            "take each run at its own speeds"
        )
    return notes


def resolve(
    probes: Sequence[ProbeConfig], vectors: np.ndarray, least_spread: float = np.radians(10.0)
) -> tuple[tuple[tuple[int, float], ...], np.ndarray, dict[int, float]]:
    """What the probes tell of every node, of their ``vectors`` (S, P, R) in this order.

    Probes that are nearer to one line than ``least_spread`` (rad) would amplify their errors by more than eight in x
    and y: they stay as they are.

    Returns:
        Q channels (node, angle in degrees): x and y of a node, or its probes' directions; their displacement (S, Q, R),
        complex, m; by node the root mean square of what the probes contradict each other over that of their vectors, 0
        where no probe is more than what tells its node.
    """
    place = np.array([probe.node for probe in probes])
    angles = np.array([probe.angle for probe in probes])
    channels: list[tuple[int, float]] = []
    parts, misfit = [], {}
    for node in np.unique(place).tolist():
        here = np.flatnonzero(place == node)
        matrix, directions = np.stack([np.cos(angles[here]), np.sin(angles[here])], axis=1), [*DIRECTIONS.values()]
        if np.abs(np.sin(angles[here, None] - angles[here])).max() < np.sin(least_spread):
            named = [name_channel(node, angle)[1] for angle in angles[here]]
            directions = sorted(set(named))
            matrix = np.equal.outer(named, directions).astype(float)
        seen = vectors[:, here]
        solved = np.einsum("dp,spr->sdr", np.linalg.pinv(matrix), seen)
        rest = seen - np.einsum("pd,sdr->spr", matrix, solved)
        size = np.sqrt((np.abs(seen) ** 2).mean())
        exact = size == 0 or len(here) == len(directions)
        misfit[node] = 0.0 if exact else float(np.sqrt((np.abs(rest) ** 2).mean()) / size)
        channels += [(node, direction) for direction in directions]
        parts.append(solved)
    return tuple(channels), np.concatenate(parts, axis=1), misfit


def measure_sweep(run: RunTracks, most: float) -> SweepBias | None:
    """The bias at the largest peak of the probe that has most of it; ``most`` is the share that a peak may lag.

    None for a run without times, and where no probe shows a peak with half the power on both sides.
    """
    if run.times is None or len(run.times) < 3:
        return None
    biases: list[SweepBias] = []
    for track in run.tracks.values():
        reading = read_peak(track.speeds, np.abs(track.vectors))
        if reading:
            rates = np.gradient(track.speeds, run.times)
            rate = float(np.interp(reading.frequency, track.speeds, rates))
            biases.append(measure_bias(*find_mode(reading, rate), rate, most))
    return max(biases, key=lambda bias: abs(bias.peak_shift), default=None)
