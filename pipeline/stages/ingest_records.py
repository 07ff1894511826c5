"""``stage=ingest`` of a table of records: the files that training reads, and what was read."""

from __future__ import annotations

import numpy as np

from pipeline.config.schema import Config
from pipeline.data.coefficient_files import write_coefficients
from pipeline.data.dataset import VibrationDataset
from pipeline.data.excitation_files import write_excitation
from pipeline.data.vibration_files import to_rpm, write_vibration
from pipeline.files import write_json
from pipeline.ingest.records import RecordsConfig, to_dataset
from pipeline.reporting.console import say, table
from pipeline.reporting.ingest_figures import draw_records
from pipeline.rotor.model import RotorModel
from pipeline.stages.execution import StageOutput
from pipeline.stages.known import load_known
from pipeline.stages.workspace import Workspace, list_known, require_nodes


def ingest_records(config: Config, ingest: RecordsConfig, work: Workspace, rotor: RotorModel) -> StageOutput:
    """The same files as for other formats; the figure has the vector of every record at each probe and speed."""
    require_nodes(rotor, "machine.recordings.weights", [weight.node for weight in ingest.weights])
    dataset = to_dataset(ingest.read_records())
    known = load_known(config, ingest.known, "machine.recordings.known", rotor.bearing_nodes, dataset.speeds)
    written = [write_excitation(work.excitation, dataset)]
    if known is not None:
        written.append(write_coefficients(work.known, known, list_known(config, rotor.bearing_nodes)))
    else:
        work.known.unlink(missing_ok=True)
    work.modelled.unlink(missing_ok=True)
    summary = _summarize(ingest, dataset)
    written += [
        write_vibration(work.vibration, dataset),
        write_json(work.folder / "ingest.json", summary),
        draw_records(work.figure("ingest_records"), dataset, tuple(ingest.probes)),
    ]
    _report(config, ingest, dataset, work)
    return StageOutput(
        metrics={"ingest.runs": float(len(dataset.runs)), "ingest.speeds": float(len(dataset.speeds))},
        tags={"data_fingerprint": dataset.fingerprint},
        files=written,
    )


def _summarize(ingest: RecordsConfig, dataset: VibrationDataset) -> dict[str, object]:
    rpm, conditions = to_rpm(dataset.speeds), dataset.conditions or ()
    return {
        "format": ingest.format,
        "conventions": _describe(ingest),
        "speeds": {"count": len(rpm), "first_rpm": float(rpm[0]), "last_rpm": float(rpm[-1])},
        "nodes": sorted({node for node, _ in dataset.channels}),
        "records": len(dataset.runs),
        "conditions": len(set(conditions)),
        "notes": [],
    }


def _describe(ingest: RecordsConfig) -> str:
    said = ingest.conventions
    return (
        f"complex, {said.unit}, {said.amplitude.replace('_', '-')}, angle a phase {said.phase}, speed in {said.speed}"
    )


def _report(config: Config, ingest: RecordsConfig, dataset: VibrationDataset, work: Workspace) -> None:
    rows = []
    for s, rpm in enumerate(to_rpm(dataset.speeds)):
        record_rpm = to_rpm(dataset.frequencies[s])
        for p, (name, probe) in enumerate(ingest.probes.items()):
            amplitude = 1e6 * np.abs(dataset.displacement[s, p])
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
    header = ["nominal rpm", "records' rpm", "probe", "place", "median, um", "range, um"]
    table(f"{config.name}: read as {_describe(ingest)}", header, rows)
    say(
        f"{config.name}: {len(dataset.runs)} records of {len(set(dataset.conditions or ()))} conditions at "
        f"{len(dataset.speeds)} speeds, {len(dataset.channels)} probes in '{work.vibration}'"
    )
