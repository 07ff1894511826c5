"""Every method on the same modelled data: error against noise, sensors and number of speeds."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from pipeline.comparison.cases import Case, Machine, choose_main_case, list_cases
from pipeline.comparison.runner import compare
from pipeline.config.schema import Config
from pipeline.data.tables import write_table
from pipeline.errors import ConfigError
from pipeline.files import write_json, write_text
from pipeline.laws.law_set import NO_LAWS, make_laws
from pipeline.methods.catalogue import METHODS
from pipeline.problem.configured import model_machine
from pipeline.reporting.comparison_figures import draw_comparison
from pipeline.reporting.comparison_tables import Comparison, make_tables, tabulate, write_markdown
from pipeline.reporting.console import comparison_progress, say, table
from pipeline.rotor.stored import require_nodes
from pipeline.stages.analysis import Analysis
from pipeline.stages.execution import StageOutput, use_threads
from pipeline.stages.workspace import locate_files


def run(analysis: Analysis) -> StageOutput:
    """``comparison.csv`` (a row a method, case, bearing and coefficient), ``.json``, ``.md`` and a figure.

    Raises ConfigError for measured data, whose truth nobody knows.
    """
    config = analysis.config
    if config.machine.recordings.format != "none":
        raise ConfigError(
            "compare must have a modelled machine, whose coefficients are known, but the data are measured: "
            "use stage=evaluate, which shows least squares beside the fit"
        )
    use_threads(config)
    machine = build_machine(config)
    require_nodes(machine.rotor, "comparison.location", [config.comparison.location or 0])
    asked, n_speeds = config.comparison, machine.n_speeds
    runs = [
        (method, case)
        for case in list_cases(asked, n_speeds)
        for method in asked.methods
        if case.data_set < asked.data_sets_of(method)
    ]
    folder = locate_files(config).folder
    try:
        with comparison_progress(config.name, len(runs)) as progress:
            results = compare(machine, runs, folder / "comparison", progress)
    except KeyboardInterrupt:
        say(f"{config.name}: interrupted; what is done is kept, and the same command goes on from there")
        raise SystemExit(130) from None
    comparison = Comparison(tuple(results), choose_main_case(asked, n_speeds), tuple(config.identify.named()))
    summary = summarize(comparison)
    _print(config, comparison)
    written: list[Path] = [
        write_table(folder / "comparison.csv", tabulate(comparison)),
        write_json(folder / "comparison.json", summary),
        write_text(folder / "comparison.md", write_markdown(comparison)),
        draw_comparison(locate_files(config).figure("comparison"), comparison),
    ]
    tags = {"rotor_fingerprint": machine.rotor.fingerprint, "data_fingerprint": machine.vibration.fingerprint}
    return StageOutput(summary, tags, written)


def build_machine(config: Config) -> Machine:
    """The configured machine, and its vibration without noise at every node."""
    rotor, modelled, vibration = model_machine(config)
    given = config.machine.laws
    laws = make_laws(given, rotor.bearing_nodes) if given else NO_LAWS
    require_nodes(rotor, "identify.unbalance_planes", config.identify.unbalance_planes)
    return Machine(
        rotor,
        modelled,
        vibration,
        identify=config.identify,
        settings=config.comparison,
        noise_seed=config.machine.probes.seed,
        seed=config.seed,
        laws=laws,
    )


def _list_noises(
    comparison: Comparison, method: str, measure: Callable[[str, Case], float]
) -> dict[str, dict[str, float]]:
    """What is measured by sensors and noise, where it is finite."""
    by_sensors = {
        sensors.sensors: {
            f"{100 * noise.noise:g}_percent".replace(".", "_"): value
            for noise in comparison.along("noise")
            if np.isfinite(value := measure(method, replace(sensors, noise=noise.noise)))
        }
        for sensors in comparison.along("sensors")
    }
    return {sensors: values for sensors, values in by_sensors.items() if values}


def summarize(comparison: Comparison) -> dict[str, object]:
    """Numbers by method, sensors and noise, and the response loss against the best other method in the main case."""
    methods = {
        method: {
            "median_error_percent": _list_noises(comparison, method, comparison.error),
            "standard_deviation_percent": _list_noises(comparison, method, comparison.spread),
            "median_error_percent_by_speeds": {
                str(case.speeds): error
                for case in comparison.along("speeds")
                if np.isfinite(error := comparison.error(method, case))
            },
            "median_error_percent_by_coefficient": comparison.by_coefficient(method),
            "within_95_percent_interval": comparison.coverage(method, comparison.main),
            "outcomes": comparison.outcomes().get(method, {}),
        }
        for method in comparison.methods
    }
    summary: dict[str, object] = {"methods": methods}
    if "response" in comparison.methods:
        main, names = comparison.main, comparison.names
        rest = {name: comparison.best_other("response", main, name, "smoothed") for name in names}
        summary["response_over_best_of_the_rest"] = {n: ratio for n, (_, ratio) in rest.items() if np.isfinite(ratio)}
        summary["best_of_the_rest"] = {name: best for name, (best, _) in rest.items() if best}
        over = {n: comparison.error("response", main, n) / comparison.error("smoothed", main, n) for n in names}
        summary["response_over_smoothed"] = {n: ratio for n, ratio in over.items() if np.isfinite(ratio)}
    summary["level_with_the_best"] = sorted(comparison.level_with_best(comparison.main))
    return summary


def _print(config: Config, comparison: Comparison) -> None:
    for made in make_tables(comparison):
        table(f"{config.name}: {made.caption}", made.header, made.rows)
    for method, outcomes in comparison.outcomes().items():
        for outcome in outcomes.values():
            say(f"{METHODS[method].label}: {outcome}")
    if "response" in comparison.methods:
        for name in comparison.names:
            best, ratio = comparison.best_other("response", comparison.main, name)
            if best:
                apart = comparison.differs("response", best, comparison.main, name)
                say(
                    f"{name}: {METHODS['response'].label} has {ratio:.2f} times the error of the best other, "
                    f"{METHODS[best].label}" + ("" if apart else ", which is within the spread of the data sets")
                )
