"""Noisy data from probes at the bearings alone: the bars of the noisy experiments. Slow."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from conftest import DATA, Artifacts

from pipeline.config.compose import compose_config
from pipeline.config.schema import Config
from pipeline.data.sensors import NoiseModel, Sensors, list_directions, measure
from pipeline.data.simulate import simulate
from pipeline.identification.fit import fit
from pipeline.identification.output_error_fit import OutputErrorFit, fit_output_error
from pipeline.identification.training import FitSetup, setup_of
from pipeline.problem.configured import configure_excitations
from pipeline.problem.measurement import Measurement
from pipeline.rotor.bearing_table import BearingTable
from pipeline.stages.measurement import load_measurement, load_modelled

pytestmark = pytest.mark.slow


@pytest.mark.parametrize("experiment", ["noisy_stiffness", "noisy_direct", "noisy_all"])
def test_the_bound_and_the_intervals_are_those_of_a_hundred_data_sets(experiment: str, artifacts: Artifacts) -> None:
    """The check holds their errors against the bars (conf/thresholds)."""
    assert artifacts.read(experiment, "robustness")["data_sets"] == 100


@dataclass(frozen=True, eq=False)
class Ready:
    """An experiment before its fit, and the machine that its data were made of."""

    config: Config
    measurement: Measurement
    modelled: BearingTable
    setup: FitSetup

    def fit(self, measurement: Measurement | None = None) -> OutputErrorFit:
        """The fit of its own data, or of others."""
        return fit_output_error(measurement or self.measurement, self.setup)

    def measured_again(self, noise: float = 0.01) -> Callable[[], Measurement]:
        """A function that measures the machine once more, with other noise."""
        machine = simulate(self.measurement.rotor, self.modelled, configure_excitations(self.config))
        sensors = Sensors(list_directions(self.measurement.rotor.bearing_nodes), NoiseModel(0.0, noise))
        generator = np.random.default_rng(0)
        return lambda: replace(self.measurement, dataset=measure(machine, sensors, generator))


def ready(experiment: str, folder: Path, *overrides: str) -> Ready:
    """The experiment, its data in ``folder``."""
    config = compose_config([f"experiment={experiment}", f"output='{folder}'", "tracking=none", *overrides])
    measurement = load_measurement(config)
    return Ready(config, measurement, load_modelled(config, measurement), setup_of(config))


def test_the_residual_on_the_same_data_is_several_times_worse(artifacts: Artifacts, tmp_path: Path) -> None:
    """The paper's loss and network, each data set fitted by both; a typical one of six."""
    ours = ready("noisy_stiffness", artifacts.copied("noisy_stiffness", DATA, tmp_path / "x"))
    paper = setup_of(compose_config(["experiment=noisy_stiffness_residual"]))
    errors: dict[str, list[list[np.ndarray]]] = {"response": [], "residual": []}
    again = ours.measured_again()
    for _ in range(6):
        data = again()
        found = {"response": ours.fit(data).identified, "residual": fit(data, paper).model}
        for name, identified in found.items():
            relative = np.abs(identified.table(data.known).values / ours.modelled.values - 1)[..., [0, 3]]
            errors[name].append([np.median(relative, axis=1).ravel(), np.sqrt((relative**2).mean(axis=1)).ravel()])
    median, square = np.median(errors["residual"], axis=0) / np.median(errors["response"], axis=0)
    assert median.min() > 2
    assert square.min() > 10


def test_the_error_falls_in_proportion_to_the_noise(tmp_path: Path) -> None:
    """Slope 1 +- 0.15 from 0.01 % to 1 %, over ten data sets each; a tenth of the speeds shows it as well."""
    noises, errors = np.array([1e-4, 1e-3, 1e-2]), []
    for noise in noises:
        stated = [f"{key}.multiplicative={noise}" for key in ("machine.probes", "stated_noise")]
        one = ready("noisy_stiffness", tmp_path / f"noise {noise}", *stated, "machine.speeds.step_rpm=100")
        again = one.measured_again(noise)
        fits = [one.fit(again()) for _ in range(10)]
        found = np.array([fit.problem.unknowns(fit.weights)[0][0].numpy() for fit in fits])
        truth = np.stack([one.modelled.values[m, :, [0, 3][u]] for m, u in fits[0].problem.active], axis=1)
        errors.append(np.sqrt(np.median((found / truth - 1) ** 2, axis=(0, 1))))
    np.testing.assert_allclose(np.polyfit(np.log(noises), np.log(np.array(errors)), 1)[0], 1.0, atol=0.15)
