"""The oil temperatures, loads and runs that bring the numbers of bearing laws to ``design.accuracy``."""

from __future__ import annotations

import itertools
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from pipeline.config.messages import quote_override
from pipeline.config.operating import column_of
from pipeline.config.schema import Config
from pipeline.data.operating import name_state
from pipeline.data.sensors import list_directions, project
from pipeline.data.simulate import simulate
from pipeline.errors import ConfigError, nearest
from pipeline.files import write_json, write_text
from pipeline.laws.build import make_laws
from pipeline.laws.journal import JournalLaw
from pipeline.laws.law_set import LawSet
from pipeline.problem.accuracy import scale_to_limits
from pipeline.problem.law_design import LawCandidates, LawPlan, plan_by_states
from pipeline.problem.law_information import add_rows, guess_table, inform, law_rows
from pipeline.problem.measurement import Measurement
from pipeline.problem.ranking import find_least
from pipeline.reporting.console import say, table
from pipeline.rotor.model import RotorModel
from pipeline.rotor.stored import load_rotor
from pipeline.stages.diagnose import describe_noise
from pipeline.stages.execution import StageOutput
from pipeline.stages.generate import configure_sensors
from pipeline.stages.measurement import build_measurement
from pipeline.stages.planned_runs import Runs, format_runs, list_candidates, scale_runs
from pipeline.stages.workspace import locate_files, require_nodes
from pipeline.units import RAD_S_PER_RPM

State = Mapping[str, float]
"""Condition -> its value, SI."""


@dataclass(frozen=True)
class LawDesigner:
    """A machine whose bearings are as the laws' guesses have them."""

    config: Config
    rotor: RotorModel
    laws: LawSet

    def bearings(self, state: State) -> tuple[np.ndarray, dict[str, np.ndarray]]:
        """Speeds (S,) rad/s, and the conditions at each of them."""
        speeds = np.array(self.config.machine.speeds.rpm()) * RAD_S_PER_RPM
        return speeds, {name: np.full(len(speeds), value) for name, value in state.items()}

    def measure(self, runs: Runs, state: State) -> Measurement:
        """What the probes would read, without noise."""
        prior = guess_table(self.laws, *self.bearings(state))
        complete = simulate(self.rotor, prior, tuple(itertools.chain.from_iterable(runs)))
        channels = configure_sensors(self.config, self.rotor).channels
        seen = complete if channels is None else project(complete, channels)
        return build_measurement(self.config, self.rotor, seen, prior)

    def limit(self, runs: Runs, states: Sequence[State]) -> Runs:
        """The runs, made smaller where an orbit would leave its share of the clearance in one of the states."""
        clearance = [law.clearance.value if isinstance(law, JournalLaw) else np.inf for law in self.laws.laws]
        scales = []
        for state in states:
            prior = guess_table(self.laws, *self.bearings(state))
            complete = simulate(self.rotor, prior, tuple(itertools.chain.from_iterable(runs)))
            motion = project(complete, list_directions(self.rotor.bearing_nodes)).displacement
            limits = self.config.design.clearance * np.array(clearance)
            scales.append(scale_to_limits(motion.reshape(len(motion), -1, 2, len(runs)), limits))
        return scale_runs(runs, np.min(scales, axis=0))


def reach_numbers(config: Config) -> StageOutput:
    """``design.json`` and ``designed_excitation.yaml``, which can be used at once.

    Raises ConfigError for an accuracy, laws or conditions that are missing.
    """
    rotor, machine, accuracy = load_rotor(config.machine.rotor), config.machine, config.design.accuracy
    if machine.laws is None or accuracy is None:
        missing = "machine.laws" if machine.laws is None else "design.accuracy (such as 0.02)"
        raise ConfigError(
            f"stage=design with model={config.model.kind} must have {missing}, but there is none: write it, or choose "
            "another model"
        )
    designer = LawDesigner(config, rotor, make_laws(machine.laws, rotor.bearing_nodes))
    states, possible = _list_states(config, designer.laws), list_candidates(machine.candidates)
    require_nodes(rotor, "machine.candidates", [weight.node for acting in possible for weight in acting])
    allowed = designer.limit(possible, states)
    candidates = _inform(config, designer, allowed, states)
    plans = plan_by_states(candidates, len(states), config.design.runs, accuracy)
    best = plans[find_least({i: plan.worst for i, plan in enumerate(plans)})]
    chosen = [allowed[c] for c in best.runs]
    summary = _summarize(candidates, plans, best, states, accuracy)
    summary |= {"runs": [acting[0].run for acting in chosen], "stated_noise": config.stated_noise.model_dump()}
    _print(config, candidates, plans, best, states)
    folder = locate_files(config).folder
    written = [
        write_text(folder / "designed_excitation.yaml", format_runs(config, chosen, machine.speeds)),
        write_json(folder / "design.json", summary),
    ]
    say(
        f"use them with: python -m pipeline stage=train {config.chosen} "
        f"{quote_override('machine.runs_file', str(written[0]))} {quote_override('output', f'{folder}_designed')}"
        + _override_states([states[t] for t in best.states])
    )
    return StageOutput({"worst": best.worst}, {"rotor_fingerprint": rotor.fingerprint}, written)


