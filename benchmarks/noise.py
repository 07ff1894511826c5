"""The response fit of noisy data, against simulations."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

from benchmarks.machines import machine
from benchmarks.measure import BENCHMARKS, Aim, Times, seconds
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


def _ready(experiment: str, folder: Path) -> _Ready:
    from pipeline.config.compose import compose_config
    from pipeline.stages.measurement import load_measurement, load_modelled

    config = compose_config([f"experiment={experiment}", f"output='{folder}'", "tracking=none"])
    measurement = load_measurement(config)
    modelled = load_modelled(config, measurement)
    assert modelled is not None
    return _Ready(config, measurement, modelled)
