"""The end of a multirun: what its jobs came to, side by side."""

from __future__ import annotations

import os
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from pipeline.errors import DataError
from pipeline.files import read_json

COLUMNS = ("outcome", "steps", "loss", "held_out_loss", "worst_mean_error_percent")
JOBS = "jobs.csv"


def compare_jobs(jobs: Mapping[str, str], since: float) -> None:
    """Print a table of the jobs, and write ``jobs.csv`` and ``jobs.png`` in the folder that they share.

    :param jobs: what is the job's own -> its folder
    :param since: a training is of this multirun if it was written after it (seconds since 1970)

    Nothing where fewer than two jobs have a training.
    """
    summaries = {job: _read_job(Path(folder), since) for job, folder in jobs.items()}
    if sum("outcome" in job_summary for job_summary in summaries.values()) < 2:
        return
    from pipeline.data.tables import write_table
    from pipeline.reporting.console import say, table
    from pipeline.reporting.study_files import draw_jobs
    from pipeline.write_numbers import write_value

    shown = [name for name in COLUMNS if any(name in job_summary for job_summary in summaries.values())]
    rows = [
        [job, *(write_value(job_summary.get(name, "-")) for name in shown)] for job, job_summary in summaries.items()
    ]
    table("the jobs of this command", ["job", *(name.replace("_", " ") for name in shown)], rows)
    folder = Path(os.path.commonpath(list(jobs.values())))
    columns: dict[str, list[Any]] = {"job": list(summaries), "folder": list(jobs.values())}
    columns |= {name: [job_summary.get(name) for job_summary in summaries.values()] for name in shown}
    written = [write_table(folder / JOBS, columns), draw_jobs(folder / "jobs.png", summaries)]
    say(f"side by side in '{written[0]}' and '{written[1]}'")


def _read_job(folder: Path, since: float) -> dict[str, Any]:
    """What a job's files say; empty where it has no training of this multirun."""
    path = folder / "training.json"
    if not path.exists() or path.stat().st_mtime < since:
        return {}
    job: dict[str, Any] = {}
    with suppress(DataError):
        training = read_json(path)
        job = {name: training[name] for name in COLUMNS if training.get(name) is not None}
    metrics = folder / "metrics.json"
    if metrics.exists() and metrics.stat().st_mtime >= since:
        with suppress(DataError, KeyError, ValueError, AttributeError):
            bearings = read_json(metrics)["coefficients"].values()
            job["worst_mean_error_percent"] = max(c["mean_error_percent"] for node in bearings for c in node.values())
    return job
