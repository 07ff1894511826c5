"""Fits of many runs and of many data sets, and beside SciPy, each speed by itself, and the paper's algorithm."""

from __future__ import annotations

from functools import partial

from benchmarks.growth import add_noise, fit_of_runs
from benchmarks.machines import machine
from benchmarks.measure import BENCHMARKS, Aim, Times, in_turns


@BENCHMARKS.add("repeats", "a fit of 72,000 readings: 3 runs at 60 speeds, 100 times", "10 times", Aim(1, "below"))
def repeats() -> Times:
    """From the data to the bands."""
    many, few = (fit_of_runs(times, (1, 5)) for times in (25, 2.5))
    few()
    return in_turns(many, few, turns=3)


@BENCHMARKS.add(
    "refits",
    "10 data sets of noisy_direct measured and fitted",
    "least squares at each speed by itself",
    Aim(3, "below"),
)
def refits() -> Times:
    """As stage=robustness makes them; the peer has no bands, and many times the error."""
    from pipeline.problem.configured import build_measurement, model_machine, read_probes
    from pipeline.problem.residual import per_speed_least_squares
    from pipeline.stages.robustness import measure_again

    config = machine("experiment=noisy_direct").config

    def alone(seed: int) -> object:
        rotor, truth, complete = model_machine(config, seed)
        measurement = build_measurement(config, rotor, read_probes(config, rotor, complete, seed), truth)
        return per_speed_least_squares(measurement.residual)

    measure_again(config, 0)
    return in_turns(lambda: [*map(partial(measure_again, config), range(10))], lambda: [*map(alone, range(10))], 3)


@BENCHMARKS.add(
    "least_squares",
    "Levenberg-Marquardt steps of noisy_direct from its linear start",
    "scipy.optimize.least_squares on the same rows and Jacobian",
    Aim(1),
)
def least_squares() -> Times:
    """Both must end at the same loss to 1e-8."""
    import scipy.optimize
    import torch

    from pipeline.identification.optimizers import levenberg_marquardt, until_still
    from pipeline.identification.output_error_start import prepare_output_error
    from pipeline.identification.training import setup_of

    made = machine("experiment=noisy_direct")
    start = prepare_output_error(made.measured(add_noise(made.dataset), made.config), setup_of(made.config))
    problem, ends = start.problem, {}

    def weigh(values: object) -> torch.Tensor:
        return torch.as_tensor(values)[None, None]

    def ours() -> None:
        config = made.config.optimizer.levenberg_marquardt
        ends["ours"] = levenberg_marquardt(problem, start.weights, config, until_still(1e-10))

    def peer() -> None:
        solved = scipy.optimize.least_squares(
            lambda z: problem.rows(weigh(z))[0, 0].numpy(),
            start.weights[0, 0].numpy(),
            lambda z: torch.cat([problem.columns(weigh(z))[0, :, :-1], problem.prior.rows]).numpy(),
            method="lm",
        )
        ends["peer"] = weigh(solved.x)

    times = in_turns(ours, peer, turns=3)
    off = abs(float(problem.loss(ends["ours"]) / problem.loss(ends["peer"])) - 1)
    if off > 1e-8:
        raise RuntimeError(f"both must end at the same loss to 1e-8, but they differ by {off:.1e}")
    return times


@BENCHMARKS.add(
    "paper",
    "the fit of hydrostatic_stiffness",
    "the paper's algorithm, Adam on the unscaled residual",
    Aim(10, "at least"),
)
def paper() -> Times:
    """The paper's must not be nearer to the modelled coefficients."""
    import numpy as np

    from pipeline.identification.fit import default_setup, fit
    from pipeline.identification.training import FitSetup, setup_of

    made = machine("experiment=hydrostatic_stiffness", "tuned=false")
    errors = {}

    def train(name: str, setup: FitSetup) -> None:
        answer = fit(made.measurement, setup).table(made.bearings)
        errors[name] = np.abs(answer.values[..., [0, 3]] / made.bearings.values[..., [0, 3]] - 1).mean()

    ours, paper = default_setup(made.measurement.guess), setup_of(made.config)
    times = in_turns(lambda: train("ours", ours), lambda: train("paper", paper), turns=1)
    if errors["ours"] > errors["paper"]:
        raise RuntimeError(f"the error must be below that of the paper's algorithm, but is {errors}")
    return times
