"""Put the results on one screen and in one picture."""

from __future__ import annotations

from typing import Any

import numpy as np

from pipeline.config.schema import Config
from pipeline.data.as_built import stand_on_pedestals
from pipeline.files import read_json, write_text
from pipeline.identification.losses import loss_of
from pipeline.identification.uncertainty import Uncertainty
from pipeline.problem.measurement import Measurement
from pipeline.reporting.console import say
from pipeline.reporting.physical_numbers import list_numbers
from pipeline.reporting.summary_figure import draw_summary
from pipeline.reporting.summary_text import Results, ShownRun, write_summary
from pipeline.reporting.write_numbers import format_deviation
from pipeline.rotor.bearing_table import BearingTable
from pipeline.stages.execution import StageOutput
from pipeline.stages.measurement import load_measurement, load_modelled, update_measurement
from pipeline.stages.predict import Twin, build_twin
from pipeline.stages.verdict import load_judgement
from pipeline.stages.workspace import locate_files
from pipeline.twin.at_conditions import say_beyond


def run(config: Config) -> StageOutput:
    """``summary.txt``, which is printed too, and ``figures/summary.png``."""
    work, measurement = locate_files(config), load_measurement(config)
    twin = build_twin(config, measurement)
    results = _collect_results(config, measurement, twin, read_json(work.training, "train again with stage=train"))
    picture = draw_summary(work.figure("summary"), results, config.name)
    text = write_summary(config, results, picture)
    written = [write_text(work.folder / "summary.txt", text), picture]
    say(text.rstrip("\n"))
    return StageOutput(tags={"data_fingerprint": measurement.dataset.fingerprint}, files=written)


def _collect_results(config: Config, measurement: Measurement, twin: Twin, training: dict[str, Any]) -> Results:
    data, uncertainty = measurement.dataset, twin.uncertainty
    identified = twin.identified.table(update_measurement(measurement, uncertainty).updated_known)
    modelled = twin.systems.get("modelled")
    if data.operating and (modelled := load_modelled(config, measurement)) is not None and config.machine.as_built:
        modelled = stand_on_pedestals(modelled, config.machine.as_built)
    return Results(
        rotor=measurement.rotor,
        dataset=data,
        identified=identified,
        modelled=modelled,
        unknowns=twin.identified.unknowns.by_bearing,
        deviation=None if uncertainty is None else uncertainty.deviation(twin.identified, data.speeds, data.operating),
        training=training,
        judged=load_judgement(config, measurement)["machine"],
        shown=_choose_run(config, measurement, identified, uncertainty),
        vibration=twin.vibration,
        behaviour=twin.behaviour["identified"],
        at=twin.at,
        operating=twin.operating,
        beyond=say_beyond(data.operating, twin.operating),
        numbers=[
            f"{number.label} {format_deviation(number.value, number.deviation)} {number.unit}"
            for number in list_numbers(training.get("physical_numbers", {}), config)
        ],
    )


def _choose_run(
    config: Config, measurement: Measurement, bearings: BearingTable, uncertainty: Uncertainty | None
) -> ShownRun:
    """The first run that was not fitted, else the first of all, at the probe that moves most."""
    data = measurement.dataset
    held_out = config.training.holdout_runs if loss_of(config.loss).weighs_noise else ()
    r = data.runs.index(held_out[0] if held_out else data.runs[0])
    updated = update_measurement(measurement, uncertainty).select(None, np.array([r]))
    unbalance = None if uncertainty is None else uncertainty.residual_unbalance
    reached = np.where(data.present[:, [r]], updated.response.predict(bearings, unbalance)[..., 0], 0.0)  # (S, P), m
    measured = data.displacement[..., r]
    probe = int(np.abs(measured).max(axis=0).argmax())
    return ShownRun(data.runs[r], bool(held_out), probe, measured, reached)
