"""Turn measured data into the files that training reads, say what was read, and draw it before any fit."""

from __future__ import annotations

from pipeline.config.measured import MeasuredConfig
from pipeline.config.schema import Config
from pipeline.data.tables import read_marks
from pipeline.errors import ConfigError, DataError
from pipeline.files import write_json
from pipeline.ingest.dataset import join_responses, read_measured_runs
from pipeline.ingest.plausibility import note_alike, note_casing, note_size, note_whirl, require_clearance
from pipeline.ingest.records import to_dataset
from pipeline.problem.configured import load_known
from pipeline.reporting.console import say, warn
from pipeline.reporting.ingested import Ingested, describe_records, describe_responses, describe_runs, print_ingested
from pipeline.rotor.model import RotorModel
from pipeline.rotor.stored import load_modelled_bearings, load_rotor, place_probes, require_nodes
from pipeline.stages.analysis import Analysis, require_own, write_data
from pipeline.tracking import StageRecord


def run(analysis: Analysis) -> StageRecord:
    """``vibration.parquet``, ``excitation.csv``, ``known_coefficients.csv``, ``ingest.json`` and figures.

    Synthetic recordings have ``modelled_coefficients.csv``, too, which training never reads.
    Raises ConfigError where the configuration says nothing to read.
    """
    config, recordings = analysis.config, analysis.config.machine.recordings
    _require_own_work(analysis)
    if not recordings.recorded:
        raise ConfigError(
            "ingest must have recordings to read, but machine.recordings.format is none: say in a machine file "
            "what was recorded (stage=new new.data=recordings machine.file=FILE writes one; docs/ingest.md)"
        )
    rotor = load_rotor(config.machine.rotor)
    recordings = place_probes(rotor, recordings)
    if recordings.planes:
        require_nodes(rotor, "machine.recordings.weights", recordings.planes)
        ingested = describe_records(recordings, to_dataset(recordings.read_records()))
    elif recordings.by_frequency:
        require_nodes(rotor, "machine.recordings.runs", [force.node for run in recordings.runs for force in run.forces])
        tests = recordings.read_responses()
        ingested = describe_responses(recordings, join_responses(recordings, tests), tests)
    else:
        ingested = _read_runs(config, recordings, rotor)
    data, machine = ingested.dataset, config.machine
    points = (data.speeds, data.operating)
    known = load_known(config, recordings.known, "machine.recordings.known", rotor.bearing_nodes, *points)
    modelled = load_modelled_bearings(machine.rotor, machine.bearings, *points) if recordings.synthetic else None
    written = [
        *write_data(analysis, data, known, modelled),
        write_json(analysis.folder / "ingest.json", ingested.summary),
        *ingested.draw(analysis.figure),
    ]
    print_ingested(config.name, recordings, ingested, analysis.vibration)
    if not analysis.known.exists():
        say(
            "some coefficients are not identified (identify.unknowns) and must be known before a fit: give "
            "machine.recordings.known"
        )
    for note in ingested.summary["notes"]:
        warn(note)
    return StageRecord(
        metrics={"ingest.runs": float(len(data.runs)), "ingest.speeds": float(len(data.speeds))},
        tags={"data_fingerprint": data.fingerprint},
        files=written,
    )


def _require_own_work(analysis: Analysis) -> None:
    """Raise DataError for files that ingest did not write."""
    require_own(analysis, "ingest")
    marks = read_marks(analysis.vibration) or {}
    if analysis.vibration.exists() and ("schema" not in marks or "origin" in marks):
        raise DataError(
            f"ingest must not replace what it did not write, but '{analysis.vibration}' was generated or made "
            "elsewhere: choose another folder with output=FOLDER"
        )


def _read_runs(config: Config, recordings: MeasuredConfig, rotor: RotorModel) -> Ingested:
    """Raises ConfigError for a node that the rotor lacks, DataError as the format's reader."""
    for run in recordings.runs:
        acting = [*(weight.node for weight in run.unbalances), *(force.node for force in run.forces)]
        require_nodes(rotor, f"machine.recordings.runs, run '{run.name}',", acting)
    measured, model, machine = read_measured_runs(recordings), config.model, config.machine
    laws = machine.laws.bearings if machine.laws else {}
    stated = {
        node: {"machine.bearings": machine.bearings.at(node), f"machine.laws.bearings.{node}": laws.get(node)}
        for node in rotor.bearing_nodes
    }
    require_clearance(measured.recorded, stated)
    notes = [
        *note_casing(recordings.probes, rotor.bearing_nodes, rotor.n_nodes),
        *measured.notes,
        *note_whirl(measured.recorded),
        *note_alike(measured.dataset),
        *note_size(measured.recorded, rotor, model.initial_stiffness, model.initial_damping),
    ]
    return describe_runs(recordings, measured, notes)
