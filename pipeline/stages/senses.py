"""Fit the data in every sense of phases and angles, and say which one they choose."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pipeline.files import write_json
from pipeline.identification.fit import default_setup
from pipeline.identification.quality import finite
from pipeline.identification.senses import try_senses
from pipeline.identification.training import setup_of
from pipeline.reporting.console import say, table
from pipeline.stages.analysis import Analysis, use_threads
from pipeline.stages.measurement import prepare
from pipeline.tracking import StageRecord
from pipeline.write_numbers import write_number


def run(analysis: Analysis) -> StageRecord:
    """``senses.json``: every sense with its chi-square beyond the least, and the sentence.

    Raises ConfigError as :func:`pipeline.identification.senses.try_senses`.
    """
    config = analysis.config
    use_threads(config)
    measurement, setup = prepare(analysis), setup_of(config)
    if config.model.families:  # which sense explains the readings asks for no population of bearings: sixteen fits
        setup = replace(setup, model=default_setup(measurement.guess).model)
        parameters = tuple(p for p in measurement.parameters if p.kind in config.identify.model_parameters.deviations)
        measurement = replace(measurement, parameters=parameters)
    senses = try_senses(measurement, setup, lambda sense: say(f"{config.name}: {sense.words}"))
    header = ["phase of readings", "angle of weights", "rotation", "chi-square beyond the least", "the same mirrored"]
    places = {trial.sense: place for place, trial in enumerate(senses.trials)}
    rows = [
        [
            *trial.sense.words.split(", "),
            write_number(trial.chi_square) if np.isfinite(trial.chi_square) else "no fit",
            f"row {places[trial.sense.twin] + 1}",
        ]
        for trial in senses.trials
    ]
    table(f"{config.name}: senses of phases and angles", header, rows)
    say(f"{config.name}: {senses.sentence}")
    summary = {"sentence": senses.sentence, "least": senses.least, "expected": senses.expected, "gained": senses.gained}
    summary["senses"] = [
        {
            "phase_as_lag": trial.sense.lag,
            "weights_against_rotation": trial.sense.against,
            "rotation_from_y_to_x": trial.sense.mirrored,
            "chi_square_beyond_the_least": finite(trial.chi_square),
            "told_from_the_best": trial not in senses.open,
            "same_machine_mirrored": places[trial.sense.twin],
            "why_no_fit": trial.why_not,
        }
        for trial in senses.trials
    ]
    written = [write_json(analysis.folder / "senses.json", summary)]
    return StageRecord({"least": senses.least}, {"data_fingerprint": measurement.dataset.fingerprint}, written)
