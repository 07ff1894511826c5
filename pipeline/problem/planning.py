"""The runs that an experimenter could make, and what the probes would read of them, before anything is measured.

Legend: R runs, S speeds, B bearings.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace

import numpy as np

from pipeline.config.schema import Config
from pipeline.data.dataset import Excitation
from pipeline.data.excitation_files import Runs, list_candidates, scale_runs
from pipeline.data.sensors import list_directions, project
from pipeline.data.simulate import simulate
from pipeline.errors import ConfigError
from pipeline.problem.accuracy import Plan, RunInformation, reach, run_information, scale_to_limits
from pipeline.problem.configured import (
    build_measurement,
    configure_excitations,
    configure_frequencies,
    configure_sensors,
)
from pipeline.problem.design import choose, plan_covariance, unknown_sizes, whiten_plan
from pipeline.problem.design import run_information as design_information
from pipeline.problem.measurement import Measurement
from pipeline.rotor.bearing_table import BearingTable
from pipeline.rotor.model import RotorModel
from pipeline.rotor.stored import load_modelled_bearings, require_nodes


def list_possible(config: Config, rotor: RotorModel) -> Runs:
    """:func:`list_candidates` of the machine. Raises ConfigError for a node that the rotor lacks."""
    possible = list_candidates(config.machine.candidates)
    require_nodes(rotor, "machine.candidates", [weight.node for acting in possible for weight in acting])
    return possible


@dataclass(frozen=True, eq=False)
class Planner:
    """A machine that runs are planned for."""

    config: Config
    rotor: RotorModel
    clearances: np.ndarray  # (B,) m, infinite for a bearing that states none

    def measure(self, runs: Runs, bearings: BearingTable) -> Measurement:
        """What the probes would read of the runs on these bearings, without noise."""
        complete = simulate(self.rotor, bearings, tuple(itertools.chain.from_iterable(runs)))
        channels = configure_sensors(self.config, self.rotor).channels
        seen = complete if channels is None else project(complete, channels)
        return build_measurement(self.config, self.rotor, seen, bearings)

    def limit(self, runs: Runs, *tables: BearingTable) -> Runs:
        """The runs, made smaller where an orbit would leave its share of the clearance on one of these bearings."""
        scales = []
        for bearings in tables:
            complete = simulate(self.rotor, bearings, tuple(itertools.chain.from_iterable(runs)))
            motion = project(complete, list_directions(self.rotor.bearing_nodes)).displacement
            orbits = motion.reshape(len(motion), -1, 2, len(runs))
            scales.append(scale_to_limits(orbits, self.config.design.clearance * self.clearances))
        return scale_runs(runs, np.min(scales, axis=0))


def list_clearances(config: Config, rotor: RotorModel) -> np.ndarray:
    """(B,) m, of the modelled bearings; infinite for one that states none."""
    bearings = [config.machine.bearings.at(node) for node in rotor.bearing_nodes]
    return np.array([getattr(bearing, "radial_clearance", np.inf) for bearing in bearings])


@dataclass(frozen=True, eq=False)
class Designer:
    """What the candidate runs would tell of the coefficients, on the modelled bearings."""

    planner: Planner
    prior: BearingTable
    allowed: Runs

    def measure(self, runs: Runs) -> Measurement:
        """What the probes would read of the runs."""
        return self.planner.measure(runs, self.prior)

    def inform(self, plan: Measurement) -> RunInformation:
        """What each run of the plan would tell."""
        return run_information(plan, self.planner.config.design.functions)

    def reach(self, accuracy: float) -> tuple[Plan, dict[str, float], dict[str, float]]:
        """The best plan, the deviation of each coefficient with it, and what would help -> the worst deviation with it
        at all speeds; nothing where the ``accuracy`` is reached."""
        plan = self.measure(self.allowed)
        information = self.inform(plan)
        best = reach(information, accuracy, self.planner.config.design.runs, self.steps())
        return best, information.medians(best.runs, best.every), {} if best.reached else self._try_cures(plan)

    def steps(self) -> list[int]:
        """Every how many of the speeds could be enough: both ends stay, and two speeds for each term or more."""
        intervals, least = len(self.prior.speeds) - 1, 2 * self.planner.config.design.functions - 1
        return [k for k in range(1, intervals + 1) if intervals % k == 0 and intervals // k >= least] or [1]

    def _try_cures(self, plan: Measurement) -> dict[str, float]:
        most, can = self.planner.config.design.runs, self.planner.config.machine.candidates

        def worst(measurement: Measurement, runs: int = most) -> float:
            information = self.inform(measurement)
            return information.worst(reach(information, 0.0, runs, [1]).runs)

        double = scale_runs(self.allowed, np.full(len(self.allowed), 2.0))
        cures = {
            f"all {len(self.allowed)} candidate runs": worst(plan, len(self.allowed)),
            "weights and forces twice as large": worst(self.measure(double)),
        }
        if plan.noise.additive and plan.noise.multiplicative:
            cures["probes without a floor"] = worst(replace(plan, noise=replace(plan.noise, additive=0.0)))
        if plan.parameters:
            cures["a model that is known exactly"] = worst(replace(plan, parameters=()))
        if not (can.force_nodes and "backward" in can.whirls):
            backward = tuple(
                (Excitation(f"backward_force_{n}", "force", n, can.force, 0.0, "backward"),)
                for n in can.force_nodes or can.unbalance_nodes
            )
            beside = self.planner.limit(backward, self.prior)
            cures["a force that turns backward"] = worst(self.measure(self.allowed + beside))
        return cures


def choose_best(config: Config, rotor: RotorModel) -> tuple[Runs, dict[str, Measurement]]:
    """The candidate runs that would identify best with x and y everywhere, and the measurements of the ``configured``
    and the ``designed`` runs. Raises ConfigError for more runs than there are candidates."""
    design, possible = config.design, list_possible(config, rotor)
    if design.runs > len(possible):
        raise ConfigError(f"design.runs must be at most the {len(possible)} candidates, but got {design.runs}")
    every = config.machine.speeds.rad_s()
    speeds = every[np.unique(np.linspace(0, len(every) - 1, min(design.speeds, len(every))).round().astype(int))]
    prior = load_modelled_bearings(config.machine.rotor, config.machine.bearings, speeds)

    def plan(runs: Runs, frequencies: np.ndarray | None = None) -> Measurement:
        acting = tuple(itertools.chain.from_iterable(runs))
        return build_measurement(config, rotor, simulate(rotor, prior, acting, frequencies), prior)

    everything = plan(possible)
    white = whiten_plan(everything, everything.dataset, plan_covariance(everything))
    information = design_information(white, len(possible), unknown_sizes(everything))
    present = everything.unknowns.present
    chosen = tuple(possible[c] for c in choose(information, present, design.runs, design.criterion))
    plans = {
        "configured": plan((configure_excitations(config),), configure_frequencies(config, speeds)),
        "designed": plan(chosen),
    }
    return chosen, plans
