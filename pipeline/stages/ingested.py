"""What ``stage=ingest`` reads: recordings of runs, or a table of records; with what it says and draws of them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from pipeline.config.measured import MeasuredConfig
from pipeline.config.schema import Config
from pipeline.data.dataset import VibrationDataset
from pipeline.data.operating_points import describe_points, list_columns
from pipeline.data.vibration_files import to_rpm
from pipeline.ingest.dataset import MeasuredRuns, read_measured_runs
from pipeline.ingest.plausibility import note_casing, note_size, note_whirl
from pipeline.ingest.records import to_dataset
from pipeline.reporting.measured_figures import draw_bode, draw_measured_orbits, draw_records
from pipeline.rotor.model import RotorModel
from pipeline.rotor.stored import require_nodes
from pipeline.stages.workspace import Workspace
from pipeline.sweep.bias import SweepBias
from pipeline.units import RAD_S_PER_RPM

if TYPE_CHECKING:
    from pipeline.ingest.records import RecordsConfig


@dataclass(frozen=True, eq=False)
class Ingested:
    """A data set, and what is said of it."""

    dataset: VibrationDataset
    summary: dict[str, Any]  # ingest.json
    draw: Callable[[Workspace], Sequence[Path]]
    header: Sequence[str]
    rows: Sequence[Sequence[str]]
    sentence: str
    before: str = ""  # lines above the sentence
    notes: Sequence[str] = ()


def read_runs(config: Config, recordings: MeasuredConfig, rotor: RotorModel) -> Ingested:
    """Recordings of runs. Raises ConfigError for a node that the rotor lacks, DataError as the format's reader."""
    model = config.model
    for run in recordings.runs:
        acting = [*(weight.node for weight in run.unbalances), *(force.node for force in run.forces)]
        require_nodes(rotor, f"machine.recordings.runs, run '{run.name}',", acting)
    on_casing = note_casing(recordings.probes, rotor.bearing_nodes)
    measured = read_measured_runs(recordings)
    data, recorded = measured.dataset, measured.recorded
    notes = [*on_casing, *measured.notes, *note_whirl(recorded)]
    notes += note_size(recorded, rotor, model.initial_stiffness, model.initial_damping)
    runs = {name: _summarize_run(measured, i) for i, name in enumerate(recorded.runs)}
    columns = {name: [float(v.min()), float(v.max())] for name, v in list_columns(data.operating).items()}
    summary = {
        **_summarize(recordings, data, recorded.speeds),
        "baseline": recordings.baseline,
        **({"operating": columns} if columns else {}),
        "runs": runs,
        "sweeps": {name: _describe_sweep(bias) for name, bias in measured.sweeps.items()},
        "notes": notes,
    }
    rows = []
    for name, run_summary in runs.items():
        acting_on = [f"{e.kind} at node {e.node}" for e in recorded.excitations if e.run == name]
        source, speeds, first, last, largest = run_summary.values()
        text = ", ".join(acting_on) or "nothing (baseline)"
        rows.append([name, source, str(speeds), f"{first:g} to {last:g}", f"{largest:.3g}", text])
    places = {name: (probe.node, float(np.degrees(probe.angle))) for name, probe in recordings.probes.items()}

    def draw(work: Workspace) -> list[Path]:
        return [
            draw_bode(work.figure("ingest_bode"), recorded, recordings.baseline, places),
            draw_measured_orbits(work.figure("ingest_orbits"), recorded, recordings.baseline),
        ]

    rpm = to_rpm(recorded.speeds)
    return Ingested(
        data,
        summary,
        draw,
        ["run", "file", "speeds", "rpm", "largest, um", "excited by"],
        rows,
        f"{len(data.runs)} runs, {describe_points(data)} from {rpm[0]:g} to {rpm[-1]:g} rpm, "
        f"{len(data.channels)} channels",
        f"probes: {', '.join(f'{name} (node {node}, {angle:g} deg)' for name, (node, angle) in places.items())}\n",
        notes,
    )


def _summarize_run(measured: MeasuredRuns, index: int) -> dict[str, Any]:
    run = measured.runs[index]
    tracks = list(run.tracks.values())
    return {
        "source": run.source,
        "speeds": max(len(track.speeds) for track in tracks),
        "first_rpm": float(min(to_rpm(track.speeds[:1])[0] for track in tracks)),
        "last_rpm": float(max(to_rpm(track.speeds[-1:])[0] for track in tracks)),
        "largest_um": float(1e6 * np.abs(measured.recorded.displacement[..., index]).max()),
    }


def _describe_sweep(bias: SweepBias) -> dict[str, float]:
    return {
        "rate_rpm_per_s": bias.rate / RAD_S_PER_RPM,
        "peak_shift_percent": 100 * bias.peak_shift,
        "damping_factor": bias.damping_factor,
        "amplitude_factor": bias.amplitude_factor,
        "rate_limit_rpm_per_s": bias.limit / RAD_S_PER_RPM,
    }


def read_records(config: Config, given: MeasuredConfig, rotor: RotorModel) -> Ingested:
    """A table of records; the figure has the vector of every record at each probe and speed. Raises as
    :func:`read_runs`."""
    recordings = cast("RecordsConfig", given)
    require_nodes(rotor, "machine.recordings.weights", recordings.planes)
    data = to_dataset(recordings.read_records())
    counts = {"records": len(data.runs), "conditions": len(set(data.conditions or ()))}
    rows = []
    for s, rpm in enumerate(to_rpm(data.speeds)):
        record_rpm = to_rpm(data.frequencies[s])
        for p, (name, probe) in enumerate(recordings.probes.items()):
            amplitude = 1e6 * np.abs(data.displacement[s, p])
            rows.append(
                [
                    f"{rpm:.1f}",
                    f"{record_rpm.min():.1f} to {record_rpm.max():.1f}",
                    name,
                    f"node {probe.node}, {np.degrees(probe.angle):g} deg",
                    f"{np.median(amplitude):.3g}",
                    f"{amplitude.min():.3g} to {amplitude.max():.3g}",
                ]
            )
    return Ingested(
        data,
        {**_summarize(recordings, data, data.speeds), **counts, "notes": []},
        lambda work: [draw_records(work.figure("ingest_records"), data, tuple(recordings.probes))],
        ["nominal rpm", "records' rpm", "probe", "place", "median, um", "range, um"],
        rows,
        f"{counts['records']} records of {counts['conditions']} conditions at {len(data.speeds)} speeds, "
        f"{len(data.channels)} probes",
    )


def _summarize(recordings: MeasuredConfig, data: VibrationDataset, speeds: np.ndarray) -> dict[str, Any]:
    """What every format has; ``speeds`` are those of the recordings, rad/s."""
    rpm = to_rpm(speeds)
    return {
        "format": recordings.format,
        "conventions": recordings.describe(),
        "speeds": {"count": len(rpm), "first_rpm": float(rpm[0]), "last_rpm": float(rpm[-1])},
        "nodes": sorted({node for node, _ in data.channels}),
    }
