"""Put the committed studies beside those of this machine, so that optuna-dashboard shows them all."""

from __future__ import annotations

from pathlib import Path

from pipeline.errors import without_password
from pipeline.reporting.console import say, table
from pipeline.stages.analysis import Analysis
from pipeline.tracking import StageRecord, find_trial_pages
from pipeline.tuning.trials_file import TRIALS, gather_studies


def run(analysis: Analysis) -> StageRecord:
    """Every ``studies/NAME/trials.jsonl`` in the database, and on each trial that MLflow has a note with its page."""
    config = analysis.config
    folder = Path(config.tuning.promoted).parent
    beside = Path(__file__).parents[2] / folder  # beside ``conf/``, where the working folder has none
    files = sorted(folder.glob(f"*/{TRIALS}")) or sorted(beside.glob(f"*/{TRIALS}"))
    shown = gather_studies(config.tuning, files, find_trial_pages(config.tracking))
    storage = without_password(config.tuning.storage)
    rows = [[name, str(trials), str(linked)] for name, trials, linked in shown]
    table(f"studies in {storage}", ["study", "trials", "of these with a run in MLflow"], rows)
    say(f"look at them with: optuna-dashboard {storage}")
    return StageRecord()
