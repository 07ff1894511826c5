"""Put the results on one screen and in one picture."""

from __future__ import annotations

import numpy as np

from pipeline.config.schema import Config
from pipeline.data.as_built import stand_on_pedestals
from pipeline.files import read_json, write_text
from pipeline.identification.fit import loss_of
from pipeline.identification.identified import Answer
from pipeline.reporting.coefficient_figures import Coefficients
from pipeline.reporting.console import say
from pipeline.reporting.fit_tables import list_numbers
from pipeline.reporting.summary import Results, ShownRun, write_summary
from pipeline.reporting.summary_figure import draw_summary
from pipeline.stages.analysis import Analysis
from pipeline.stages.execution import StageOutput
from pipeline.stages.measurement import AGAIN, load_modelled, restore
from pipeline.stages.predict import load_twin
from pipeline.stages.verdict import load_judgement
from pipeline.twin.at_conditions import say_beyond
from pipeline.twin.twin import Twin
from pipeline.write_numbers import write_number


def run(analysis: Analysis) -> StageOutput:
    """``summary.txt``, which is printed too, and ``figures/summary.png``."""
    config, work = analysis.config, analysis.files
    results = _collect_results(analysis, restore(analysis), load_twin(analysis))
    picture = draw_summary(work.figure("summary"), results, config.name)
    text = write_summary(config, results, picture)
    written = [write_text(work.folder / "summary.txt", text), picture]
    say(text.rstrip("\n"))
    return StageOutput(tags=restore(analysis).tags, files=written)


def _collect_results(analysis: Analysis, answer: Answer, twin: Twin) -> Results:
    config, training = analysis.config, read_json(analysis.files.training, AGAIN)
    data, built, modelled = answer.measurement.dataset, config.machine.as_built, twin.systems.get("modelled")
    if data.operating:  # the twin is at conditions of its own
        modelled = load_modelled(config, answer.measurement)
        if modelled is not None and built is not None:
            modelled = stand_on_pedestals(modelled, built)
    return Results(
        rotor=answer.measurement.rotor,
        dataset=data,
        coefficients=Coefficients.collect(answer.table, modelled, answer.names, answer.deviation(answer.table)),
        training=training,
        judged=load_judgement(analysis)["machine"],
        shown=_choose_run(config, answer),
        twin=twin,
        beyond=say_beyond(data.operating, twin.operating),
        numbers=[
            f"{number.label} {write_number(number.value, number.deviation)} {number.unit}"
            for number in list_numbers(training.get("physical_numbers", {}), config)
        ],
    )


def _choose_run(config: Config, answer: Answer) -> ShownRun:
    """The first run that was not fitted, else the first of all, at the probe that moves most."""
    data = answer.measurement.dataset
    held_out = config.training.holdout_runs if loss_of(config.loss).weighs_noise else ()
    r = data.runs.index(held_out[0] if held_out else data.runs[0])
    predicted = answer.measurement.select(None, np.array([r])).response.predict(answer.table, answer.unbalance)
    reached = np.where(data.present[:, [r]], predicted[..., 0], 0.0)  # (S, P), m
    measured = data.displacement[..., r]
    probe = int(np.abs(measured).max(axis=0).argmax())
    return ShownRun(data.runs[r], bool(held_out), probe, measured, reached)
