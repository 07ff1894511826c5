"""An assembled rotor as a file, so that stages after the first need not import ROSS, which takes seconds."""

from __future__ import annotations

import hashlib
import importlib.metadata
import json
from dataclasses import fields
from pathlib import Path

import numpy as np

from pipeline.config.schema import RotorConfig
from pipeline.files import write_beside
from pipeline.rotor.model import RotorModel

_KEY = "made_from"


def made_from(config: RotorConfig) -> str:
    """Identity of what a rotor is assembled from: its configuration, its file's bytes, the version of ROSS."""
    digest = hashlib.sha256(json.dumps(config.model_dump(mode="json"), sort_keys=True).encode())
    digest.update(importlib.metadata.version("ross-rotordynamics").encode())
    if config.file is not None and Path(config.file).is_file():
        digest.update(Path(config.file).read_bytes())
    return digest.hexdigest()[:16]


def write_rotor(path: Path, rotor: RotorModel, config: RotorConfig) -> Path:
    """Write the matrices, bit by bit, as NumPy's npz. Raises StorageError."""
    content = {field.name: np.asarray(getattr(rotor, field.name)) for field in fields(rotor)}
    content[_KEY] = np.array(made_from(config))

    def write(beside: Path) -> None:
        with beside.open("wb") as file:  # savez would give a name without its ending another one
            np.savez(file, **content)

    return write_beside(path, write)


def read_rotor(path: Path, config: RotorConfig) -> RotorModel | None:
    """What :func:`write_rotor` wrote; None where there is no such file, a damaged one, or one of another rotor."""
    try:
        with np.load(path, allow_pickle=False) as stored:
            if str(stored[_KEY]) != made_from(config):
                return None
            return RotorModel(
                **{name: stored[name] for name in ("mass", "damping", "gyroscopic", "stiffness", "positions")},
                bearing_nodes=tuple(int(node) for node in stored["bearing_nodes"]),
                disc_nodes=tuple(int(node) for node in stored["disc_nodes"]),
                total_mass=float(stored["total_mass"]),
            )
    except Exception:  # NumPy raises what its zip and header readers raise; ROSS assembles the rotor anew then
        return None
