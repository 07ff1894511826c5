"""An assembled rotor as a file, so that stages after the first need not import ROSS, which takes seconds."""

from __future__ import annotations

import hashlib
import importlib.metadata
import json
from pathlib import Path

import numpy as np

from pipeline.config.machine import RotorConfig
from pipeline.files import write_beside
from pipeline.rotor.model import RotorModel

_ARRAYS = ("mass", "damping", "gyroscopic", "stiffness", "positions")
_REST = ("bearing_nodes", "disc_nodes", "total_mass")
_ENTRY = "rotor"


def made_from(config: RotorConfig) -> str:
    """Identity of what a rotor is assembled from: its configuration, its file's bytes, the version of ROSS."""
    digest = hashlib.sha256(json.dumps(config.model_dump(mode="json"), sort_keys=True).encode())
    digest.update(importlib.metadata.version("ross-rotordynamics").encode())
    if config.file is not None and Path(config.file).is_file():
        digest.update(Path(config.file).read_bytes())
    return digest.hexdigest()[:16]


def write_rotor(path: Path, rotor: RotorModel, config: RotorConfig) -> Path:
    """Write the matrices, bit by bit, as safetensors. Raises StorageError."""
    from safetensors.numpy import save

    # One entry: safetensors writes several in any order, and equal rotors should have equal bytes.
    rest = {"made_from": made_from(config)} | {name: getattr(rotor, name) for name in _REST}
    content = save({name: np.ascontiguousarray(getattr(rotor, name)) for name in _ARRAYS}, {_ENTRY: json.dumps(rest)})

    def write(beside: Path) -> None:
        beside.write_bytes(content)

    return write_beside(path, write)


def read_rotor(path: Path, config: RotorConfig) -> RotorModel | None:
    """What :func:`write_rotor` wrote; None where there is no such file, a damaged one, or one of another rotor."""
    from safetensors import SafetensorError, safe_open

    try:
        with safe_open(path, framework="np") as stored:
            rest = json.loads((stored.metadata() or {})[_ENTRY])
            if rest["made_from"] != made_from(config):
                return None
            return RotorModel(
                **{name: stored.get_tensor(name) for name in _ARRAYS},
                bearing_nodes=tuple(rest["bearing_nodes"]),
                disc_nodes=tuple(rest["disc_nodes"]),
                total_mass=rest["total_mass"],
            )
    except (OSError, SafetensorError, KeyError, TypeError, ValueError):
        return None  # ROSS assembles the rotor anew
