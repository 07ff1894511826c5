"""Natural frequencies and damping ratios from a run-up whose ramp is modelled, beside what a steady reading gives."""

from __future__ import annotations

import numpy as np

from pipeline.data.tables import write_table
from pipeline.data.vibration_files import to_rpm
from pipeline.errors import ConfigError
from pipeline.files import write_json
from pipeline.ingest.run_up import read_run_up
from pipeline.reporting.console import say
from pipeline.reporting.measured_figures import draw_run_up
from pipeline.reporting.run_up_tables import compare_identified, print_run_up, summarize_run_up
from pipeline.stages.analysis import Analysis
from pipeline.stages.measurement import restore
from pipeline.sweep.fit import respond_as_steady
from pipeline.sweep.readings import analyse_run_up
from pipeline.tracking import StageRecord


def run(analysis: Analysis) -> StageRecord:
    """``run_up.json``, ``run_up.csv`` and ``figures/run_up.png``.

    Raises ConfigError where the machine has no run-up, and DataError as :func:`pipeline.ingest.run_up.read_run_up`.
    """
    config, settings = analysis.config, analysis.config.machine.run_up
    if settings is None:
        raise ConfigError(
            "runup must have a run-up to fit, but machine.run_up is missing: give its file and what its numbers mean "
            "(docs/run_up.md)"
        )
    reading = analyse_run_up(read_run_up(settings), settings)
    summary = summarize_run_up(settings, reading)
    if analysis.training.exists():
        summary["identified"] = compare_identified(restore(analysis), summary)
    steady = respond_as_steady(reading.run_up, reading.chosen)
    vectors = {"measured": reading.run_up.vectors, "ramp": reading.chosen.fitted, "steady": steady}
    columns = {"rpm": to_rpm(reading.run_up.speeds)}
    for name, values in vectors.items():  # phases are leads
        columns |= {f"{name}_um": 1e6 * np.abs(values), f"{name}_lead_deg": np.degrees(np.angle(values))}
    written = [
        write_json(analysis.folder / "run_up.json", summary),
        write_table(analysis.folder / "run_up.csv", columns),
        draw_run_up(analysis.figure("run_up"), reading.run_up, reading.chosen, steady, settings.probe),
    ]
    print_run_up(config.name, settings, reading)
    for mode in summary.get("identified", {}).values():
        say(f"{config.name}: {mode['sentence']}")
    shown = {"natural_frequency_rpm": summary["natural_frequency"]["rpm"], "misfit": reading.chosen.misfit}
    return StageRecord(metrics={"runup": shown}, files=written)
