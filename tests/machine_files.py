"""What the tests of machine files share: a file of a machine, and the override that names it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import yaml

from pipeline.stages.new import fill_template

UNKNOWNS = {
    "rolling": ("kxx", "kyy", "cxx", "cyy"),
    "fluid_film": ("kxx", "kxy", "kyx", "kyy", "cxx", "cxy", "cyx", "cyy"),
}


def machine_file(folder: Path, name: str = "pump one.yaml", **changes: Any) -> Path:
    """A machine on rolling bearings, simulated, with other values of its top keys; None leaves one out."""
    path = folder / name
    content = yaml.safe_load(fill_template(path, "rolling", "simulated")) | changes
    kept = {key: value for key, value in content.items() if value is not None}
    path.write_text(yaml.safe_dump(kept, sort_keys=False), encoding="utf-8")
    return path


def given_by(path: Path | str) -> str:
    """The override that names a machine file."""
    return f"machine.file='{path}'"
