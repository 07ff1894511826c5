"""Designs of runs on screen: what each promises, and the file that says them to the program again."""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from pipeline.config.operating import column_of
from pipeline.config.runs import SpeedsConfig
from pipeline.config.schema import Config
from pipeline.data.dataset import Excitation
from pipeline.data.operating import name_state
from pipeline.problem.design import Candidates, Plan
from pipeline.problem.planning import State
from pipeline.problem.ranking import rank
from pipeline.reporting.console import say, table
from pipeline.write_numbers import write_number, write_rough

Runs = Sequence[Sequence[Excitation]]
Gains = Mapping[str, Mapping[str, float | None]]
"""``configured`` and ``designed`` -> unknown -> its relative deviation; None where it is free."""


# --- so many runs ------------------------------------------------------------------------------------


def print_gain(name: str, noise: str, summary: Mapping[str, Any], runs: Sequence[str]) -> None:
    """The deviations with the configured runs and with the designed ones, which have these names."""
    predicted: Gains = summary["predicted"]
    simulated: Gains = summary.get("simulated", {})
    plans = ("configured", "designed")
    sources = [values[plan] for values in (predicted, simulated) if values for plan in plans]
    header = ["bearing and unknown", *(f"{plan} runs" for plan in plans)]
    header += [f"{plan}, simulated" for plan in plans] if simulated else []
    table(
        f"{name}: standard deviation of least squares at {noise}, % of the coefficient",
        header,
        [
            [key, *("free" if (share := s[key]) is None else write_rough(100 * share) for s in sources)]
            for key in sources[0]
        ],
    )
    say(f"{name}: the best {len(runs)} runs are {', '.join(runs)}")
    if summary["gain"] is None:
        say("the configured runs leave an unknown free; these do not")
        return
    confirmed = f" (in simulations {write_number(summary['simulated_gain'], digits=3)} times)" if simulated else ""
    say(f"they lower the worst deviation {write_number(summary['gain'], digits=3)} times{confirmed}")


# --- to a stated accuracy ----------------------------------------------------------------------------


def print_reached(
    name: str,
    noise: str,
    accuracy: float,
    predicted: Mapping[str, float],
    cures: Mapping[str, float],
    chosen: Runs,
    rpm: Sequence[float],
) -> None:
    """The runs and speeds, the deviation of each coefficient with them, and what would help where it is too large."""
    table(
        f"{name}: predicted standard deviation at {noise}, % of the coefficient (median)",
        ["bearing and unknown", "designed runs", f"at most {100 * accuracy:g}"],
        [
            [key, write_rough(100 * share), "" if share <= accuracy else "not reached"]
            for key, share in predicted.items()
        ],
    )
    acting = "; ".join(
        f"{run[0].run}: "
        + ", ".join(f"{write_number(e.magnitude, digits=3)} {'kg m' if e.kind == 'unbalance' else 'N'}" for e in run)
        for run in chosen
    )
    say(f"{name}: {len(chosen)} runs ({acting}) at {len(rpm)} speeds from {rpm[0]:g} to {rpm[-1]:g} rpm")
    if max(predicted.values()) <= accuracy:
        say(f"every coefficient is predicted to {100 * accuracy:g} % or better")
        return
    short = {key: share for key, share in predicted.items() if share > accuracy}
    worst = rank(short)[0]
    say(
        f"{100 * accuracy:g} % can't be reached with {len(chosen)} runs for {len(short)} of {len(predicted)} "
        f"coefficients; the worst, {worst}, is known to {write_rough(100 * short[worst])} % at best"
    )
    for cure in reversed(rank(cures)):
        enough = " (enough)" if cures[cure] <= accuracy else ""
        say(f"with {cure} the worst is {write_rough(100 * cures[cure])} %{enough}")


# --- for the numbers of bearing laws -----------------------------------------------------------------


