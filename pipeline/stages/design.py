"""Choose the runs that would identify best, and tell the gain against the configured ones.

With ``design.accuracy`` the runs and speeds that reach it, see :mod:`pipeline.stages.accuracy_design`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from pipeline.config.schema import Config
from pipeline.identification.quality import finite
from pipeline.problem.design import (
    predict_deviations,
    simulate_deviations,
)
from pipeline.problem.measurement import Measurement
from pipeline.problem.planning import choose_best
from pipeline.reporting.console import say, table
from pipeline.rotor.stored import load_rotor
from pipeline.stages.accuracy_design import reach_accuracy
from pipeline.stages.analysis import Analysis
from pipeline.stages.diagnose import describe_noise
from pipeline.stages.execution import StageOutput
from pipeline.stages.law_design import reach_numbers
from pipeline.stages.planned_runs import write_design


def run(analysis: Analysis) -> StageOutput:
    """``design.json`` and ``designed_excitation.yaml``, which can be used at once."""
    config = analysis.config
    if config.model.has_laws:
        return reach_numbers(analysis)
    if config.design.accuracy is not None:
        return reach_accuracy(analysis, config.design.accuracy)
    rotor = load_rotor(config.machine.rotor)
    chosen, plans = choose_best(config, rotor)
    summary = _summarize(config, plans)
    _print(config, summary, [acting[0].run for acting in chosen])
    written = write_design(analysis, chosen, config.machine.speeds, summary)
    return StageOutput(summary, {"rotor_fingerprint": rotor.fingerprint}, written)


def _summarize(config: Config, plans: Mapping[str, Measurement]) -> dict[str, object]:
    predicted = {name: predict_deviations(plan) for name, plan in plans.items()}
    summary: dict[str, object] = {"predicted": _to_json(predicted)}
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
