"""The runs that an experimenter could make, and what the probes would read of them, before anything is measured.

Legend: R runs, S speeds, B bearings.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from pipeline.config.operating import column_of
from pipeline.config.schema import Config
from pipeline.data.dataset import Excitation
from pipeline.data.excitation_files import Runs, list_candidates, scale_runs
from pipeline.data.operating import space_evenly
from pipeline.data.sensors import Channels, list_directions, project
from pipeline.data.simulate import simulate
from pipeline.errors import ConfigError, nearest
from pipeline.laws.journal import JournalLaw
from pipeline.laws.law_set import LawSet
from pipeline.problem.configured import (
    build_measurement,
    configure_excitations,
    configure_frequencies,
    configure_sensors,
)
from pipeline.problem.design import (
    Candidates,
    Plan,
    choose,
    inform_coefficients,
    inform_numbers,
    plan_speeds,
    run_information,
    scale_to_limits,
    unknown_sizes,
    whiten_plan,
)
from pipeline.problem.law_information import guess_table
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
    """A machine that runs are planned for, and the bearings that it is thought to have."""

    config: Config
    rotor: RotorModel
    tables: Sequence[BearingTable]  # in each state that could be set
    clearances: np.ndarray  # (B,) m, infinite for a bearing that states none

    @cached_property
    def allowed(self) -> Runs:
        """The candidate runs, small enough. Raises ConfigError for a node that the rotor lacks."""
        return self.limit(list_possible(self.config, self.rotor))

    def measure(self, runs: Runs, added: Channels = ()) -> list[Measurement]:
        """What the probes, and the ``added`` ones, would read of the runs in each state, without noise."""
        acting, channels = tuple(itertools.chain(*runs)), configure_sensors(self.config, self.rotor).channels
        seen = [simulate(self.rotor, bearings, acting) for bearings in self.tables]
        seen = seen if channels is None else [project(complete, channels + added) for complete in seen]
        pairs = zip(seen, self.tables, strict=True)
        return [build_measurement(self.config, self.rotor, dataset, bearings) for dataset, bearings in pairs]

    def limit(self, runs: Runs) -> Runs:
        """The runs, made smaller where an orbit would leave its share of the clearance in one of the states."""
        acting, scales = tuple(itertools.chain(*runs)), []
        for bearings in self.tables:
            complete = simulate(self.rotor, bearings, acting)
            motion = project(complete, list_directions(self.rotor.bearing_nodes)).displacement
            orbits = motion.reshape(len(motion), -1, 2, len(runs))
            scales.append(scale_to_limits(orbits, self.config.design.clearance * self.clearances))
        return scale_runs(runs, np.min(scales, axis=0))


# --- for coefficients, on the modelled bearings --------------------------------------------------------


def plan_coefficients(config: Config, rotor: RotorModel) -> Planner:
    """That of the modelled machine, at its speeds."""
    machine = config.machine
    prior = load_modelled_bearings(machine.rotor, machine.bearings, machine.speeds.rad_s())
    bearings = [machine.bearings.at(node) for node in rotor.bearing_nodes]
    return Planner(config, rotor, [prior], np.array([getattr(b, "radial_clearance", np.inf) for b in bearings]))


def reach(planner: Planner, accuracy: float) -> tuple[Plan, dict[str, float], dict[str, float]]:
    """The best plan, the deviation of each coefficient with it, and what would help -> the worst deviation with it at
    all speeds; nothing where the ``accuracy`` is reached."""
    design, (plan,), intervals = planner.config.design, planner.measure(planner.allowed), len(planner.tables[0].speeds)
    candidates = inform_coefficients(plan, design.functions)
    # Every how many of the speeds could be enough: both ends stay, and two speeds for each term or more.
    intervals, least = intervals - 1, 2 * design.functions - 1
    steps = [k for k in range(1, intervals + 1) if intervals % k == 0 and intervals // k >= least] or [1]
    best = plan_speeds(candidates, accuracy, design.runs, steps)
    cures = {} if best.worst <= accuracy else _try_cures(planner, plan)
    return best, candidates.medians(best.states, best.runs), cures


def _try_cures(planner: Planner, plan: Measurement) -> dict[str, float]:
    design, can, allowed = planner.config.design, planner.config.machine.candidates, planner.allowed

    def worst(measurement: Measurement, runs: int = design.runs) -> float:
        return plan_speeds(inform_coefficients(measurement, design.functions), 0.0, runs, [1]).worst

    double = scale_runs(allowed, np.full(len(allowed), 2.0))
    cures = {
        f"all {len(allowed)} candidate runs": worst(plan, len(allowed)),
        "weights and forces twice as large": worst(planner.measure(double)[0]),
    }
    if unseen := planner.rotor.unseen_casings(plan.dataset.channels):
        looking = planner.measure(allowed, list_directions(tuple(unseen.values())))[0]
        cures[f"probes on the casings of nodes {', '.join(map(str, unseen))}"] = worst(looking)
    if plan.noise.floored and plan.noise.multiplicative:
        cures["probes without a floor"] = worst(replace(plan, noise=plan.noise.with_floor(0.0)))
    if plan.parameters:
        cures["a model that is known exactly"] = worst(replace(plan, parameters=()))
    if not (can.force_nodes and "backward" in can.whirls):
        backward = tuple(
            (Excitation(f"backward_force_{n}", "force", n, can.force, 0.0, "backward"),)
            for n in can.force_nodes or can.unbalance_nodes
        )
        cures["a force that turns backward"] = worst(planner.measure(allowed + planner.limit(backward))[0])
    return cures


# --- for the numbers of bearing laws -------------------------------------------------------------------


State = Mapping[str, float]
"""Condition -> its value, SI."""


def list_states(config: Config, laws: LawSet) -> list[State]:
    """Every combination of the conditions that could be set. Raises ConfigError for one that is missing."""
    given = config.design.operating or config.machine.operating
    for name in laws.inputs:
        if name not in given:
            raise ConfigError(
                f"design.operating must have {name}, which the bearing laws need, but it has "
                f"{', '.join(given) or 'nothing'}: add the values that could be set, such as "
                f"{{{name}: [{', '.join(f'{n} {column_of(name).unit}' for n in (40, 55, 70))}]}}"
            )
    return [dict(zip(given, values, strict=True)) for values in itertools.product(*given.values())]


def plan_numbers(
    config: Config, rotor: RotorModel, laws: LawSet, states: Sequence[State]
) -> tuple[Planner, Candidates]:
    """That of bearings as the laws' guesses have them, and what each candidate run would tell in each state.

    Raises ConfigError for an unknown number.
    """
    names, speeds = [parameter.name for parameter in laws.parameters], config.machine.speeds.rad_s()
    wanted = config.design.numbers or names
    for name in wanted:
        if name not in names:
            raise ConfigError(
                f"design.numbers must be unknown numbers of machine.laws, but got {name}: {nearest(name, names)}"
            )
    spread = [{name: np.full(len(speeds), value) for name, value in state.items()} for state in states]
    clearances = [law.clearance.value if isinstance(law, JournalLaw) else np.inf for law in laws.laws]
    tables = [guess_table(laws, speeds, conditions) for conditions in spread]
    planner = Planner(config, rotor, tables, np.array(clearances))
    return planner, inform_numbers(planner.measure(planner.allowed), wanted)


# --- so many runs, whatever they reach -----------------------------------------------------------------


def choose_best(config: Config, rotor: RotorModel) -> tuple[Runs, dict[str, Measurement]]:
    """The candidate runs that would identify best with x and y everywhere, and the measurements of the ``configured``
    and the ``designed`` runs. Raises ConfigError for more runs than there are candidates."""
    design, possible = config.design, list_possible(config, rotor)
    if design.runs > len(possible):
        raise ConfigError(f"design.runs must be at most the {len(possible)} candidates, but got {design.runs}")
    every = config.machine.speeds.rad_s()
    speeds = every[space_evenly(len(every), design.speeds)]
    prior = load_modelled_bearings(config.machine.rotor, config.machine.bearings, speeds)

    def plan(runs: Runs, frequencies: np.ndarray | None = None) -> Measurement:
        acting = tuple(itertools.chain.from_iterable(runs))
        return build_measurement(config, rotor, simulate(rotor, prior, acting, frequencies), prior)

    everything = plan(possible)
    white = whiten_plan(everything, everything.dataset, everything.residual_root(everything.known))
    information = run_information(white, len(possible), unknown_sizes(everything))
    present = everything.unknowns.present
    chosen = tuple(possible[c] for c in choose(information, present, design.runs, design.criterion))
    plans = {
        "configured": plan((configure_excitations(config),), configure_frequencies(config, speeds)),
        "designed": plan(chosen),
    }
    return chosen, plans
