"""Choose the runs that would identify best, and tell the gain against the configured ones.

With ``design.accuracy`` the runs and speeds that reach it, see :mod:`pipeline.stages.accuracy_design`.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence

import numpy as np

from pipeline.config.messages import quote_override
from pipeline.config.schema import Config
from pipeline.data.dataset import Excitation
from pipeline.data.simulate import simulate
from pipeline.errors import ConfigError
from pipeline.files import write_json, write_text
from pipeline.identification.quality import finite
from pipeline.problem.design import (
    choose,
    plan_covariance,
    predict_deviations,
    run_information,
    simulate_deviations,
    unknown_sizes,
    whiten_plan,
)
from pipeline.problem.measurement import Measurement
from pipeline.reporting.console import say, table
from pipeline.rotor.stored import load_modelled_bearings, load_rotor
from pipeline.stages.accuracy_design import reach_accuracy
from pipeline.stages.diagnose import describe_noise
from pipeline.stages.execution import StageOutput
from pipeline.stages.generate import configure_excitations, configure_frequencies
from pipeline.stages.law_design import reach_numbers
from pipeline.stages.measurement import build_measurement
from pipeline.stages.planned_runs import format_runs, list_candidates
from pipeline.stages.workspace import locate_files, require_nodes
from pipeline.units import RAD_S_PER_RPM


def run(config: Config) -> StageOutput:
    """``design.json`` and ``designed_excitation.yaml``, which can be used at once."""
    if config.model.has_laws:
        return reach_numbers(config)
    if config.design.accuracy is not None:
        return reach_accuracy(config, config.design.accuracy)
    design, rotor = config.design, load_rotor(config.machine.rotor)
    possible = list_candidates(config.machine.candidates)
    require_nodes(rotor, "machine.candidates", [weight.node for acting in possible for weight in acting])
    if design.runs > len(possible):
        raise ConfigError(f"design.runs must be at most the {len(possible)} candidates, but got {design.runs}")
    every = np.array(config.machine.speeds.rpm()) * RAD_S_PER_RPM
    speeds = every[np.unique(np.linspace(0, len(every) - 1, min(design.speeds, len(every))).round().astype(int))]
    prior = load_modelled_bearings(config.machine.rotor, config.machine.bearings, speeds)

    def plan(acting: Sequence[Excitation], run_speeds: np.ndarray | None = None) -> Measurement:
        return build_measurement(config, rotor, simulate(rotor, prior, tuple(acting), run_speeds), prior)

    everything = plan(list(itertools.chain.from_iterable(possible)))
    white = whiten_plan(everything, everything.dataset, plan_covariance(everything))
    information = run_information(white, len(possible), unknown_sizes(everything))
    present = everything.unknowns.present
    chosen = [possible[c] for c in choose(information, present, design.runs, design.criterion)]
    plans = {
        "configured": plan(configure_excitations(config), configure_frequencies(config, speeds)),
        "designed": plan(list(itertools.chain.from_iterable(chosen))),
    }
    summary = _summarize(config, plans)
    _print(config, summary, [acting[0].run for acting in chosen])
    folder = locate_files(config).folder
    written = [
        write_text(folder / "designed_excitation.yaml", format_runs(config, chosen, config.machine.speeds)),
        write_json(folder / "design.json", summary | {"runs": [acting[0].run for acting in chosen]}),
    ]
    say(
        f"use them with: python -m pipeline stage=train {config.chosen} "
        f"{quote_override('machine.runs_file', str(written[0]))} {quote_override('output', f'{folder}_designed')}"
    )
    return StageOutput(summary, {"rotor_fingerprint": rotor.fingerprint}, written)


def _summarize(config: Config, plans: Mapping[str, Measurement]) -> dict[str, object]:
    predicted = {name: predict_deviations(plan) for name, plan in plans.items()}
    summary: dict[str, object] = {
        "stated_noise": config.stated_noise.model_dump(),
        "predicted": _to_json(predicted),
    }
    summary["worst"] = {name: finite(max(deviations.values())) for name, deviations in predicted.items()}
    summary["gain"] = finite(max(predicted["configured"].values()) / max(predicted["designed"].values()))
    if config.design.simulations > 1:
        generator = np.random.default_rng(config.seed)
        simulated = {
            name: simulate_deviations(plan, config.design.simulations, generator) for name, plan in plans.items()
        }
        summary["simulated"] = _to_json(simulated)
        summary["simulated_gain"] = finite(max(simulated["configured"].values()) / max(simulated["designed"].values()))
    return summary


def _to_json(values: Mapping[str, Mapping[str, float]]) -> dict[str, dict[str, float | None]]:
    return {name: {key: finite(value) for key, value in entries.items()} for name, entries in values.items()}


def _print(config: Config, summary: Mapping[str, object], names: Sequence[str]) -> None:
    predicted, simulated = summary["predicted"], summary.get("simulated")
    assert isinstance(predicted, dict)
    header = ["bearing and unknown", "configured runs", "designed runs"]
    header += ["configured, simulated", "designed, simulated"] if simulated else []
    sources = [predicted[name] for name in ("configured", "designed")]
    if isinstance(simulated, dict):
        sources += [simulated[name] for name in ("configured", "designed")]
    rows = [
        [key, *("free" if source[key] is None else f"{100 * source[key]:.2g}" for source in sources)]
        for key in sources[0]
    ]
    table(
        f"{config.name}: standard deviation of least squares at {describe_noise(config)}, % of the coefficient",
        header,
        rows,
    )
    say(f"{config.name}: the best {len(names)} runs are {', '.join(names)}")
    gain = summary["gain"]
    if gain is None:
        say("the configured runs leave an unknown free; these do not")
        return
    confirmed = "" if simulated is None else f" (in simulations {summary['simulated_gain']:.3g} times)"
    say(f"they lower the worst deviation {gain:.3g} times{confirmed}")
