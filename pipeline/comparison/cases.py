"""The cases that every method is tried on: one modelled machine under several noises, sensors and numbers of speeds."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from pipeline.config.comparison import ComparisonConfig, SensorSet
from pipeline.config.identification import IdentifyConfig
from pipeline.data.dataset import VibrationDataset
from pipeline.data.noise import NoiseModel
from pipeline.data.operating import split_states
from pipeline.data.sensors import Channels, Sensors, list_directions, measure
from pipeline.laws.law_set import NO_LAWS, LawSet
from pipeline.problem.measurement import Guess, Measurement
from pipeline.rotor.bearing_table import BearingTable
from pipeline.rotor.model import RotorModel


@dataclass(frozen=True)
class Case:
    """What is measured, and how well."""

    noise: float  # share of each reading
    sensors: SensorSet
    speeds: int  # how many
    data_set: int = 0  # which noise


def choose_main_case(settings: ComparisonConfig, n_speeds: int) -> Case:
    """The largest noise at as many speeds as there are, by the sensors at the bearings, if they are asked for."""
    sensors: SensorSet = "bearings" if "bearings" in settings.sensors else settings.sensors[0]
    return Case(max(settings.noise), sensors, min(max(settings.speeds), n_speeds))


def list_cases(settings: ComparisonConfig, n_speeds: int) -> tuple[Case, ...]:
    """Every noise with every sensor set at all speeds, and the main case with fewer speeds: each with its data sets."""
    main = choose_main_case(settings, n_speeds)
    made = [Case(noise, sensors, main.speeds) for sensors in settings.sensors for noise in settings.noise]
    made += [replace(main, speeds=min(count, n_speeds)) for count in settings.speeds]
    counts = {
        case: settings.data_sets if case == main else settings.other_data_sets if case.noise else 1 for case in made
    }
    made += [replace(case, data_set=i) for case, count in counts.items() for i in range(count)]
    return tuple(dict.fromkeys(made))


@dataclass(frozen=True, eq=False)
class Machine:
    """The modelled machine that methods are tried on: all that a result follows from, but for the method and case."""

    rotor: RotorModel
    modelled: BearingTable  # the truth
    vibration: VibrationDataset  # clean, at every node
    identify: IdentifyConfig
    settings: ComparisonConfig
    noise_seed: int
    seed: int
    laws: LawSet = NO_LAWS  # what is known of the bearings beforehand

    def measure(self, case: Case, least_noise: float = 1e-9) -> Measurement:
        """What a method sees of a case: the truth is hidden except for what is known.

        The noise of a data set is the same, scaled, at every level of it. Of clean data a method is told
        ``least_noise``: weights need some, and arithmetic leaves less.
        """
        unknowns, truth = self.identify.unknowns_of(self.rotor.bearing_nodes), self.truth(case)
        model, floor = self.settings.response.model, self.settings.floor if case.noise else 0.0
        sensors = Sensors(self._channels(case.sensors), additive=floor, multiplicative=case.noise)
        generator = np.random.default_rng([self.noise_seed, case.data_set])
        return Measurement(
            rotor=self.rotor,
            dataset=measure(self.vibration.at(self.speeds(case)), sensors, generator),
            known=replace(truth, values=np.where(unknowns.identified[:, None], 0.0, truth.values)),
            noise=NoiseModel(floor, max(case.noise, least_noise)),
            unknowns=unknowns,
            guess=Guess(model.initial_stiffness, model.initial_damping),
        )

    def truth(self, case: Case) -> BearingTable:
        """The modelled coefficients at the speeds of a case."""
        return self.modelled.at(self.speeds(case))

    @property
    def n_speeds(self) -> int:
        """How many speeds there are, at the operating condition that has most."""
        return max(len(points) for points in self._states)

    @cached_property
    def _states(self) -> list[np.ndarray]:
        """Indices of the points of each operating condition; of all points where there is none."""
        return [points for _, points in split_states(self.vibration.speeds, self.vibration.operating)]

    def speeds(self, case: Case) -> np.ndarray:
        """Indices of the speeds of a case, evenly spread from the first to the last at each operating condition."""
        chosen = [
            points[np.unique(np.linspace(0, len(points) - 1, min(case.speeds, len(points))).round().astype(int))]
            for points in self._states
        ]
        return np.sort(np.concatenate(chosen))

    def _channels(self, sensors: SensorSet) -> Channels | None:
        if sensors == "all":
            return None
        location = self.settings.location
        middle = self.rotor.n_nodes // 2 if location is None else location
        return list_directions(self.rotor.bearing_nodes if sensors == "bearings" else (middle,))
