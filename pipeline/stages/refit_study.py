"""The same machine measured again and again (``robustness.over=refit``): each time from the data to the bands.

Every data set has its own noise and, as ``machine.as_built`` says, its own errors of weights and probes. Every fit is
complete: its start, its choice of features and its weights are its own. So error and coverage are those of one who
measures once.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np

from pipeline.config.schema import Config
from pipeline.data.tables import write_table
from pipeline.errors import ConfigError
from pipeline.evaluation.errors import model_unmeasured
from pipeline.evaluation.repeats import Refit, refit, summarize_refits, tabulate_refits
from pipeline.files import write_json
from pipeline.identification.fit import loss_of
from pipeline.identification.training import setup_of
from pipeline.problem.configured import build_measurement, model_machine, read_probes
from pipeline.processes import open_pool
from pipeline.reporting.console import count_progress
from pipeline.reporting.training import draw_refits, print_refits
from pipeline.stages.analysis import Analysis
from pipeline.stages.execution import StageOutput, use_threads


def measure_again(config: Config, seed: int) -> Refit:
    """Measure the modelled machine once and identify it."""
    use_threads(config)
    rotor, truth, complete = model_machine(config, seed)
    asked = config.identify.unknowns_of(rotor.bearing_nodes).identified[:, None]
    known = replace(truth, values=np.where(asked, 0.0, truth.values))  # the fit sees nothing of what it is to find
    measurement = build_measurement(config, rotor, read_probes(config, rotor, complete, seed), known)
    return refit(measurement, setup_of(config), truth, model_unmeasured(config, truth.speeds), config.machine)


def refit_all(config: Config) -> list[Refit]:
    """In the order of the seeds, whatever the number of processes."""
    count, refits = config.robustness.count, []
    with (
        count_progress(config.name, count) as progress,
        open_pool(config.robustness.workers, config.threads) as each,
    ):
        for fitted in each(partial(measure_again, config), range(count)):
            refits.append(fitted)
            progress(len(refits), "data sets")
    return refits


def run(analysis: Analysis) -> StageOutput:
    """``robustness.json``, ``robustness.csv`` (a row a data set, bearing and coefficient) and a figure.

    Raises ConfigError where the loss is another, or where there is no machine to measure again.
    """
    config = analysis.config
    if not loss_of(config.loss).weighs_noise or config.machine.recordings.recorded:
        came = "data are measured" if config.machine.recordings.recorded else f"the loss is {config.loss.kind}"
        raise ConfigError(
            f"robustness over refits must have loss=response and a modelled machine, but {came}: use robustness=seeds "
            "loss=residual"
        )
    refits = refit_all(config)
    rows, summary = tabulate_refits(refits), summarize_refits(refits)
    print_refits(config.name, summary)
    work = analysis.files
    written = [
        write_json(work.folder / "robustness.json", summary),
        write_table(work.folder / "robustness.csv", rows),
        draw_refits(work.figure("robustness"), rows),
    ]
    return StageOutput(summary, {}, written)
