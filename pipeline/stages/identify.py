"""From a machine's data to its results in one command: every stage that belongs to it, one after the other."""

from __future__ import annotations

import time

from pipeline.config.loader import RESULTS
from pipeline.errors import IdentifiabilityError, PipelineError
from pipeline.reporting.console import say, warn
from pipeline.stages.analysis import Analysis
from pipeline.tracking import StageRecord


def run(analysis: Analysis) -> StageRecord:
    """Read or simulate the data, diagnose, train; then each stage of the results. One of these that can't be made is
    skipped with its reason, what an earlier command left of it is removed, and the command ends with 1 after the rest.

    Raises PipelineError for data that can't be read, and, with a report of these alone, for coefficients that they do
    not determine.
    """
    config, started = analysis.config, time.perf_counter()
    made, skipped = [], []
    source = [config.machine.recordings.made_by] if analysis.own else []
    for stage in (*source, "diagnose"):
        analysis.run(stage)
    try:
        analysis.run("train")
    except IdentifiabilityError:
        analysis.run("report")
        raise
    for stage, file in RESULTS.items():
        try:
            analysis.run(stage)
            made.append(analysis.folder / file)
        except PipelineError as error:
            (analysis.folder / file).unlink(missing_ok=True)
            skipped.append(stage)
            warn(f"{config.name}: stage={stage} is skipped: {error}")
    also = f"; skipped: {', '.join(skipped)} (the reasons are above; exit code 1)" if skipped else ""
    files = ", ".join(f"'{path}'" for path in (analysis.identified, *made))
    say(f"{config.name}: results after {time.perf_counter() - started:.0f} s in {files}{also}")
    metrics, tags = {"identify.skipped": float(len(skipped))}, {"skipped": ", ".join(skipped)}
    return StageRecord(metrics, tags, exit_code=int(bool(skipped)))