def summarize_states(
    candidates: Candidates, plans: Sequence[Plan], best: Plan, states: Sequence[State], accuracy: float
) -> dict[str, object]:
    """What ``design.json`` has."""
    return {
        "accuracy": accuracy,
        "reached": best.worst <= accuracy,
        "predicted": candidates.medians(best.states, best.runs),
        "states": [dict(states[t]) for t in best.states],
        "by_number_of_states": [
            {"states": [name_state(states[t]) for t in plan.states], "runs": len(plan.runs), "worst": plan.worst}
            for plan in plans
        ],
    }


def print_states(
    name: str,
    noise: str,
    candidates: Candidates,
    plans: Sequence[Plan],
    best: Plan,
    states: Sequence[State],
    accuracy: float,
) -> None:
    """The plans by the number of their states, and what the ``best`` of them tells of each number."""
    names = {plan: "; ".join(name_state(states[t]) for t in plan.states) for plan in [*plans, best]}
    where, runs = names[best], f"{len(best.runs)} run{'s' if len(best.runs) > 1 else ''}"
    rows = [[f"{len(plan.states)}", names[plan], f"{len(plan.runs)}", write_rough(100 * plan.worst)] for plan in plans]
    table(
        f"{name}: the number that is known least, % (one standard deviation, at {noise})",
        ["states", "which", "runs", "worst, %"],
        rows,
    )
    nothing, known = candidates.medians((), ()), candidates.medians(best.states, best.runs)
    rows = [
        [
            number,
            write_rough(100 * nothing[number]),
            write_rough(100 * after),
            "" if after <= accuracy else "not reached" if wanted else "not asked",
        ]
        for (number, after), wanted in zip(known.items(), candidates.wanted, strict=True)
    ]
    table(
        f"{name}: numbers of the bearing laws with {runs} at {where}",
        ["number", "before, %", "with this plan, %", f"at most {100 * accuracy:g}"],
        rows,
    )
    say(
        f"{name}: measure {runs} at {where}: every number asked for is known to {100 * accuracy:g} % or better"
        if best.worst <= accuracy
        else f"{name}: {100 * accuracy:g} % can't be reached with {runs} at {where}: allow more runs "
        "(design.runs) or conditions further apart (design.operating), or give a number as known"
    )


# --- in another command ------------------------------------------------------------------------------


def override_states(states: Sequence[State]) -> str:
    """The states as an override, where they are every combination of some values."""
    values = {name: list(dict.fromkeys(state[name] for state in states)) for name in states[0]} if states[0] else {}
    if not values or np.prod([len(levels) for levels in values.values()]) != len(states):
        return ""
    columns = {name: column_of(name) for name in values}
    levels = {name: column.from_si(np.array(values[name])) for name, column in columns.items()}
    parts = [f"{name}: [{', '.join(f'{v:g} {columns[name].unit}' for v in shown)}]" for name, shown in levels.items()]
    return " " + shlex.quote(f"machine.operating={{{', '.join(parts)}}}")


def format_runs(config: Config, chosen: Runs, speeds: SpeedsConfig) -> str:
    """The YAML that ``machine.runs_file`` takes."""
    import yaml

    runs = [
        {"name": acting[0].run}
        | {
            f"{kind}s": [
                {
                    "node": excitation.node,
                    "magnitude": f"{excitation.magnitude:.12g} {'N' if kind == 'force' else 'kg m'}",
                    "phase": f"{np.degrees(excitation.phase):.12g} deg",
                    **({"whirl": excitation.whirl} if kind == "force" else {}),
                }
                for excitation in acting
                if excitation.kind == kind
            ]
            for kind in ("unbalance", "force")
            if any(excitation.kind == kind for excitation in acting)
        }
        for acting in chosen
    ]
    return f"# Chosen by: python -m pipeline stage=design {config.chosen}\n" + yaml.safe_dump(
        {"speeds": speeds.model_dump(), "runs": runs}, sort_keys=False
    )
