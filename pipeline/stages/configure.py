"""Write the composed configuration: what ``dvc repro`` compares to know which stages a change touches."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from pipeline.files import hash_file, write_text
from pipeline.reporting.console import say
from pipeline.stages.analysis import Analysis
from pipeline.stages.execution import StageOutput

_HOW: Any = {
    **dict.fromkeys(("stage", "tracking", "check", "threads", "output", "promoted", "balance", "predict"), True),
    "comparison": {"workers"},
    "tuning": {"storage", "workers", "changed", "timeout_seconds", "heartbeat_seconds", "comparison"},
}


def run(analysis: Analysis) -> StageOutput:
    """``config.yaml``, in SI units, without the keys that say how rather than what.

    Values that a study promoted are in their places, and ``rotor_file`` is the identity of the rotor file's bytes.
    """
    config = analysis.config
    import yaml

    mapping = config.model_dump(mode="json", exclude=_HOW)
    mapping["rotor_file"] = hash_file(Path(config.machine.rotor.file)) if config.machine.rotor.file else ""
    path = write_text(analysis.files.config, yaml.safe_dump(mapping, sort_keys=False))
    say(f"{config.name}: configuration in '{path}'")
    return StageOutput(files=[path])
