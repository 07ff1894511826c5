"""Turn measured data into the files that training reads, say what was read, and draw it before any fit."""

from __future__ import annotations

from typing import TYPE_CHECKING, cast

import numpy as np

from pipeline.config.measured import MeasuredConfig
from pipeline.config.schema import Config
from pipeline.data.coefficient_files import write_coefficients
from pipeline.data.dataset import VibrationDataset
from pipeline.data.excitation_files import write_excitation
from pipeline.data.operating_points import describe_points, list_columns
from pipeline.data.tables import read_marks
from pipeline.data.vibration_files import to_rpm, write_vibration
from pipeline.errors import ConfigError, DataError
from pipeline.files import write_json
from pipeline.ingest.dataset import MeasuredRuns, read_measured_runs
from pipeline.ingest.plausibility import note_casing, note_size, note_whirl
from pipeline.reporting.console import say, table, warn
from pipeline.reporting.ingest_figures import draw_bode, draw_measured_orbits
from pipeline.rotor.stored import load_modelled_bearings, load_rotor
from pipeline.stages.execution import StageOutput
from pipeline.stages.ingest_records import ingest_records
from pipeline.stages.known import load_known
from pipeline.stages.workspace import Workspace, list_known, locate_files, require_nodes, require_own
from pipeline.sweep.bias import SweepBias
from pipeline.units import RAD_S_PER_RPM

if TYPE_CHECKING:
    from pipeline.ingest.records import RecordsConfig


def _require_own_work(work: Workspace) -> None:
    """Raise DataError for files that ingest did not write."""
    require_own(work, "ingest")
    marks = read_marks(work.vibration) or {}
    if work.vibration.exists() and ("schema" not in marks or "origin" in marks):
        raise DataError(
            f"ingest must not replace what it did not write, but '{work.vibration}' was generated or made elsewhere: "
            "choose another folder with output=FOLDER"
        )


def run(config: Config) -> StageOutput:
    """``vibration.parquet``, ``excitation.csv``, ``known_coefficients.csv``, ``ingest.json`` and two figures.

    Synthetic recordings have ``modelled_coefficients.csv``, too, which training never reads.
    Raises ConfigError where the configuration says nothing to read.
    """
    work, ingest = locate_files(config), config.machine.recordings
    _require_own_work(work)
    if not ingest.recorded:
        raise ConfigError(
            "ingest must have recordings to read, but machine.recordings.format is none: say in a machine file "
            "what was recorded (stage=new new.data=recordings machine.file=FILE writes one; docs/ingest.md)"
        )
    rotor = load_rotor(config.machine.rotor)
    require_nodes(rotor, "machine.recordings.probes", [probe.node for probe in ingest.probes.values()])
    if ingest.planes:
        return ingest_records(config, cast("RecordsConfig", ingest), work, rotor)
    for measured_run in ingest.runs:
        acting = [
            *(unbalance.node for unbalance in measured_run.unbalances),
            *(force.node for force in measured_run.forces),
        ]
        require_nodes(rotor, f"machine.recordings.runs, run '{measured_run.name}',", acting)
    on_casing = note_casing(ingest.probes, rotor.bearing_nodes)
    measured = read_measured_runs(ingest)
    dataset = measured.dataset
    nodes, speeds, operating = rotor.bearing_nodes, dataset.speeds, dataset.operating
    known = load_known(config, ingest.known, "machine.recordings.known", nodes, speeds, operating)
    notes = [*on_casing, *measured.notes, *note_whirl(measured.recorded)]
    notes += note_size(measured.recorded, rotor, config.model.initial_stiffness, config.model.initial_damping)
    written = [write_excitation(work.excitation, dataset)]
    if known is not None:
        written.append(write_coefficients(work.known, known, list_known(config, rotor.bearing_nodes)))
    else:
        work.known.unlink(missing_ok=True)
    if ingest.synthetic:
        modelled = load_modelled_bearings(config.machine.rotor, config.machine.bearings, speeds, operating)
        written.append(write_coefficients(work.modelled, modelled))
    else:
        work.modelled.unlink(missing_ok=True)
    written.append(write_vibration(work.vibration, dataset))
    written += [
        write_json(work.folder / "ingest.json", _summarize(measured, ingest, notes)),
        draw_bode(work.figure("ingest_bode"), measured.recorded, ingest.baseline, _list_probes(ingest)),
        draw_measured_orbits(work.figure("ingest_orbits"), measured.recorded, ingest.baseline),
    ]
    _report(config, ingest, measured, work)
    for note in notes:
        warn(note)
    return StageOutput(
        metrics={"ingest.runs": float(len(dataset.runs)), "ingest.speeds": float(len(dataset.speeds))},
        tags={"data_fingerprint": dataset.fingerprint},
        files=written,
    )


