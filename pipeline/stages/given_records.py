"""``stage=predict predict.records=FILE``: the vibration of its records, in the columns and the unit of their source."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, cast

import numpy as np

from pipeline.balance.records import predict_records
from pipeline.data.tables import list_columns, read_table, write_table
from pipeline.ingest.conventions import SourceUnits
from pipeline.reporting.balance import tabulate_predicted
from pipeline.reporting.console import say
from pipeline.stages.analysis import Analysis
from pipeline.stages.execution import StageOutput
from pipeline.stages.vibration_models import follow_day, list_missing, load_models, load_records

if TYPE_CHECKING:
    from pipeline.ingest.records import RecordsConfig


def run(analysis: Analysis) -> StageOutput:
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
    path = write_table(analysis.files.folder / "predicted_records.csv", table)
    others = np.array([condition != config.predict.reference for condition in records.conditions])
    measured, metrics = predicted.measured & others[:, None], {}
    message = f"{config.name}: {len(records.speeds)} records of '{file}' predicted by {method} in '{path}'"
    if measured.any():
        off, size = predicted.off[measured], (predicted.mean + predicted.off)[measured]
        metrics = {
            "error_percent": float(100 * np.linalg.norm(off) / np.linalg.norm(size)),
            "within_95_percent": float(100 * predicted.within[measured].mean()),
        }
        message += f"; measured vectors depart by {metrics['error_percent']:.2g} % (root mean square), "
        message += f"{metrics['within_95_percent']:.0f} % of them lie in their 95 % circles"
        if missing := list_missing(records):
            message += f"; not measured: {', '.join(missing)}"
    say(message)
    return StageOutput(metrics, {"data_fingerprint": fingerprint}, [path])
