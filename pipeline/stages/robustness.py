"""How an answer varies: trainings from many initial guesses (paper, Figure 2) or seeds; or the same machine measured
again and again (``robustness.over=refit``), each time from the data to the bands.

Of refits, every data set has its own noise and, as ``machine.as_built`` says, its own errors of weights and probes.
Every fit is complete: its start, its choice of features and its weights are its own. So error and coverage are those of
one who measures once.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np

from pipeline.config.schema import Config
from pipeline.data.tables import write_table
from pipeline.errors import ConfigError
from pipeline.evaluation.errors import model_unmeasured
from pipeline.evaluation.repeats import (
    Refit,
    choose_starts,
    refit,
    summarize_refits,
    summarize_starts,
    tabulate_refits,
    tabulate_starts,
)
from pipeline.files import write_json
from pipeline.identification.fit import loss_of
from pipeline.identification.residual_loss import initial_parameters, prepare_residual
from pipeline.identification.training import Outcome, minimise, setup_of
from pipeline.problem.configured import build_measurement, model_machine, read_probes
from pipeline.processes import run_all
from pipeline.reporting.console import count_progress, training_progress
from pipeline.reporting.training import draw_refits, draw_robustness, print_refits, print_starts
from pipeline.stages.analysis import Analysis, use_threads
from pipeline.stages.before_fit import say_diagnosis, say_promoted
from pipeline.stages.measurement import load_modelled, prepare
from pipeline.tracking import StageRecord
from pipeline.twin.twin import measure_unseen


def run(analysis: Analysis) -> StageRecord:
    """``robustness.json``, ``robustness.csv`` and a figure."""
    return _refit(analysis) if analysis.config.robustness.over == "refit" else _start_anew(analysis)


def _start_anew(analysis: Analysis) -> StageRecord:
    """The final error of every start, a row a start, bearing and coefficient; and Figure 2."""
    config, measurement, setup = analysis.config, prepare(analysis), setup_of(analysis.config)
    use_threads(config)
    import torch  # when the data have been found sound

    say_promoted(config)
    if config.robustness.over == "initial_guess" and not any(name.startswith("k") for name in config.identify.named()):
        raise ConfigError(
            "robustness over initial guesses must have an unknown stiffness, but identify.unknowns has none: use "
            "robustness=seeds"
        )
    training = prepare_residual(measurement, setup)
    say_diagnosis(analysis)
    starts, begin = choose_starts(config.robustness), partial(initial_parameters, training, setup)
    by_seed = config.robustness.over == "seed"
    first = [begin(int(start)) if by_seed else begin(config.seed, float(start)) for start in starts]
    trajectory: list[torch.Tensor] = []
    with training_progress(f"{config.name}: {len(starts)} at once") as progress:
        minimum = minimise(
            training.problem,
            torch.cat(first),
            setup,
            held_out=training.held_out,
            progress=progress,
            watch=(lambda state, *_: trajectory.append(state.clone())) if setup.constant else None,
        )
    modelled = load_modelled(config, measurement)  # read when training is over
    answers = [training.identified(parameter).table(measurement.known) for parameter in minimum.parameters]
    rows = tabulate_starts(config.robustness.over, starts, minimum, answers, modelled, measurement.unknowns.by_bearing)
    summary = summarize_starts(minimum, rows)
    error = measure_unseen(config.machine, measurement, answers, modelled)
    if error is not None:
        summary["displacement"] = {"worst_mean_error_percent": error}
    print_starts(config.name, config.robustness.over, summary, minimum.seconds)
    written = [
        write_json(analysis.folder / "robustness.json", summary),
        write_table(analysis.folder / "robustness.csv", rows),
        draw_robustness(analysis.figure("robustness"), training, trajectory, config.robustness.over, rows, modelled),
    ]
    exit_code = 130 if Outcome.INTERRUPTED in minimum.outcomes else 0
    return StageRecord(
        summary | {"seconds": minimum.seconds},
        {"data_fingerprint": measurement.dataset.fingerprint},
        written,
        exit_code=exit_code,
    )


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
    seeds, refits = range(config.robustness.count), dict[int, Refit]()
    again, workers = partial(measure_again, config), config.robustness.workers
    with count_progress(config.name, len(seeds)) as progress:
        for seed, fitted in run_all(again, seeds, workers, config.threads, "robustness.workers=1"):
            refits[seed] = fitted
            progress(len(refits), "data sets")
    return [refits[seed] for seed in seeds]


def _refit(analysis: Analysis) -> StageRecord:
    """A row a data set, bearing and coefficient.

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
    written = [
        write_json(analysis.folder / "robustness.json", summary),
        write_table(analysis.folder / "robustness.csv", rows),
        draw_refits(analysis.figure("robustness"), rows),
    ]
    return StageRecord(summary, {}, written)
