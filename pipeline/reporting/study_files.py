"""What came of a study, as files: trials, finalists, figures, a report, and the values that training may use."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

from pipeline.config.promotion import BEST, PromotedTrial
from pipeline.config.tuning import HeldOutLoss
from pipeline.data.tables import write_table
from pipeline.files import write_json, write_text
from pipeline.reporting.study_figures import draw_study
from pipeline.reporting.study_report import StudyReport, tabulate_finalists, tabulate_trials, write_report
from pipeline.tuning.trials_file import TRIALS, format_trials

SUMMARY = "summary.json"
AGAIN = "run stage=tune again after moving it away"
STUDY_FILES = (BEST, SUMMARY, "README.md", TRIALS, "trials.csv", "finalists.csv")


def write_study(folder: Path, study: Any, report: StudyReport, summary: dict[str, object]) -> list[Path]:
    """Write :data:`STUDY_FILES` and figures into ``folder``; the summary comes last. Raises StorageError."""
    import yaml

    config, medians = report.config, {"configured": report.default.median, "promoted": report.best.median}
    losses = {name: median if math.isfinite(median) else None for name, median in medians.items()}
    values = PromotedTrial(
        study=config.tuning.study,
        trial=report.best.trial,
        values=dict(report.best.values),
        held_out_loss=HeldOutLoss(**losses),
    )
    head = (
        f"# Found by: python -m pipeline stage=tune {config.chosen}\n"
        "# Training uses these values; one given on the command line wins, and tuned=false leaves them all out.\n"
    )
    return [
        write_table(folder / "trials.csv", tabulate_trials(report)),
        write_table(folder / "finalists.csv", tabulate_finalists(report)),
        *draw_study(folder / "figures", report.trials, config.tuning.space, report.importances, report.finalists),
        write_text(folder / TRIALS, format_trials(study)),
        write_text(folder / "README.md", write_report(report)),
        write_text(folder / BEST, head + yaml.safe_dump(values.model_dump(mode="json"), sort_keys=False)),
        write_json(folder / SUMMARY, summary),
    ]
