"""Every method on the same modelled data: error against noise, sensors and number of speeds."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from pipeline.comparison.cases import Machine, choose_main_case, list_cases
from pipeline.comparison.result import Result
from pipeline.comparison.runner import ComparisonSetup, MethodRun, compare
from pipeline.config.schema import Config
from pipeline.data.tables import write_table
from pipeline.errors import ConfigError
from pipeline.files import write_json, write_text
from pipeline.methods.catalogue import METHODS
from pipeline.reporting.comparison_figures import draw_comparison
from pipeline.reporting.comparison_tables import Comparison, make_tables, write_markdown
from pipeline.reporting.console import comparison_progress, say, table
from pipeline.stages.execution import StageOutput, use_threads
from pipeline.stages.generate import model_machine
from pipeline.stages.workspace import locate_files, require_nodes


def run(config: Config) -> StageOutput:
    """``comparison.csv`` (a row a method, case, bearing and coefficient), ``.json``, ``.md`` and a figure.

    Raises ConfigError for measured data, whose truth nobody knows.
    """
    if config.machine.recordings.format != "none":
        raise ConfigError(
            "compare must have a modelled machine, whose coefficients are known, but the data are measured: "
            "use stage=evaluate, which shows least squares beside the fit"
        )
    use_threads(config)
    machine = build_machine(config)
    require_nodes(machine.rotor, "comparison.location", [config.comparison.location or 0])
    setup = ComparisonSetup(machine, config.identify, config.comparison, config.seed)
    n_speeds = len(machine.vibration.speeds)
    runs = [MethodRun(m, case) for case in list_cases(config.comparison, n_speeds) for m in config.comparison.methods]
    folder = locate_files(config).folder
    try:
        with comparison_progress(config.name, len(runs)) as progress:
            results = compare(setup, runs, folder / "comparison", progress)
    except KeyboardInterrupt:
        say(f"{config.name}: interrupted; what is done is kept, and the same command goes on from there")
        raise SystemExit(130) from None
    names = tuple(config.identify.named())
    comparison = Comparison(tuple(results), choose_main_case(config.comparison, n_speeds), names)
    summary = summarize(comparison)
    _print(config, comparison)
    written: list[Path] = [
        write_table(folder / "comparison.csv", _tabulate(results)),
        write_json(folder / "comparison.json", summary),
        write_text(folder / "comparison.md", write_markdown(comparison)),
        draw_comparison(locate_files(config).figure("comparison"), comparison),
    ]
    tags = {"rotor_fingerprint": machine.rotor.fingerprint, "data_fingerprint": machine.vibration.fingerprint}
    return StageOutput(summary, tags, written)


def build_machine(config: Config) -> Machine:
    """The configured machine, and its vibration without noise at every node."""
    machine = Machine(*model_machine(config), config.machine.probes.seed)
    require_nodes(machine.rotor, "identify.unbalance_planes", config.identify.unbalance_planes)
    return machine


def summarize(comparison: Comparison) -> dict[str, object]:
    """Numbers by method, sensors and noise, and the response loss against the best other method in the main case."""
    methods: dict[str, object] = {}
    for method in comparison.methods:
        errors: dict[str, dict[str, float]] = {}
        for sensors in comparison.along("sensors"):
            for noise in comparison.along("noise"):
                error = comparison.error(method, replace(sensors, noise=noise.noise))
                if np.isfinite(error):
                    key = f"{100 * noise.noise:g}_percent".replace(".", "_")
                    errors.setdefault(sensors.sensors, {})[key] = error
        by_speeds = {
            str(case.speeds): comparison.error(method, case)
            for case in comparison.along("speeds")
            if np.isfinite(comparison.error(method, case))
        }
        methods[method] = {
            "median_error_percent": errors,
            "median_error_percent_by_speeds": by_speeds,
            "median_error_percent_by_coefficient": comparison.by_coefficient(method),
            "within_95_percent_interval": comparison.coverage(method, comparison.main),
            "outcomes": comparison.outcomes().get(method, {}),
        }
    summary: dict[str, object] = {"methods": methods}
    if "response" in comparison.methods:
        ratios = {name: comparison.best_other("response", comparison.main, name) for name in comparison.names}
        summary["response_over_best_other"] = {n: ratio for n, (_, ratio) in ratios.items() if np.isfinite(ratio)}
        summary["best_other"] = {name: best for name, (best, _) in ratios.items() if best}
    return summary


def _tabulate(results: list[Result]) -> list[dict[str, object]]:
    """A row a coefficient, and one without coefficient where there is no answer."""
    names = ("median_error", "p95_error", "median_deviation", "within_interval")
    blank = {"bearing_node": None, "coefficient": None, **{f"{name}_percent": None for name in names}}
    rows: list[dict[str, object]] = []
    for r in results:
        about = r.model_dump(exclude={"coefficients"}) | blank
        found = [(node, name, of) for node, by_name in r.coefficients.items() for name, of in by_name.items()]
        for node, name, of in found:
            errors = {f"{name}_percent": value for name, value in of.model_dump().items()}
            rows.append(about | {"bearing_node": node, "coefficient": name} | errors)
        if not found:
            rows.append(about)
    return rows


def _print(config: Config, comparison: Comparison) -> None:
    for title, header, rows in make_tables(comparison):
        table(f"{config.name}: {title}", header, rows)
    for method, outcomes in comparison.outcomes().items():
        for words in outcomes.values():
            say(f"{METHODS[method].label}: {words}")
    if "response" in comparison.methods:
        for name in comparison.names:
            best, ratio = comparison.best_other("response", comparison.main, name)
            if best:
                say(
                    f"{name}: FEM-NN, response has {ratio:.2f} times the error of the best other, {METHODS[best].label}"
                )
