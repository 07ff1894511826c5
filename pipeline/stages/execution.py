"""Run a stage, then record it."""

from __future__ import annotations

import hashlib
import importlib
import json
import time
from collections.abc import Callable
from dataclasses import replace

from pipeline.config.schema import Config
from pipeline.errors import ConfigError
from pipeline.processes import settle_torch
from pipeline.reporting.console import warn
from pipeline.stages.analysis import Analysis
from pipeline.tracking import StageRecord, track
from pipeline.tracking.entries import flatten


def use_threads(config: Config) -> None:
    """Let torch use the configured number of threads. Raises ConfigError for a device that it does not see."""
    settle_torch(config.threads)
    import torch

    if config.training.device == "cuda" and not torch.cuda.is_available():
        raise ConfigError(
            f"training.device=cuda must have a GPU that torch sees, but torch {torch.__version__} sees none: install "
            "its CUDA build by `make env TORCH=cuda` on a machine with a GPU, or leave it out"
        )


def execute(analysis: Analysis) -> None:
    """Run a stage and record it; of ``predict`` with records of the user's own, those alone."""
    config = analysis.config
    given_records = config.stage == "predict" and config.predict.records is not None
    name = "given_records" if given_records else config.stage
    record(analysis, importlib.import_module(f"pipeline.stages.{name}").run)


def record(analysis: Analysis, run: Callable[[Analysis], StageRecord]) -> None:
    """Run and record what a stage, or a study, does. The files are complete before the first word to MLflow."""
    config, started = analysis.config, time.time()
    output = run(analysis)
    # The comparison's many settings are of its own stage alone.
    parameters = config.model_dump(mode="json", exclude=None if config.stage == "compare" else {"comparison"})
    # Stages of one experiment with the same configuration share this tag.
    apart = ("stage", "tracking", "check", "comparison", "report", "balance", "predict")
    shared = {key: parameters[key] for key in parameters if key not in apart}
    group = hashlib.sha256(json.dumps(shared, sort_keys=True).encode()).hexdigest()[:12]
    made = replace(
        output,
        experiment=config.name if config.stage != "check" else "check",  # it looks at all of them
        stage=config.stage,
        title=" ".join((config.stage, config.name, *config.overrides)),
        data=None if config.stage == "compare" else analysis.files.vibration,  # which makes data of its own
        started=started,
        ended=time.time(),
        parameters=parameters,
        tags={"pipeline.group": group, "seed": str(config.seed)} | dict(output.tags),
        metrics={
            name: float(value)
            for name, value in flatten(output.metrics)
            if isinstance(value, int | float) and not isinstance(value, bool)
        },
        files=[path for path in output.files if path.exists()],
        status="KILLED" if output.exit_code == 130 else "FINISHED",
    )
    for sentence in track(made, config.tracking):
        warn(sentence)
    if output.exit_code:
        raise SystemExit(output.exit_code)
