"""The response fit of noisy data: against simulations, and a batch of data sets against one after another."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

from benchmarks.machines import machine
from benchmarks.measure import BENCHMARKS, Aim, Times, in_turns, seconds
from benchmarks.modelling import ross_seconds

if TYPE_CHECKING:
    from pipeline.config.schema import Config
    from pipeline.identification.response_fit import ResponseFit
    from pipeline.rotor.bearing_table import BearingTable
    from pipeline.stages.inputs import Inputs


@BENCHMARKS.add(
    "sixteen_unknowns",
    "the fit of noisy_all: 16 coefficients at 591 speeds, from the data to the answer",
    "one simulation of its three unbalance runs by ROSS",
    Aim(30),
)
def sixteen_unknowns() -> Times:
    """A fit costs less than thirty simulations by a general program."""
    with TemporaryDirectory() as folder:
        one = _ready("noisy_all", Path(folder))
        simulated = machine("experiment=noisy_all")
        times = [(seconds(lambda: one.fit(one.inputs)), ross_seconds(simulated)) for _ in range(5)]
    return Times([pair[0] for pair in times], [pair[1] for pair in times])


@BENCHMARKS.add(
    "a_hundred_data_sets",
    "a hundred data sets of noisy_stiffness fitted at once",
    "a hundred fitted one after another (ten of them, times ten)",
    Aim(5, "at least"),
)
def a_hundred_data_sets() -> Times:
    """What stage=robustness gains by its batch."""
    import numpy as np

    from pipeline.identification.monte_carlo import monte_carlo

    with TemporaryDirectory() as folder:
        one = _ready("noisy_stiffness", Path(folder))
        fit, again, few = one.fit(one.inputs), one.measured_again(), 10
        clean = fit.prepared.data.equations.predict(one.modelled)
        marquardt = one.config.optimizer.levenberg_marquardt
        times = in_turns(
            lambda: monte_carlo(fit, clean, 100, np.random.default_rng(0), marquardt),
            lambda: [one.fit(again()) for _ in range(few)],
            turns=3,
        )
    return Times(times.ours, times.peer, scale=few / 100)


@dataclass(frozen=True, eq=False)
class _Ready:
    """An experiment before its fit, and the machine that its data were made of."""

    config: Config
    inputs: Inputs
    modelled: BearingTable

    def fit(self, inputs: Inputs) -> ResponseFit:
        """A fit of some data of the experiment."""
        from pipeline.identification.training import setup_of
        from pipeline.stages.response import fitted, prepared_response

        setup = setup_of(self.config)
        return fitted(self.config, prepared_response(self.config, inputs, setup), setup, None)

    def measured_again(self) -> Callable[[], Inputs]:
        """A function that measures the machine once more, with other noise of 1 %."""
        import numpy as np

        from pipeline.data.sensors import Sensors, both_directions, measured
        from pipeline.data.simulate import simulate
        from pipeline.stages.generate import excitations

        clean = simulate(self.inputs.rotor, self.modelled, excitations(self.config))
        sensors = Sensors(both_directions(self.inputs.rotor.bearing_nodes), multiplicative=0.01)
        generator = np.random.default_rng(0)
        return lambda: replace(self.inputs, dataset=measured(clean, sensors, generator))


def _ready(experiment: str, folder: Path) -> _Ready:
    from pipeline.config.compose import compose_config
    from pipeline.stages.evaluate import load_modelled
    from pipeline.stages.inputs import load_inputs

    config = compose_config([f"experiment={experiment}", f"output='{folder}'", "tracking=none"])
    inputs = load_inputs(config)
    modelled = load_modelled(config, inputs)
    assert modelled is not None
    return _Ready(config, inputs, modelled)
