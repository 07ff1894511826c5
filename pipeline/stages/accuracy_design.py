"""The runs that reach ``design.accuracy``: at the machine's probes, or in states for the numbers of bearing laws."""

from __future__ import annotations

from collections.abc import Mapping

from pipeline.config.runs import SpeedsConfig
from pipeline.config.schema import Config
from pipeline.errors import ConfigError
from pipeline.laws.law_set import make_laws
from pipeline.problem.design import plan_states
from pipeline.problem.planning import list_states, plan_coefficients, plan_numbers, reach
from pipeline.problem.ranking import find_least
from pipeline.reporting.design_tables import Runs, override_states, print_reached, print_states, summarize_states
from pipeline.rotor.model import RotorModel
from pipeline.rotor.parameters import OF_WEIGHT
from pipeline.stages.before_fit import describe_noise

Designed = tuple[Runs, SpeedsConfig, Mapping[str, object], Mapping[str, object], str]
"""Runs and speeds; what ``design.json`` and the records have; overrides that go with them."""


def reach_accuracy(config: Config, rotor: RotorModel) -> Designed:
    """The runs and speeds that bring every coefficient to ``design.accuracy``."""
    machine, accuracy, planner = config.machine, config.design.accuracy or 0.0, plan_coefficients(config, rotor)
    best, predicted, cures = reach(planner, accuracy)
    chosen = [planner.allowed[c] for c in best.runs]
    speeds = machine.speeds.model_copy(update={"step_rpm": best.every * machine.speeds.step_rpm})
    print_reached(config.name, describe_noise(config), accuracy, predicted, cures, chosen, speeds.rpm())
    # A fit refuses tolerances of weights where no run has any.
    weighed = any(weight.kind == "unbalance" for acting in chosen for weight in acting)
    kinds = [] if weighed else [kind for kind in config.identify.model_parameters.deviations if kind in OF_WEIGHT]
    without = "".join(f" identify.model_parameters.{kind}=null" for kind in kinds)
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
    print_states(config.name, describe_noise(config), candidates, plans, best, states, accuracy)
    summary = summarize_states(candidates, plans, best, states, accuracy)
    overrides = override_states([states[t] for t in best.states])
    return [planner.allowed[c] for c in best.runs], machine.speeds, summary, {"worst": best.worst}, overrides
