"""The stages: each loads, calls, saves and reports; the computation knows no files.

``run_stage`` imports a stage when it is asked for, so that help and errors come at once.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING

from pipeline.config.stage_names import STAGES

if TYPE_CHECKING:
    from pipeline.config.schema import Config


def run_stage(config: Config) -> None:
    """Run ``config.stage``; of ``predict`` with records of the user's own, those alone.

    Raises PipelineError for a user's mistake, SystemExit for an exit code.
    """
    from pipeline.stages.execution import execute

    given_records = config.stage == "predict" and config.predict.records is not None
    name = "given_records" if given_records else config.stage
    execute(config, importlib.import_module(f"pipeline.stages.{name}").run)


__all__ = ["STAGES", "run_stage"]
