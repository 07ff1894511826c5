"""Write the composed configuration: what ``dvc repro`` compares to know which stages a change touches."""

from __future__ import annotations

from typing import Any

from pipeline.config.schema import Config
from pipeline.files import write_text
from pipeline.reporting.console import say
from pipeline.stages.run import StageOutput, workspace

_HOW: Any = {
    **dict.fromkeys(("stage", "tracking", "check", "threads", "device", "output", "promoted"), True),
    "comparison": {"workers"},
    "tuning": {"storage", "workers", "changed", "timeout_seconds", "heartbeat_seconds", "comparison"},
}


def run(config: Config) -> StageOutput:
    """``config.yaml``, in SI units, without the keys that say how rather than what."""
    import yaml

    mapping = config.model_dump(mode="json", exclude=_HOW)
    path = write_text(workspace(config).config, yaml.safe_dump(mapping, sort_keys=False))
    say(f"{config.name}: configuration in '{path}'")
    return StageOutput(files=[path])
