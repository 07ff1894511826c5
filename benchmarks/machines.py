"""Modelled machines to measure on, made without files; the tests use them too."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache, cached_property
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import numpy as np

    from pipeline.config.schema import Config
    from pipeline.data.dataset import Excitation, VibrationDataset
    from pipeline.problem.measurement import Measurement
    from pipeline.problem.residual import BearingEquations
    from pipeline.rotor.bearing_table import BearingTable
    from pipeline.rotor.model import RotorModel


@dataclass(frozen=True, eq=False)
class Machine:
    """A modelled machine: its configuration, and what the straight line of data makes of it."""

    config: Config
    rotor: RotorModel
    bearings: BearingTable
    excitations: tuple[Excitation, ...]

    @property
    def speeds(self) -> np.ndarray:
        """(S,) rad/s."""
        return self.bearings.speeds

    @property
    def runs(self) -> tuple[str, ...]:
        """Names of the R runs."""
        return tuple(dict.fromkeys(excitation.run for excitation in self.excitations))

    @property
    def frequencies(self) -> np.ndarray | None:
        """(S, R) rad/s of the excitation; None where it turns with the rotor."""
        from pipeline.problem.configured import configure_frequencies

        return configure_frequencies(self.config, self.speeds)

    @cached_property
    def response(self) -> np.ndarray:
        """(S, n, R) complex response of every lateral DOF, m and rad."""
        return self.respond()

    @cached_property
    def dataset(self) -> VibrationDataset:
        """x and y of every node, without noise."""
        from pipeline.data.simulate import simulate

        return simulate(self.rotor, self.bearings, self.excitations, self.frequencies)

    @cached_property
    def equations(self) -> BearingEquations:
        """The small system at the bearings."""
        return self.measurement.equations

    @cached_property
    def measurement(self) -> Measurement:
        """The clean data, as the configuration asks about them."""
        return self.measured(self.dataset, self.config)

    def measured(self, dataset: VibrationDataset, config: Config) -> Measurement:
        """Other data of the machine, as another configuration asks about them; the bearings are the known ones."""
        from pipeline.problem.configured import build_measurement

        return build_measurement(config, self.rotor, dataset, self.bearings)

    def respond(self) -> np.ndarray:
        """:attr:`response`, computed each time."""
        from pipeline.data.simulate import solve_response

        return solve_response(self.rotor, self.bearings, self.excitations, self.runs, self.frequencies)


@cache
def machine(*overrides: str) -> Machine:
    """The machine of these overrides, made once."""
    import numpy as np

    from pipeline.config.compose import compose_config
    from pipeline.problem.configured import configure_excitations
    from pipeline.rotor.ross_adapter import bearing_table
    from pipeline.rotor.stored import load_rotor
    from pipeline.units import RAD_S_PER_RPM

    config = compose_config(overrides)
    speeds = np.array(config.machine.speeds.rpm()) * RAD_S_PER_RPM
    bearings = bearing_table(config.machine.rotor, config.machine.bearings, speeds)
    return Machine(config, load_rotor(config.machine.rotor), bearings, configure_excitations(config))


def refined(experiment: str, factor: int, *overrides: str) -> Machine:
    """The machine of an experiment with ``factor`` times the elements."""
    from pipeline.config.compose import compose_config

    config = compose_config([f"experiment={experiment}"])
    made = [f"experiment={experiment}"]
    made.append(f"machine.rotor.bearing_nodes={[factor * node for node in config.machine.rotor.bearing_nodes]}")
    for i, segment in enumerate(config.machine.rotor.shaft):
        made.append(f"machine.rotor.shaft.{i}.elements={factor * segment.elements}")
    for i, disc in enumerate(config.machine.rotor.discs):
        made.append(f"machine.rotor.discs.{i}.node={factor * disc.node}")
    for i, run in enumerate(config.machine.runs):
        for j, force in enumerate(run.unbalances):
            made.append(f"machine.runs.{i}.unbalances.{j}.node={factor * force.node}")
    return machine(*made, *overrides)
