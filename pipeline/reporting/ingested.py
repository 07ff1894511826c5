"""What was ingested, as a person reads it: the table of its runs or records, a summary, and figures before any fit."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.config.measured import MeasuredConfig
from pipeline.data.dataset import VibrationDataset
from pipeline.data.operating import describe_points, list_columns
from pipeline.data.vibration_files import to_rpm
from pipeline.ingest.dataset import MeasuredRuns
from pipeline.ingest.exciter import FrequencyResponse
from pipeline.reporting.console import say, table
from pipeline.reporting.measured_figures import (
    draw_bode,
    draw_measured_orbits,
    draw_records,
    draw_responses,
    group_speeds,
)
from pipeline.sweep.bias import summarize_bias
from pipeline.units import RAD_S_PER_RPM
from pipeline.write_numbers import write_number


@dataclass(frozen=True, eq=False)
class Ingested:
    """A data set, and what is said of it."""

    dataset: VibrationDataset
    summary: dict[str, Any]  # ingest.json; its notes are warnings
    draw: Callable[[Callable[[str], Path]], Sequence[Path]]  # at the paths that figures have by name
    header: Sequence[str]
    rows: Sequence[Sequence[str]]
    sentence: str
    before: str = ""  # lines above the sentence


def describe_runs(recordings: MeasuredConfig, measured: MeasuredRuns, notes: Sequence[str]) -> Ingested:
    """Recordings of runs."""
    data, recorded = measured.dataset, measured.recorded
    runs = {name: _summarize_run(measured, i) for i, name in enumerate(recorded.runs)}
    columns = {name: [float(v.min()), float(v.max())] for name, v in list_columns(data.operating).items()}
    rows = [
        [
            name,
            about["source"],
            str(about["speeds"]),
            f"{about['first_rpm']:g} to {about['last_rpm']:g}",
            write_number(about["largest_um"], digits=3),
            ", ".join(f"{e.kind} at node {e.node}" for e in recorded.excitations if e.run == name)
            or "nothing (baseline)",
        ]
        for name, about in runs.items()
    ]
    places = {name: (probe.node, float(np.degrees(probe.angle))) for name, probe in recordings.probes.items()}

    def draw(figure: Callable[[str], Path]) -> list[Path]:
        return [
            draw_bode(figure("ingest_bode"), recorded, recordings.baseline, places),
            *(
                [draw_measured_orbits(figure("ingest_orbits"), recorded, recordings.baseline)]
                if recorded.orbits
                else []
            ),
        ]

    rpm = to_rpm(recorded.speeds)
    return Ingested(
        data,
        {
            **_summarize(recordings, data, recorded.speeds),
            "baseline": recordings.baseline,
            **({"operating": columns} if columns else {}),
            "runs": runs,
            "sweeps": {
                name: {"rate_rpm_per_s": bias.rate / RAD_S_PER_RPM, **summarize_bias(bias)}
                for name, bias in measured.sweeps.items()
            },
            "notes": list(notes),
        },
        draw,
        ["run", "file", "speeds", "rpm", "largest, um", "excited by"],
        rows,
        f"{len(data.runs)} runs, {describe_points(data)} from {rpm[0]:g} to {rpm[-1]:g} rpm, "
        f"{len(data.channels)} channels",
        f"probes: {', '.join(f'{name} (node {node}, {angle:g} deg)' for name, (node, angle) in places.items())}\n",
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


def describe_records(recordings: MeasuredConfig, data: VibrationDataset) -> Ingested:
    """A table of records; the figure has the vector of every record at each probe and speed."""
    counts = {"records": len(data.runs), "conditions": len(set(data.conditions or ()))}
    rows = []
    for rpm, at in group_speeds(data.speeds, 1):
        record_rpm = to_rpm(data.frequencies[at][data.present[at]])
        for p, (name, probe) in enumerate(recordings.probes.items()):
            amplitude = 1e6 * np.abs(data.displacement[at, p][data.present[at]])
            rows.append(
                [
                    rpm,
                    f"{record_rpm.min():.1f} to {record_rpm.max():.1f}",
                    name,
                    f"node {probe.node}, {np.degrees(probe.angle):g} deg",
                    write_number(np.median(amplitude), digits=3),
                    f"{write_number(amplitude.min(), digits=3)} to {write_number(amplitude.max(), digits=3)}",
                ]
            )
    return Ingested(
        data,
        {**_summarize(recordings, data, data.speeds), **counts, "notes": []},
        lambda figure: [draw_records(figure("ingest_records"), data, tuple(recordings.probes))],
        ["nominal rpm", "records' rpm", "probe", "place", "median, um", "range, um"],
        rows,
        f"{counts['records']} records of {counts['conditions']} conditions at {len(data.speeds)} speeds, "
        f"{len(data.channels)} probes",
    )


def describe_responses(
    recordings: MeasuredConfig, data: VibrationDataset, tests: Sequence[FrequencyResponse]
) -> Ingested:
    """Responses to a force; the figure has each probe's over the frequency, and its coherence."""
    medians = [np.median(test.coherence, axis=0) for test in tests]
    rows = [
        [
            test.run.name,
            f"{test.run.speed_rpm:g}",
            str(len(test.frequencies)),
            f"{test.frequencies[0]:g} to {test.frequencies[-1]:g}",
            write_number(test.averages, digits=3),
            write_number(coherence.min(), digits=3),
        ]
        for test, coherence in zip(tests, medians, strict=True)
    ]
    runs = {
        test.run.name: {
            "averages": test.averages,
            "coherence": dict(zip(recordings.probes, each.tolist(), strict=True)),
        }
        for test, each in zip(tests, medians, strict=True)
    }
    return Ingested(
        data,
        {**_summarize(recordings, data, data.speeds), "runs": runs, "notes": [n for test in tests for n in test.notes]},
        lambda figure: [draw_responses(figure("ingest_responses"), tuple(recordings.probes), tests)],
        ["run", "rpm", "lines", "Hz", "averages", "lowest coherence (median over lines)"],
        rows,
        f"{len(data.runs)} lines of {len(tests)} tests, {len(data.channels)} channels",
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


def print_ingested(name: str, recordings: MeasuredConfig, ingested: Ingested, vibration: Path) -> None:
    """The table, and what is in the file of the ``vibration`` now."""
    made = "synthetic recordings" if recordings.synthetic else "read"
    table(f"{name}: {made} as {ingested.summary['conventions']}", ingested.header, ingested.rows)
    say(f"{ingested.before}{name}: {ingested.sentence} in '{vibration}'")
