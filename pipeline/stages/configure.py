"""Write the composed configuration: what ``dvc repro`` compares to know which stages a change touches."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from pipeline.config.schema import Config
from pipeline.files import hash_file, write_text
from pipeline.reporting.console import say
from pipeline.stages.analysis import Analysis
from pipeline.tracking import StageRecord

_HOW: Any = {
    **dict.fromkeys(("stage", "tracking", "check", "threads", "output", "promoted", "balance", "predict"), True),
    "comparison": {"workers"},
    "tuning": {"storage", "workers", "changed", "timeout_seconds", "heartbeat_seconds"},
}


def run(analysis: Analysis) -> StageRecord:
    """``config.yaml`` in the experiment's folder."""
    path = write_configuration(analysis.config)
    say(f"{analysis.config.name}: configuration in '{path}'")
    return StageRecord(files=[path])


def write_configuration(config: Config) -> Path:
    """Write ``config.yaml``, in SI units, without the keys that say how rather than what.

    Values that a study promoted are in their places, and ``rotor_file`` is the identity of the rotor file's bytes.
    """
    import yaml

    mapping = config.model_dump(mode="json", exclude=_HOW)
    mapping["rotor_file"] = hash_file(Path(config.machine.rotor.file)) if config.machine.rotor.file else ""
    return write_text(Analysis(config).configuration, yaml.safe_dump(mapping, sort_keys=False))