def _list_states(config: Config, laws: LawSet) -> list[State]:
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


def _inform(config: Config, designer: LawDesigner, runs: Runs, states: Sequence[State]) -> LawCandidates:
    names = [parameter.name for parameter in designer.laws.parameters]
    asked = config.design.numbers or names
    for name in asked:
        if name not in names:
            raise ConfigError(
                f"design.numbers must be unknown numbers of machine.laws, but got {name}: {nearest(name, names)}"
            )
    plans = [designer.measure(runs, state) for state in states]
    nothing = inform(plans[0])
    readings = [[add_rows(rows) for rows in np.moveaxis(law_rows(plan), 2, 0)] for plan in plans]
    return LawCandidates(nothing.alone(), np.array(readings), np.array([name in asked for name in names]))


def _summarize(
    candidates: LawCandidates, plans: Sequence[LawPlan], best: LawPlan, states: Sequence[State], accuracy: float
) -> dict[str, object]:
    deviation = candidates.with_runs(best.states, best.runs).deviation
    names = [parameter.name for parameter in candidates.nothing.parameters]
    return {
        "accuracy": accuracy,
        "reached": best.worst <= accuracy,
        "predicted": dict(zip(names, map(float, deviation), strict=True)),
        "states": [dict(states[t]) for t in best.states],
        "by_number_of_states": [
            {"states": [name_state(states[t]) for t in plan.states], "runs": len(plan.runs), "worst": plan.worst}
            for plan in plans
        ],
    }


def _print(
    config: Config, candidates: LawCandidates, plans: Sequence[LawPlan], best: LawPlan, states: Sequence[State]
) -> None:
    accuracy = config.design.accuracy or 0.0
    where, runs = _name(best, states), f"{len(best.runs)} run{'s' if len(best.runs) > 1 else ''}"
    rows = [
        [f"{len(plan.states)}", _name(plan, states), f"{len(plan.runs)}", f"{100 * plan.worst:.2g}"] for plan in plans
    ]
    title = f"{config.name}: the number that is known least, % (one standard deviation, at {describe_noise(config)})"
    table(title, ["states", "which", "runs", "worst, %"], rows)
    deviation, before = candidates.with_runs(best.states, best.runs).deviation, candidates.nothing.deviation
    header = ["number", "before, %", "with this plan, %", f"at most {100 * accuracy:g}"]
    table(
        f"{config.name}: numbers of the bearing laws with {runs} at {where}",
        header,
        [
            [
                parameter.name,
                f"{100 * a:.2g}",
                f"{100 * b:.2g}",
                "" if b <= accuracy else "not reached" if w else "not asked",
            ]
            for parameter, a, b, w in zip(
                candidates.nothing.parameters, before, deviation, candidates.wanted, strict=True
            )
        ],
    )
    if best.worst <= accuracy:
        say(
            f"{config.name}: measure {runs} at {where}: every number asked for is known to "
            f"{100 * accuracy:g} % or better"
        )
        return
    say(
        f"{config.name}: {100 * accuracy:g} % can't be reached with {runs} at {where}: allow more runs "
        "(design.runs) or conditions further apart (design.operating), or give a number as known"
    )


def _name(plan: LawPlan, states: Sequence[State]) -> str:
    return "; ".join(name_state(states[t]) for t in plan.states)


def _override_states(states: Sequence[State]) -> str:
    """The states as an override, where they are every combination of some values."""
    values = {name: list(dict.fromkeys(state[name] for state in states)) for name in states[0]} if states[0] else {}
    if not values or np.prod([len(levels) for levels in values.values()]) != len(states):
        return ""
    parts = []
    for name, value in values.items():
        column = column_of(name)
        parts.append(f"{name}: [{', '.join(f'{level:g} {column.unit}' for level in column.from_si(np.array(value)))}]")
    return " " + shlex.quote(f"machine.operating={{{', '.join(parts)}}}")
