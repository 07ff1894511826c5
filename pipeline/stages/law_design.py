"""The oil temperatures, loads and runs that bring the numbers of bearing laws to ``design.accuracy``."""

from __future__ import annotations

import shlex
from collections.abc import Sequence

import numpy as np

from pipeline.config.operating import column_of
from pipeline.config.schema import Config
from pipeline.data.operating import name_state
from pipeline.errors import ConfigError
from pipeline.laws.law_set import make_laws
from pipeline.problem.law_design import (
    LawCandidates,
    LawPlan,
    State,
    clearances_of,
    guess_at,
    inform_candidates,
    list_states,
    plan_by_states,
)
from pipeline.problem.planning import Planner, list_possible
from pipeline.problem.ranking import find_least
from pipeline.reporting.console import say, table
from pipeline.rotor.stored import load_rotor
from pipeline.stages.analysis import Analysis
from pipeline.stages.diagnose import describe_noise
from pipeline.stages.execution import StageOutput
from pipeline.stages.planned_runs import write_design


def reach_numbers(analysis: Analysis) -> StageOutput:
    """``design.json`` and ``designed_excitation.yaml``, which can be used at once.

    Raises ConfigError for an accuracy, laws or conditions that are missing.
    """
    config, machine, accuracy = analysis.config, analysis.config.machine, analysis.config.design.accuracy
    rotor = load_rotor(machine.rotor)
    if machine.laws is None or accuracy is None:
        missing = "machine.laws" if machine.laws is None else "design.accuracy (such as 0.02)"
        raise ConfigError(
            f"stage=design with model={config.model.kind} must have {missing}, but there is none: write it, or choose "
            "another model"
        )
    laws = make_laws(machine.laws, rotor.bearing_nodes)
    states, planner = list_states(config, laws), Planner(config, rotor, clearances_of(laws))
    tables = [guess_at(config, laws, state) for state in states]
    allowed = planner.limit(list_possible(config, rotor), *tables)
    candidates = inform_candidates(planner, laws, allowed, tables)
    plans = plan_by_states(candidates, len(states), config.design.runs, accuracy)
    best = plans[find_least({i: plan.worst for i, plan in enumerate(plans)})]
    _print(config, candidates, plans, best, states)
    summary = _summarize(candidates, plans, best, states, accuracy)
    overrides = _override_states([states[t] for t in best.states])
    written = write_design(analysis, [allowed[c] for c in best.runs], machine.speeds, summary, overrides)
    return StageOutput({"worst": best.worst}, {"rotor_fingerprint": rotor.fingerprint}, written)


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
