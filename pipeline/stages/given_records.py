"""Records of weights and vibration that a user asks about: what predicts their vibration, from its files, and
``stage=predict predict.records=FILE``, in the columns and the unit of their source."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, cast

import numpy as np

from pipeline.balance.fitted import Fitted
from pipeline.balance.linear_vibration import LinearVibration
from pipeline.balance.physical import Physical, restore_physical
from pipeline.balance.records import (
    average_records,
    find_reference,
    judge_together,
    place_records,
    predict_records,
    shift_to_day,
)
from pipeline.balance.unbalance import Estimates
from pipeline.config.schema import Config
from pipeline.data.conditions import Conditions, gather_conditions
from pipeline.data.tables import list_columns, read_table, write_table
from pipeline.errors import ConfigError, DataError
from pipeline.ingest.conventions import SourceUnits
from pipeline.ingest.records import Records
from pipeline.reporting.balance import tabulate_predicted
from pipeline.reporting.console import say, warn
from pipeline.rotor.stored import load_rotor, place_probes
from pipeline.stages.analysis import Analysis
from pipeline.stages.measurement import load_dataset, prepare, restore
from pipeline.tracking import StageRecord
from pipeline.write_numbers import write_number, write_rough

if TYPE_CHECKING:
    from pipeline.ingest.records import RecordsConfig


def run(analysis: Analysis) -> StageRecord:
    """``predicted_records.csv``: a row for each record, in its order. No fit of bearings is needed."""
    config = analysis.config
    file = config.predict.records or ""
    records = load_records(config, file, "predict.records")
    fitted, fingerprint = load_models(analysis)
    method = fitted.pick(config.predict.method, "predict.method")
    place_records(records, fitted.conditions)  # what is wrong with the table is said before a fit
    try:
        day: Day | None = read_day(records, fitted.conditions, config.predict.reference)
    except DataError:  # what is predicted needs no vectors, nor one set of weights a condition
        if config.predict.reference:
            raise
        day = None
    vibration = fit_models(config.name, fitted, day)[method]
    predicted = predict_records(records, vibration)
    recordings = cast("RecordsConfig", config.machine.recordings)  # load_records has seen to it
    pairs = [(probe.columns.real, probe.columns.imaginary) for probe in recordings.probes.values()]
    vectors = {name for pair in pairs for name in pair}
    text = recordings.csv
    kept = {name: "text" for name in list_columns(Path(file), text) if name not in vectors}
    source = SourceUnits(recordings)
    table = tabulate_predicted(read_table(Path(file), kept, text=text), records, predicted, source, pairs, method)
    path = write_table(analysis.folder / "predicted_records.csv", table)
    others = np.array([condition != config.predict.reference for condition in records.conditions])
    measured, metrics = predicted.measured & others[:, None], {}
    message = f"{config.name}: {len(records.speeds)} records of '{file}' predicted by {method} in '{path}'"
    if measured.any():
        off, size = predicted.off[measured], (predicted.mean + predicted.off)[measured]
        metrics = {
            "error_percent": float(100 * np.linalg.norm(off) / np.linalg.norm(size)),
            "within_95_percent": float(100 * predicted.within[measured].mean()),
        }
        message += f"; measured vectors depart by {write_rough(metrics['error_percent'])} % (root mean square), "
        message += f"{metrics['within_95_percent']:.0f} % of them lie in their 95 % circles"
        if missing := list_missing(records):
            message += f"; not measured: {', '.join(missing)}"
    say(message)
    return StageRecord(metrics, {"data_fingerprint": fingerprint}, [path])


def load_models(analysis: Analysis) -> tuple[Fitted, str]:
    """The experiment's conditions, to be fitted by influence coefficients, and where constant coefficients have been
    identified, that model and the blend of both; with the fingerprint of the records."""
    config, dataset = analysis.config, load_dataset(analysis.config)
    conditions = gather_conditions(dataset, config.machine.recordings.planes or None)
    return Fitted(conditions, _load_physical(analysis, conditions)), dataset.fingerprint


Day = tuple[Conditions, Conditions | None]
"""The readings of a table, and the condition among them that shows what their day adds, where one is named."""


def read_day(records: Records, experiment: Conditions, reference: str | None) -> Day:
    """The means of the ``records`` at the speeds of the ``experiment``. Raises DataError as
    :func:`pipeline.balance.records.average_records` and :func:`pipeline.balance.records.find_reference`."""
    readings = average_records(records, experiment)
    return readings, find_reference(readings, reference) if reference else None


def fit_models(name: str, fitted: Fitted, day: Day | None) -> dict[str, LinearVibration]:
    """The model of each method, on the ``day`` of a table, as its reference shows it; without a reference as it is,
    with a warning where the readings depart together. Conditions that contradict their labels are named."""
    if names := ", ".join(fitted.judged[0]):
        say(f"{name}: influence coefficients without {names}, which contradict their labels")
    return {method: _follow(name, model, *day) if day else model for method, model in fitted.models.items()}


def _load_physical(analysis: Analysis, conditions: Conditions) -> Physical | None:
    """The model that was trained on these conditions; None without one, or where its coefficients are no constants."""
    if analysis.config.model.varies or not analysis.training.exists():
        return None
    measurement, answer = prepare(analysis), restore(analysis)
    if answer.uncertainty is None or not measurement.drift:
        return None
    return restore_physical(measurement, answer.uncertainty, conditions)


def load_records(config: Config, file: str, key: str) -> Records:
    """The records of ``file``, read as those of the machine. Raises ConfigError where the machine has no such table."""
    recordings = config.machine.recordings
    if not recordings.planes:
        raise ConfigError(
            f"{key} must be a table like that of machine.recordings with format records, but this machine's format is "
            f"{recordings.format}: leave it out"
        )
    return place_probes(load_rotor(config.machine.rotor), recordings).read_records(file)


def list_missing(records: Records) -> Sequence[str]:
    """The probes that no record has a vector of."""
    return [name for p, name in enumerate(records.probes) if np.isnan(records.displacement[:, p]).all()]


def _follow(name: str, model: LinearVibration, readings: Conditions, reference: Conditions | None) -> LinearVibration:
    if reference:
        return shift_to_day(reference, model)
    if (chance := judge_together(readings, model, Estimates.RARE)) < Estimates.RARE:
        warn(
            f"{name}: the records depart together from what their weights make (by chance in "
            f"{write_number(chance, digits=1)} of tables), "
            "as on another day: name a condition of theirs with known weights as reference"
        )
    return model
