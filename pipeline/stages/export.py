"""Hand the identified bearings on: to ROSS and other programs, in SI or US units."""

from __future__ import annotations

from pipeline.export.coefficients import Number
from pipeline.export.folder import export_at, list_states, write_exports
from pipeline.files import read_json, write_folder
from pipeline.reporting.console import say
from pipeline.reporting.fit_tables import list_numbers
from pipeline.stages.analysis import Analysis
from pipeline.stages.measurement import restore
from pipeline.stages.verdict import say_reservation
from pipeline.tracking import StageRecord


def run(analysis: Analysis) -> StageRecord:
    """The folder ``export``, which takes the place of an earlier one as a whole. Trains first where there is no fit."""
    config, answer = analysis.config, restore(analysis)
    states = [export_at(config, answer, state) for state in list_states(config, answer.measurement.dataset)]
    physical = list_numbers(read_json(analysis.training).get("physical_numbers", {}), config)
    numbers = [
        Number(name=number["label"], value=number["value"], std=number["deviation"], unit=number["unit"])
        for number in physical
    ]
    notes: list[str] = []
    reservation = say_reservation(analysis)
    folder = write_folder(
        analysis.folder / "export",
        lambda beside: notes.extend(write_exports(beside, config, answer.measurement, states, numbers, reservation)),
    )
    written = sorted(folder.iterdir())
    say("\n".join([f"{config.name}: {len(written)} files in '{folder}'", *notes]))
    return StageRecord(tags=answer.tags, files=written)
