"""Training: it depends neither on the mesh nor on the number of runs, and many guesses cost little more than one."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING

from benchmarks.machines import Machine, machine, refined
from benchmarks.measure import BENCHMARKS, Action, Aim, Times, in_turns

if TYPE_CHECKING:
    from pipeline.config.schema import Config
    from pipeline.identification.training import FitSetup
    from pipeline.problem.measurement import Measurement

_EXPERIMENT = "hydrostatic_stiffness"


@BENCHMARKS.add("adam_step_at_97_nodes", "10 steps of Adam on 97 nodes", "10 steps of Adam on 7 nodes", Aim(1.2))
def adam_step_at_97_nodes() -> Times:
    """The small system at the bearings has the same size on every mesh."""
    return _steps("adam", 10)


@BENCHMARKS.add(
    "levenberg_marquardt_step_at_97_nodes",
    "4 steps of Levenberg-Marquardt on 97 nodes",
    "4 steps of Levenberg-Marquardt on 7 nodes",
    Aim(1.2),
)
def levenberg_marquardt_step_at_97_nodes() -> Times:
    """The small system at the bearings has the same size on every mesh."""
    return _steps("levenberg_marquardt", 4)


def _steps(optimizer: str, count: int) -> Times:
    coarse, fine = (_optimisation(refined(_EXPERIMENT, factor), optimizer, count) for factor in (1, 16))
    coarse()
    fine()
    return in_turns(fine, coarse, 9, inner=5)


def _optimisation(made: Machine, optimizer: str, count: int) -> Action:
    """``count`` steps of an optimiser on the machine's own problem, without the monitor's account."""
    import torch

    from pipeline.config.identification import AdamConfig, LevenbergMarquardtConfig
    from pipeline.identification import optimizers
    from pipeline.identification.residual_loss import initial_parameters, prepare_residual
    from pipeline.identification.training import setup_of

    setup = setup_of(made.config)
    prepared = prepare_residual(made.measurement, setup)
    start = initial_parameters(prepared, setup, made.config.seed)
    go_on = torch.zeros(start.shape[:2], dtype=torch.bool)
    if optimizer == "adam":
        adam = AdamConfig(steps=count, patience=count, learning_rate=1e-3, final_rate_fraction=1.0)
        return lambda: optimizers.adam(prepared.problem, start, adam, lambda *_: go_on)
    marquardt = LevenbergMarquardtConfig(steps=count, patience=count, initial_damping=1e6)  # accepted at once
    return lambda: optimizers.levenberg_marquardt(prepared.problem, start, marquardt, lambda *_: go_on)


@BENCHMARKS.add("guesses_at_once", "81 initial guesses trained together", "one of them alone, as many steps", Aim(3))
def guesses_at_once() -> Times:
    """Without early stopping both take every step."""
    import torch

    from pipeline.evaluation.repeats import choose_starts
    from pipeline.identification.residual_loss import initial_parameters, prepare_residual
    from pipeline.identification.training import minimise

    made = machine("experiment=ball_bearing")
    setup = endless(made.config)
    prepared = prepare_residual(made.measurement, setup)
    guesses = choose_starts(made.config.robustness)
    together = torch.cat([initial_parameters(prepared, setup, made.config.seed, float(guess)) for guess in guesses])
    alone = together[40:41]
    return in_turns(
        lambda: minimise(prepared.problem, together, setup, held_out=prepared.held_out),
        lambda: minimise(prepared.problem, alone, setup, held_out=prepared.held_out),
        turns=5,
    )


def endless(config: Config) -> FitSetup:
    """The configured training without early stopping: tolerance 0 and endless patience."""
    from pipeline.identification.training import setup_of

    phases = ("adam", "lbfgs", "levenberg_marquardt")
    patient = {name: getattr(config.optimizer, name).model_copy(update={"patience": 10**9}) for name in phases}
    return setup_of(
        config.model_copy(
            update={
                "optimizer": config.optimizer.model_copy(update=patient),
                "training": config.training.model_copy(update={"tolerance": 0.0}),
            }
        )
    )


def _on_a_gpu(count: int) -> Times:
    """Four steps of Adam and four of Levenberg-Marquardt, from seeds; both end at the same losses to 1e-8."""
    import numpy as np
    import torch

    from pipeline.identification.residual_loss import initial_parameters, prepare_residual
    from pipeline.identification.training import Minimum, minimise

    if not torch.cuda.is_available():
        raise RuntimeError("torch sees no GPU here")
    made = machine(f"experiment={_EXPERIMENT}", "machine.speeds.step_rpm=100")
    setup, few = endless(made.config), {"steps": 4}
    optimizer = setup.optimizer.model_copy(
        update={name: getattr(setup.optimizer, name).model_copy(update=few) for name in ("adam", "levenberg_marquardt")}
    )
    setup = replace(setup, optimizer=optimizer)
    prepared = prepare_residual(made.measurement, setup)
    starts = torch.cat([initial_parameters(prepared, setup, seed) for seed in range(count)])
    ends: dict[str, Minimum] = {}

    def train(device: str) -> None:
        on = replace(setup, training=setup.training.model_copy(update={"device": device}))
        ends[device] = minimise(prepared.problem, starts, on, held_out=prepared.held_out)

    train("cuda")  # the first call loads the GPU's libraries
    times = in_turns(lambda: train("cuda"), lambda: train("cpu"), turns=1 if count > 100 else 9)
    off = np.abs(ends["cuda"].loss / ends["cpu"].loss - 1).max()
    if off > 1e-8:
        raise RuntimeError(f"the losses of GPU and processor must agree to 1e-8, but differ by {off:.1e}")
    return times


for _count, _aim in ((1, 1.0), (100, 1.0), (10_000, 10.0)):
    BENCHMARKS.add(
        f"gpu_{_count}",
        f"{_count} trainings of the network, 8 steps each, on a GPU",
        "the same on one thread of the processor",
        Aim(_aim, "at least"),
    )(partial(_on_a_gpu, _count))


@BENCHMARKS.add("ten_times_the_runs", "3 Jacobians with 30 runs", "3 Jacobians with 3 runs", Aim(1.2))
def ten_times_the_runs() -> Times:
    """QR leaves as many rows as unknowns, whatever the number of runs."""
    import numpy as np

    from pipeline.identification.residual_loss import initial_parameters, prepare_residual
    from pipeline.identification.training import setup_of

    made = machine(f"experiment={_EXPERIMENT}")
    few, data = made.measurement, made.dataset
    again = [tuple(replace(e, run=f"{e.run} {i}") for e in data.excitations) for i in range(10)]
    dataset = replace(
        data,
        runs=tuple(f"{run} {i}" for i in range(10) for run in data.runs),
        displacement=np.tile(data.displacement, 10),
        excitations=tuple(e for copy in again for e in copy),
    )
    many = made.measured(dataset, made.config)

    def jacobians(measurement: Measurement) -> Action:
        setup = setup_of(made.config)
        prepared = prepare_residual(measurement, setup)
        start = initial_parameters(prepared, setup, made.config.seed)
        return lambda: [prepared.problem.jacobian(start) for _ in range(3)]

    return in_turns(jacobians(many), jacobians(few), 9, inner=5)
