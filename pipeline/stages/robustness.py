"""Many trainings at once, from initial guesses (paper, Figure 2) or from seeds."""

from __future__ import annotations

from functools import partial

from pipeline.data.tables import write_table
from pipeline.errors import ConfigError
from pipeline.evaluation.repeats import choose_starts, summarize_starts, tabulate_starts
from pipeline.files import write_json
from pipeline.identification.residual_loss import initial_parameters, prepare_residual
from pipeline.identification.training import Outcome, minimise, setup_of
from pipeline.reporting.console import training_progress
from pipeline.reporting.training import draw_robustness, print_starts
from pipeline.stages.analysis import Analysis
from pipeline.stages.before_fit import say_diagnosis, say_promoted
from pipeline.stages.execution import StageOutput, use_threads
from pipeline.stages.measurement import load_modelled, prepare
from pipeline.twin.twin import measure_unseen


def run(analysis: Analysis) -> StageOutput:
    """``robustness.json``, a table with the final error of every start, and Figure 2."""
    config = analysis.config
    if config.robustness.over == "refit":
        from pipeline.stages import refit_study

        return refit_study.run(analysis)
    measurement, setup = prepare(analysis), setup_of(config)
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
    work = analysis.files
    answers = [training.identified(parameter).table(measurement.known) for parameter in minimum.parameters]
    rows = tabulate_starts(config.robustness.over, starts, minimum, answers, modelled, measurement.unknowns.by_bearing)
    summary = summarize_starts(minimum, rows)
    error = measure_unseen(config.machine, measurement, answers, modelled)
    if error is not None:
        summary["displacement"] = {"worst_mean_error_percent": error}
    print_starts(config.name, config.robustness.over, summary, minimum.seconds)
    written = [
        write_json(work.folder / "robustness.json", summary),
        write_table(work.folder / "robustness.csv", rows),
        draw_robustness(work.figure("robustness"), training, trajectory, config.robustness.over, rows, modelled),
    ]
    exit_code = 130 if Outcome.INTERRUPTED in minimum.outcomes else 0
    return StageOutput(
        summary | {"seconds": minimum.seconds},
        {"data_fingerprint": measurement.dataset.fingerprint},
        written,
        exit_code=exit_code,
    )
