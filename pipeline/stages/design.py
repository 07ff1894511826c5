"""Choose the runs that would identify best, and tell the gain against the configured ones.

With ``design.accuracy`` the runs and speeds that reach it at the machine's probes, or why none do; with bearing laws
the oil temperatures, loads and runs that bring their numbers to it.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from pipeline.config.messages import quote_override
from pipeline.config.runs import SpeedsConfig
from pipeline.config.schema import Config
from pipeline.errors import ConfigError
from pipeline.files import write_json, write_text
from pipeline.identification.quality import finite
from pipeline.laws.law_set import make_laws
from pipeline.parameters import weights
from pipeline.problem.design import plan_states, predict_deviations, simulate_deviations
from pipeline.problem.planning import choose_best, list_states, plan_coefficients, plan_numbers, reach
from pipeline.problem.ranking import find_least
from pipeline.reporting.console import say
from pipeline.reporting.design_tables import (
    Runs,
    format_runs,
    override_states,
    print_gain,
    print_reached,
    print_states,
    summarize_states,
)
from pipeline.rotor.model import RotorModel
from pipeline.rotor.stored import load_rotor
from pipeline.stages.analysis import Analysis
from pipeline.tracking import StageRecord


def run(analysis: Analysis) -> StageRecord:
    """``design.json`` and ``designed_excitation.yaml``, which can be used at once: the command is said.

    Raises ConfigError for an accuracy, laws or conditions that are missing.
    """
    config, rotor = analysis.config, load_rotor(analysis.config.machine.rotor)
    design = reach_numbers if config.model.has_laws else reach_accuracy if config.design.accuracy else _choose_runs
    chosen, speeds, summary, metrics, overrides = design(config, rotor)
    folder = analysis.folder
    about = {"runs": [acting[0].run for acting in chosen], "stated_noise": config.stated_noise.model_dump()}
    written = [
        write_text(folder / "designed_excitation.yaml", format_runs(config, chosen, speeds)),
        write_json(folder / "design.json", {**summary, **about}),
    ]
    say(
        f"use them with: python -m pipeline stage=train {config.chosen} "
        f"{quote_override('machine.runs_file', str(written[0]))} {quote_override('output', f'{folder}_designed')}"
        + overrides
    )
    return StageRecord(metrics, {"rotor_fingerprint": rotor.fingerprint}, written)


def _choose_runs(config: Config, rotor: RotorModel) -> Designed:
    """The best runs of all, in so many."""
    chosen, plans = choose_best(config, rotor)
    predicted = {name: predict_deviations(plan) for name, plan in plans.items()}
    summary: dict[str, object] = {
        "predicted": _to_json(predicted),
        "worst": {name: finite(max(deviations.values())) for name, deviations in predicted.items()},
        "gain": _compute_gain(predicted),
    }
    if (count := config.design.simulations) > 1:
        generator = np.random.default_rng(config.seed)
        simulated = {name: simulate_deviations(plan, count, generator) for name, plan in plans.items()}
        summary |= {"simulated": _to_json(simulated), "simulated_gain": _compute_gain(simulated)}
    print_gain(config.name, config.describe_noise(), summary, [acting[0].run for acting in chosen])
    return chosen, config.machine.speeds, summary, summary, ""


_Deviations = Mapping[str, Mapping[str, float]]


def _compute_gain(deviations: _Deviations) -> float | None:
    return finite(max(deviations["configured"].values()) / max(deviations["designed"].values()))


def _to_json(deviations: _Deviations) -> dict[str, dict[str, float | None]]:
    return {name: {key: finite(value) for key, value in entries.items()} for name, entries in deviations.items()}


Designed = tuple[Runs, SpeedsConfig, Mapping[str, object], Mapping[str, object], str]
"""Runs and speeds; what ``design.json`` and the records have; overrides that go with them."""


def reach_accuracy(config: Config, rotor: RotorModel) -> Designed:
    """The runs and speeds that bring every coefficient to ``design.accuracy``."""
    machine, accuracy, planner = config.machine, config.design.accuracy or 0.0, plan_coefficients(config, rotor)
    best, predicted, cures = reach(planner, accuracy)
    chosen = [planner.allowed[c] for c in best.runs]
    speeds = machine.speeds.model_copy(update={"step_rpm": best.every * machine.speeds.step_rpm})
    print_reached(config.name, config.describe_noise(), accuracy, predicted, cures, chosen, speeds.rpm())
    # A fit refuses tolerances of weights where no run has any.
    weighed = any(weight.kind == "unbalance" for acting in chosen for weight in acting)
    without = "".join(
        f" identify.model_parameters.{kind.name}=null"
        for kind in weights.KINDS
        if not weighed and kind.name in config.identify.model_parameters.deviations
    )
    numbers = {"accuracy": accuracy, "reached": best.worst <= accuracy, "predicted": predicted, "cures": cures}
    return chosen, speeds, numbers | {"speeds": speeds.model_dump()}, {"predicted": predicted}, without


def reach_numbers(config: Config, rotor: RotorModel) -> Designed:
    """The states and runs that bring the numbers of bearing laws to ``design.accuracy``."""
    machine, accuracy = config.machine, config.design.accuracy
    if machine.laws is None or accuracy is None:
        missing = "machine.laws" if machine.laws is None else "design.accuracy (such as 0.02)"
        raise ConfigError(
            f"stage=design with model={config.model.kind} must have {missing}, but there is none: write it, or choose "
            "another model"
        )
    laws = make_laws(machine.laws, rotor.bearing_nodes)
    states = list_states(config, laws)
    planner, candidates = plan_numbers(config, rotor, laws, states)
    plans = plan_states(candidates, config.design.runs, accuracy)
    best = plans[find_least({i: plan.worst for i, plan in enumerate(plans)})]
    print_states(config.name, config.describe_noise(), candidates, plans, best, states, accuracy)
    summary = summarize_states(candidates, plans, best, states, accuracy)
    overrides = override_states([states[t] for t in best.states])
    return [planner.allowed[c] for c in best.runs], machine.speeds, summary, {"worst": best.worst}, overrides