def _list_probes(ingest: MeasuredConfig) -> dict[str, tuple[int, float]]:
    """Node and angle in degrees of each probe."""
    return {name: (probe.node, float(np.degrees(probe.angle))) for name, probe in ingest.probes.items()}


def _summarize(measured: MeasuredRuns, ingest: MeasuredConfig, notes: list[str]) -> dict[str, object]:
    dataset = measured.dataset
    rpm = to_rpm(measured.recorded.speeds)
    return {
        "format": ingest.format,
        "conventions": ingest.describe(),
        "speeds": {"count": len(rpm), "first_rpm": float(rpm[0]), "last_rpm": float(rpm[-1])},
        "nodes": sorted({node for node, _ in dataset.channels}),
        "baseline": ingest.baseline,
        **({"operating": _summarize_conditions(dataset)} if dataset.operating else {}),
        "runs": {name: _summarize_run(measured, i) for i, name in enumerate(measured.recorded.runs)},
        "sweeps": {name: _describe_sweep(bias) for name, bias in measured.sweeps.items()},
        "notes": notes,
    }


def _summarize_conditions(dataset: VibrationDataset) -> dict[str, list[float]]:
    """By column, the lowest and the highest value."""
    columns = list_columns(dataset.operating)
    return {name: [float(values.min()), float(values.max())] for name, values in columns.items()}


def _describe_sweep(bias: SweepBias) -> dict[str, float]:
    return {
        "rate_rpm_per_s": bias.rate / RAD_S_PER_RPM,
        "peak_shift_percent": 100 * bias.peak_shift,
        "damping_factor": bias.damping_factor,
        "amplitude_factor": bias.amplitude_factor,
        "rate_limit_rpm_per_s": bias.limit / RAD_S_PER_RPM,
    }


def _summarize_run(measured: MeasuredRuns, index: int) -> dict[str, object]:
    run = measured.runs[index]
    tracks = list(run.tracks.values())
    return {
        "source": run.source,
        "speeds": max(len(track.speeds) for track in tracks),
        "first_rpm": float(min(to_rpm(track.speeds[:1])[0] for track in tracks)),
        "last_rpm": float(max(to_rpm(track.speeds[-1:])[0] for track in tracks)),
        "largest_um": float(1e6 * np.abs(measured.recorded.displacement[..., index]).max()),
    }


def _report(config: Config, ingest: MeasuredConfig, measured: MeasuredRuns, work: Workspace) -> None:
    dataset = measured.dataset
    rows = []
    for i, run in enumerate(measured.runs):
        summary, name = _summarize_run(measured, i), measured.recorded.runs[i]
        acting = [e for e in measured.recorded.excitations if e.run == name]
        text = ", ".join(f"{e.kind} at node {e.node}" for e in acting) or "nothing (baseline)"
        rows.append(
            [
                name,
                run.source,
                str(summary["speeds"]),
                f"{summary['first_rpm']:g} to {summary['last_rpm']:g}",
                f"{summary['largest_um']:.3g}",
                text,
            ]
        )
    header = ["run", "file", "speeds", "rpm", "largest, um", "excited by"]
    made = "synthetic recordings" if ingest.synthetic else "read"
    table(f"{config.name}: {made} as {ingest.describe()}", header, rows)
    probes = ", ".join(
        f"{name} (node {probe.node}, {np.degrees(probe.angle):g} deg)" for name, probe in ingest.probes.items()
    )
    rpm = to_rpm(measured.recorded.speeds)
    say(
        f"probes: {probes}\n"
        f"{config.name}: {len(dataset.runs)} runs, {describe_points(dataset)} from {rpm[0]:g} to {rpm[-1]:g} rpm, "
        f"{len(dataset.channels)} channels in '{work.vibration}'"
    )
    if not work.known.exists():
        say(
            "some coefficients are not identified (identify.unknowns) and must be known before a fit: give "
            "machine.recordings.known"
        )
