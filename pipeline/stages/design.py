"""Choose the runs that would identify best, and tell the gain against the configured ones.

With ``design.accuracy`` the runs and speeds that reach it at the machine's probes, or why none do; with bearing laws
the oil temperatures, loads and runs that bring their numbers to it.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from pipeline.config.messages import quote_override
from pipeline.config.schema import Config
from pipeline.files import write_json, write_text
from pipeline.identification.quality import finite
from pipeline.problem.design import predict_deviations, simulate_deviations
from pipeline.problem.planning import choose_best
from pipeline.reporting.console import say
from pipeline.reporting.design_tables import format_runs, print_gain
from pipeline.rotor.model import RotorModel
from pipeline.rotor.stored import load_rotor
from pipeline.stages.accuracy_design import Designed, reach_accuracy, reach_numbers
from pipeline.stages.analysis import Analysis
from pipeline.stages.before_fit import describe_noise
from pipeline.stages.execution import StageOutput


def run(analysis: Analysis) -> StageOutput:
    """``design.json`` and ``designed_excitation.yaml``, which can be used at once: the command is said.

    Raises ConfigError for an accuracy, laws or conditions that are missing.
    """
    config, rotor = analysis.config, load_rotor(analysis.config.machine.rotor)
    design = reach_numbers if config.model.has_laws else reach_accuracy if config.design.accuracy else _choose_runs
    chosen, speeds, summary, metrics, overrides = design(config, rotor)
    folder = analysis.files.folder
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
    return StageOutput(metrics, {"rotor_fingerprint": rotor.fingerprint}, written)


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
    print_gain(config.name, describe_noise(config), summary, [acting[0].run for acting in chosen])
    return chosen, config.machine.speeds, summary, summary, ""


_Deviations = Mapping[str, Mapping[str, float]]


def _compute_gain(deviations: _Deviations) -> float | None:
    return finite(max(deviations["configured"].values()) / max(deviations["designed"].values()))


def _to_json(deviations: _Deviations) -> dict[str, dict[str, float | None]]:
    return {name: {key: finite(value) for key, value in entries.items()} for name, entries in deviations.items()}
