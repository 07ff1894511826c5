"""Run a stage: missing inputs first, then the stage, then its record."""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from pipeline.config.schema import Config
from pipeline.reporting.console import say, warn
from pipeline.tracking import StageRecord, track


def make_missing(config: Config, stage: str, *needed: Path) -> None:
    """Run ``stage`` first if one of the files that it makes is missing, and say so."""
    from pipeline.stages import run_stage

    missing = [path for path in needed if not path.exists()]
    if missing:
        say(f"'{missing[0]}' is missing: running stage={stage} first")
        run_stage(config.model_copy(update={"stage": stage}))


def use_threads(config: Config) -> None:
    """Let torch use the configured number of threads."""
    import torch

    torch.set_num_threads(config.threads)


@dataclass(frozen=True)
class StageOutput:
    """A stage hands this to the records."""

    metrics: Mapping[str, object] = field(default_factory=dict)  # nested; numbers are recorded by dotted names
    tags: Mapping[str, str] = field(default_factory=dict)
    files: Sequence[Path] = ()
    history: Sequence[Mapping[str, float]] = ()
    model: Path | None = None
    children: Sequence[StageRecord] = ()
    exit_code: int = 0


def execute(config: Config, run: Callable[[Config], StageOutput]) -> None:
    """Run a stage and record it. The files are complete before the first word to MLflow."""
    started = time.time()
    output = run(config)
    # The comparison's many settings are of its own stage alone.
    parameters = config.model_dump(mode="json", exclude=None if config.stage == "compare" else {"comparison"})
    # Stages of one experiment with the same configuration share this tag.
    apart = ("stage", "tracking", "check", "comparison", "report", "balance", "predict")
    shared = {key: parameters[key] for key in parameters if key not in apart}
    group = hashlib.sha256(json.dumps(shared, sort_keys=True).encode()).hexdigest()[:12]
    record = StageRecord(
        experiment=config.name if config.stage != "check" else "check",  # it looks at all of them
        stage=config.stage,
        started=started,
        ended=time.time(),
        parameters=parameters,
        tags={"pipeline.group": group, "seed": str(config.seed)} | dict(output.tags),
        metrics=_flatten(output.metrics),
        history=output.history,
        files=[path for path in output.files if path.exists()],
        model=output.model,
        children=output.children,
        status="KILLED" if output.exit_code == 130 else "FINISHED",
    )
    for sentence in track(record, config.tracking):
        warn(sentence)
    if output.exit_code:
        raise SystemExit(output.exit_code)


def _flatten(values: Mapping[str, object], prefix: str = "") -> dict[str, float]:
    """Numbers of a nested mapping by dotted names."""
    result: dict[str, float] = {}
    for key, value in values.items():
        name = f"{prefix}{key}"
        if isinstance(value, Mapping):
            result |= _flatten(value, f"{name}.")
        elif isinstance(value, (int, float)) and not isinstance(value, bool):
            result[name] = float(value)
    return result
