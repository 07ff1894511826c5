"""An assembled rotor is kept in the cache, so that ROSS, whose import takes seconds, is needed for a new rotor only."""

from __future__ import annotations

import importlib.metadata
import json
from pathlib import Path

import numpy as np

from pipeline.cache import identity, keep, look_up
from pipeline.config.machine import RotorConfig
from pipeline.rotor.model import RotorModel

KIND = "rotors"
_ASSEMBLED_BY = Path(__file__).with_name("ross_adapter.py")
_ARRAYS = ("mass", "damping", "gyroscopic", "stiffness", "positions")
_REST = ("bearing_nodes", "disc_nodes", "total_mass")
_ENTRY = "rotor"


def made_from(config: RotorConfig) -> str:
    """Identity of what a rotor is assembled from: configuration, its file's bytes, ROSS's version, and our own code."""
    file = Path(config.file) if config.file is not None else None
    return identity(
        # Where a rotor file lies makes no other rotor.
        json.dumps(config.model_dump(mode="json", exclude={"file"}), sort_keys=True),
        file.read_bytes() if file is not None and file.is_file() else b"",
        "" if file is None else file.suffix,
        importlib.metadata.version("ross-rotordynamics"),
        _ASSEMBLED_BY.read_bytes(),
    )


def assembled(config: RotorConfig) -> RotorModel:
    """Shaft and discs as matrices: from the cache, or by ROSS where this rotor is new.

    Raises ConfigError where ``config.file`` can't be read.
    """
    key = made_from(config)
    rotor = _read(look_up(KIND, key))
    if rotor is None:
        from pipeline.rotor.ross_adapter import assemble

        rotor = assemble(config)
        keep(KIND, key, _written(rotor))
    return rotor


def _written(rotor: RotorModel) -> bytes:
    from safetensors.numpy import save

    rest = {name: getattr(rotor, name) for name in _REST}
    arrays = {name: np.ascontiguousarray(getattr(rotor, name)) for name in _ARRAYS}
    return bytes(save(arrays, {_ENTRY: json.dumps(rest)}))


def _read(content: bytes | None) -> RotorModel | None:
    """The rotor, bit by bit; None where there is none, or a damaged one."""
    from safetensors import SafetensorError, deserialize

    if content is None:
        return None
    try:
        arrays = {
            name: np.frombuffer(entry["data"], dtype=np.float64).reshape(entry["shape"])
            for name, entry in deserialize(content)
        }
        header = json.loads(content[8 : 8 + int.from_bytes(content[:8], "little")])
        rest = json.loads(header["__metadata__"][_ENTRY])
        return RotorModel(
            **{name: arrays[name] for name in _ARRAYS},
            bearing_nodes=tuple(rest["bearing_nodes"]),
            disc_nodes=tuple(rest["disc_nodes"]),
            total_mass=rest["total_mass"],
        )
    except (SafetensorError, KeyError, TypeError, ValueError):
        return None
