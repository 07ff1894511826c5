"""Every method on the same modelled data: error against noise, sensors and number of speeds."""

from __future__ import annotations

from pipeline.comparison.cases import Machine, choose_main_case, list_cases
from pipeline.comparison.runner import compare
from pipeline.config.schema import Config
from pipeline.data.tables import write_table
from pipeline.errors import ConfigError
from pipeline.files import write_json, write_text
from pipeline.laws.law_set import NO_LAWS, make_laws
from pipeline.problem.configured import model_machine
from pipeline.reporting.comparison import (
    Comparison,
    draw_comparison,
    print_comparison,
    summarize_comparison,
    tabulate,
    write_markdown,
)
from pipeline.reporting.console import count_progress
from pipeline.rotor.stored import require_nodes
from pipeline.stages.analysis import Analysis, say_interrupt, use_threads
from pipeline.tracking import StageRecord


def run(analysis: Analysis) -> StageRecord:
    """``comparison.csv`` (a row a method, case, bearing and coefficient), ``.json``, ``.md`` and a figure.

    Raises ConfigError for measured data, whose truth nobody knows.
    """
    config, folder = analysis.config, analysis.folder
    if config.machine.recordings.recorded:
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
        if case.data_set < asked.most_data_sets.get(method, asked.data_sets)
    ]
    with say_interrupt(f"{config.name}: comparison", "result"), count_progress(config.name, len(runs)) as show:
        results = compare(
            machine,
            runs,
            folder / "comparison",
            lambda done, _, result: show(
                done,
                f"{result.method}, {result.case.sensors}, {100 * result.case.noise:g} % in {result.seconds:.1f} s",
            ),
        )
    comparison = Comparison(tuple(results), choose_main_case(asked, n_speeds), tuple(config.identify.named()))
    summary = summarize_comparison(comparison)
    print_comparison(config.name, comparison)
    written = [
        write_table(folder / "comparison.csv", tabulate(comparison)),
        write_json(folder / "comparison.json", summary),
        write_text(folder / "comparison.md", write_markdown(comparison)),
        draw_comparison(analysis.figure("comparison"), comparison),
    ]
    tags = {"rotor_fingerprint": machine.rotor.fingerprint, "data_fingerprint": machine.vibration.fingerprint}
    return StageRecord(summary, tags, written)


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
