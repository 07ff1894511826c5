"""Records of weights and vibration that a user asks about: what predicts their vibration, from its files, and
``stage=predict predict.records=FILE``, in the columns and the unit of their source."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, cast

import numpy as np

from pipeline.balance.fitted import Fitted, fit_models
from pipeline.balance.linear_vibration import LinearVibration
from pipeline.balance.physical import Physical, restore_physical
from pipeline.balance.records import average_records, judge_together, predict_records, shift_to_day
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
    vibration = follow_day(config.name, records, fitted.models[method], config.predict.reference)
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
    """Influence coefficients, and where constant coefficients have been identified, that model and the blend of both;
    with the fingerprint of the records.

    Conditions that contradict their labels are named and left out.
    """
    config, dataset = analysis.config, load_dataset(analysis.config)
    conditions = gather_conditions(dataset, config.machine.recordings.planes or None)
    fitted = fit_models(conditions, _load_physical(analysis, conditions))
    if names := ", ".join(fitted.contradictions):
        say(f"{config.name}: influence coefficients without {names}, which contradict their labels")
    return fitted, dataset.fingerprint


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


def follow_day(name: str, records: Records, model: LinearVibration, reference: str | None) -> LinearVibration:
    """The model on the day of the ``records``, as their condition ``reference`` shows it; without one as it is, with a
    warning where they depart together. Raises DataError as :func:`pipeline.balance.records.shift_to_day`."""
    try:
        conditions = average_records(records, model)
    except DataError:  # what is predicted needs no vectors, nor one set of weights a condition
        if reference:
            raise
        return model
    if reference:
        return shift_to_day(conditions, model, reference)
    if (chance := judge_together(conditions, model, Estimates.RARE)) < Estimates.RARE:
        warn(
            f"{name}: the records depart together from what their weights make (by chance in "
            f"{write_number(chance, digits=1)} of tables), "
            "as on another day: name a condition of theirs with known weights as reference"
        )
    return model
