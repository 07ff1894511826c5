"""The stages: each loads, calls, saves and reports; the computation knows no files.

A stage is imported when it is asked for, so that help and errors come at once.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING

from pipeline.config.loader import STAGES

if TYPE_CHECKING:
    from pipeline.config.schema import Config


def run_stages(configs: Iterable[Config]) -> None:
    """Run ``config.stage`` of each, one after the other; those of one experiment share what they make.

    Raises PipelineError for a user's mistake, SystemExit for an exit code.
    """
    from pipeline.reporting.console import log_steps
    from pipeline.stages.analysis import Analysis, execute

    analysis: Analysis | None = None
    for config in configs:
        analysis = analysis.at(config) if analysis else Analysis(config)
        with log_steps(analysis.folder):
            execute(analysis)


def run_stage(config: Config) -> None:
    """:func:`run_stages` of one."""
    run_stages([config])


__all__ = ["STAGES", "run_stage", "run_stages"]
