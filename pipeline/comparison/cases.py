"""Cases of the comparison, one modelled machine under several noises, sensors and numbers of speeds, and what a method
made of each: an answer with its errors, or the name of what it can't do.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from pydantic import BaseModel, ConfigDict

from pipeline.coefficients import COEFFICIENTS
from pipeline.config.comparison import ComparisonConfig, MethodName, SensorSet
from pipeline.data.dataset import VibrationDataset
from pipeline.data.operating import space_evenly, split_states
from pipeline.data.sensors import NoiseModel, Sensors, list_directions, measure
from pipeline.evaluation.errors import list_coverage, measure_errors
from pipeline.laws.law_set import NO_LAWS, LawSet
from pipeline.methods.catalogue import METHODS
from pipeline.methods.method import REQUIREMENTS, Estimate, MethodOptions, Refusal
from pipeline.parameters.identify import IdentifyConfig
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
        middle = self.rotor.n_nodes // 2 if self.settings.location is None else self.settings.location
        nodes = self.rotor.bearing_nodes if case.sensors == "bearings" else (middle,)
        channels = None if case.sensors == "all" else list_directions(nodes)
        sensors = Sensors(channels, NoiseModel(floor, case.noise))
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
        chosen = [points[space_evenly(len(points), case.speeds)] for points in self._states]
        return np.sort(np.concatenate(chosen))


# --- what a method made of a case -----------------------------------------------------------------


CoefficientResult = dict[str, float | None]
"""Percent, of one coefficient of one bearing: ``median_error``, ``p95_error``, ``median_deviation`` (stated, over the
modelled coefficient) and ``within_interval`` (of the speeds at which the modelled one is in the nominal 95 % interval);
the last two None where no deviation is stated."""


class Result(BaseModel):
    """One row of the comparison."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    method: MethodName
    case: Case  # what was measured
    outcome: str  # "answered", or a name of REQUIREMENTS
    words: str
    doubt: str
    seconds: float
    used_speeds: int | None = None  # where the method did not look at all of them
    coefficients: dict[str, dict[str, CoefficientResult]]  # node -> name; empty where there is no answer

    @property
    def answered(self) -> bool:
        """Whether there are coefficients."""
        return self.outcome == ANSWERED

    def error(self, name: str) -> float:
        """Median error over speed of a coefficient in percent, mean over the bearings that have it; NaN without one."""
        errors = [named[name]["median_error"] for named in self.coefficients.values() if name in named]
        return float(np.array(errors, dtype=float).mean()) if errors else float("nan")


ANSWERED = "answered"
MethodRun = tuple[MethodName, Case]
"""One method on one case."""


def judge_method(machine: Machine, run: MethodRun) -> Result:
    """Let a method identify a case. The truth is looked at when it has answered."""
    method, case = run
    data, started = machine.measure(case), time.process_time()
    answer, outcome = None, ANSWERED
    try:
        answer = METHODS[method].identify(data, MethodOptions(machine.settings, machine.seed, machine.laws))
        reason = answer.words
    except Refusal as refusal:
        outcome, reason = refusal.reason, str(refusal)
    except np.linalg.LinAlgError as error:
        outcome, reason = "singular", f"{REQUIREMENTS['singular']}, but: {error}"
    seconds = time.process_time() - started  # of the processor: what else runs does not count
    errors: dict[str, dict[str, CoefficientResult]] = {}
    if answer and np.isfinite(answer.coefficients.values).all():
        errors = _measure_errors(data, answer, machine, case)
    elif answer:
        outcome = "not_finite"
    # Clean data have no noise that chi-square could be held against.
    doubt = answer.doubt if answer and case.noise else ""
    return Result(
        method=method,
        case=case,
        outcome=outcome,
        words=reason,
        doubt=doubt,
        seconds=seconds,
        used_speeds=(answer and answer.n_speeds) or None,
        coefficients=errors,
    )


def _measure_errors(
    data: Measurement, answer: Estimate, machine: Machine, case: Case
) -> dict[str, dict[str, CoefficientResult]]:
    truth, names = machine.truth(case), data.unknowns.by_bearing
    every = measure_errors(answer.coefficients, truth, names)
    inside = list_coverage(answer.coefficients, truth, names)
    results: dict[str, dict[str, CoefficientResult]] = {}
    for b, node in enumerate(truth.nodes):
        for name, error in every[str(node)].items():
            deviation = answer.coefficients.spread[b, :, COEFFICIENTS.index(name)]
            median = float(100 * np.median(deviation / np.abs(truth.coefficient(name)[b])))
            results.setdefault(str(node), {})[name] = {
                "median_error": error["median_error_percent"],
                "p95_error": error["p95_error_percent"],
                "median_deviation": median if np.isfinite(median) else None,
                "within_interval": None if np.isnan(deviation).all() else inside[str(node)][name],
            }
    return results
