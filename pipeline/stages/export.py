"""Hand the identified bearings on: to ROSS and other programs, in SI or US units."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from pipeline.config.schema import Config
from pipeline.data.tables import write_table
from pipeline.export.coefficients import Document, Exported, document, tabulate
from pipeline.export.programs import write_ansys_file, write_apdl, write_dyrobes, write_workbook
from pipeline.files import write_folder, write_json, write_text
from pipeline.identification.uncertainty import load_uncertainty
from pipeline.problem.measurement import Measurement
from pipeline.reporting.console import say
from pipeline.rotor.bearing_table import BearingTable
from pipeline.stages.execution import StageOutput
from pipeline.stages.measurement import load_identified, load_measurement, update_measurement
from pipeline.stages.predict import list_unseen
from pipeline.stages.workspace import locate_files
from pipeline.twin.prediction import predict


def run(config: Config) -> StageOutput:
    """The folder ``export``, which takes the place of an earlier one as a whole. Trains first where there is no fit."""
    measurement = load_measurement(config)
    work, model = locate_files(config), load_identified(config, measurement)
    uncertainty = load_uncertainty(work.folder, model)
    updated = update_measurement(measurement, uncertainty)
    exported = Exported(
        config.name,
        model.table(updated.updated_known),
        None if uncertainty is None else uncertainty.deviation(model, measurement.dataset.speeds),
        model.unknowns.identified,
        config.export.units,
    )
    notes: list[str] = []
    folder = write_folder(
        work.folder / "export", lambda beside: notes.extend(_write(beside, config, updated, exported))
    )
    written = sorted(folder.iterdir())
    say("\n".join([f"{config.name}: {len(written)} files in '{folder}'", *notes]))
    return StageOutput(tags={"data_fingerprint": measurement.dataset.fingerprint}, files=written)


def _write(folder: Path, config: Config, updated: Measurement, exported: Exported) -> list[str]:
    """Every format that is asked for; what there is to say of them. ``updated`` is at the fitted model parameters."""
    formats, nodes, notes = config.export.formats, exported.table.nodes, []
    write_text(folder / "conventions.txt", "\n".join(exported.conventions()) + "\n")
    if "csv" in formats:
        write_table(folder / "coefficients.csv", tabulate(exported))
    if "excel" in formats:
        write_workbook(folder / "coefficients.xlsx", exported)
    if "json" in formats:
        write_json(folder / "coefficients.json", document(exported).model_dump(mode="json"))
        write_text(folder / "coefficients.schema.json", json.dumps(Document.model_json_schema(), indent=2) + "\n")
    for b, node in enumerate(nodes):
        if "dyrobes" in formats:
            write_text(folder / f"dyrobes_node_{node}.txt", write_dyrobes(exported, b))
        if "ansys" in formats:
            write_text(folder / f"ansys_node_{node}.txt", write_ansys_file(exported, b))
            write_text(folder / f"ansys_node_{node}.inp", write_apdl(exported, b))
    if "ross" in formats:
        notes.append(_write_ross(folder, config, updated, exported))
    return notes


def _write_ross(folder: Path, config: Config, updated: Measurement, exported: Exported) -> str:
    """The rotor, each bearing, and their deviations; how far ROSS's smoothing of tables moves the response."""
    from pipeline.rotor.ross_export import export_rotor, make_bearings, read_table

    rotor = config.machine.rotor
    export_rotor(rotor, updated.parameters, updated.parameter_values, exported.table).save(folder / "rotor.toml")
    elements = make_bearings(exported.table)
    for one in elements:
        one.save(folder / f"bearing_node_{one.n}.toml")
    if exported.deviation is not None:
        columns = tabulate(Exported(exported.name, exported.table, exported.deviation, exported.identified, "si"))
        kept = ("bearing_node", "speed_rpm")
        write_table(folder / "deviations.csv", {k: v for k, v in columns.items() if k in kept or k.endswith("_std")})
    off = _compare(config, updated, exported.table, read_table(elements, exported.table.speeds))
    every = zip(updated.rotor.bearing_nodes, updated.updated_rotor.bearing_shifts, strict=False)
    beside = "".join(
        f"; the fit places the bearing of node {node} {1e3 * shift:+.3g} mm along the shaft, which 'rotor.toml' lacks"
        for node, shift in every
    )
    return (
        "'rotor.toml' is for ross.Rotor.load; ROSS smooths tables over the speed, which moves the response to the "
        f"prediction's unbalance by at most {off:.1g} %{beside}"
    )


def _compare(config: Config, updated: Measurement, table: BearingTable, smoothed: BearingTable) -> float:
    """The largest difference of the two responses at the prediction's node, percent."""
    unseen, node = list_unseen(config), config.machine.prediction.node
    found, other = (predict(updated.updated_rotor, one, unseen, node) for one in (table, smoothed))
    return float(np.max(other.error_percent(found)))
