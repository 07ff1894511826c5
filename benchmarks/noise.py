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
    from pipeline.identification.output_error_fit import OutputErrorFit
    from pipeline.problem.measurement import Measurement
    from pipeline.rotor.bearing_table import BearingTable


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
        times = [(seconds(lambda: one.fit(one.measurement)), ross_seconds(simulated)) for _ in range(5)]
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
        fit, again, few = one.fit(one.measurement), one.measured_again(), 10
        clean = one.measurement.response.predict(one.modelled)
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
    measurement: Measurement
    modelled: BearingTable

    def fit(self, measurement: Measurement) -> OutputErrorFit:
        """A fit of some data of the experiment."""
        from pipeline.identification.output_error_fit import fit_output_error
        from pipeline.identification.training import setup_of

        return fit_output_error(measurement, setup_of(self.config))

    def measured_again(self) -> Callable[[], Measurement]:
        """A function that measures the machine once more, with other noise of 1 %."""
        import numpy as np

        from pipeline.data.sensors import Sensors, list_directions, measure
        from pipeline.data.simulate import simulate
        from pipeline.stages.generate import configure_excitations

        clean = simulate(self.measurement.rotor, self.modelled, configure_excitations(self.config))
        sensors = Sensors(list_directions(self.measurement.rotor.bearing_nodes), multiplicative=0.01)
        generator = np.random.default_rng(0)
        return lambda: replace(self.measurement, dataset=measure(clean, sensors, generator))


def _ready(experiment: str, folder: Path) -> _Ready:
    from pipeline.config.compose import compose_config
    from pipeline.stages.measurement import load_measurement, load_modelled

    config = compose_config([f"experiment={experiment}", f"output='{folder}'", "tracking=none"])
    measurement = load_measurement(config)
    modelled = load_modelled(config, measurement)
    assert modelled is not None
    return _Ready(config, measurement, modelled)
