"""The stages: each loads, calls, saves and reports; the computation knows no files.

``run_stage`` imports a stage when it is asked for, so that help and errors come at once.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pipeline.config.schema import Config

STAGES: dict[str, str] = {
    "configure": "write the experiment's composed configuration to config.yaml",
    "generate": "model the machine with ROSS and write its unbalance vibration",
    "train": "identify the unknown bearing coefficients from the vibration",
    "evaluate": "compare identified with modelled coefficients, and with per-speed least squares",
    "robustness": "train from many initial guesses or seeds at once",
    "predict": "predict vibration never seen, critical speeds and stability with the digital twin",
    "check": "hold the metrics of all experiments against conf/thresholds; exit code 1 where one is passed",
}


def run_stage(config: Config) -> None:
    """Run ``config.stage``. Raises PipelineError for a user's mistake, SystemExit for an exit code."""
    from pipeline.stages.run import execute

    execute(config, importlib.import_module(f"pipeline.stages.{config.stage}").run)
