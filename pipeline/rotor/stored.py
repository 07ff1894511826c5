"""What ROSS made is kept in the cache: its import takes seconds, and is needed for a new rotor or bearing only."""

from __future__ import annotations

import importlib.metadata
import json
from pathlib import Path

import numpy as np

from pipeline.cache import hash_parts, keep, look_up
from pipeline.config.bearings import BearingConfig
from pipeline.config.rotor import RotorConfig
from pipeline.rotor.bearing_table import BearingTable
from pipeline.rotor.model import RotorModel

KIND = "rotors"
_BEARINGS = "bearings"
_MADE_BY = [Path(__file__).with_name(f"{name}.py") for name in ("ross_adapter", "journal_table")]
_ARRAYS = ("mass", "damping", "gyroscopic", "stiffness", "shaft_mass", "shaft_gyroscopic", "positions")
_REST = ("bearing_nodes", "disc_nodes", "total_mass")
_ENTRY = "rotor"


def made_from(config: RotorConfig) -> str:
    """Identity of what a rotor is assembled from: configuration, its file's bytes, ROSS's version, and our own code."""
    file = Path(config.file) if config.file is not None else None
    return hash_parts(
        # Where a rotor file lies makes no other rotor.
        json.dumps(config.model_dump(mode="json", exclude={"file"}), sort_keys=True),
        file.read_bytes() if file is not None and file.is_file() else b"",
        "" if file is None else file.suffix,
        importlib.metadata.version("ross-rotordynamics"),
        *(path.read_bytes() for path in _MADE_BY),
    )


def load_rotor(config: RotorConfig) -> RotorModel:
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


def load_modelled_bearings(config: RotorConfig, bearing: BearingConfig, speeds: np.ndarray) -> BearingTable:
    """The modelled coefficients at ``speeds`` (S,) rad/s: from the cache, or by ROSS.

    Raises ConfigError where the rotor file can't be read, or the bearings give no finite coefficients.
    """
    speeds = np.ascontiguousarray(speeds, dtype=float)
    key = hash_parts(made_from(config), bearing.model_dump_json(), speeds.tobytes())
    arrays = _arrays(look_up(_BEARINGS, key))
    if arrays is not None and {"nodes", "values"} <= arrays.keys():
        return BearingTable(tuple(arrays["nodes"].astype(int).tolist()), speeds, arrays["values"])
    from pipeline.rotor.ross_adapter import bearing_table

    table = bearing_table(config, bearing, speeds)
    keep(_BEARINGS, key, _content({"nodes": np.array(table.nodes, dtype=float), "values": table.values}))
    return table


def _written(rotor: RotorModel) -> bytes:
    rest = {name: getattr(rotor, name) for name in _REST}
    return _content({name: getattr(rotor, name) for name in _ARRAYS}, {_ENTRY: json.dumps(rest)})


def _read(content: bytes | None) -> RotorModel | None:
    """The rotor, bit by bit; None where there is none, or a damaged one."""
    arrays = _arrays(content)
    if content is None or arrays is None:
        return None
    try:
        header = json.loads(content[8 : 8 + int.from_bytes(content[:8], "little")])
        rest = json.loads(header["__metadata__"][_ENTRY])
        return RotorModel(
            **{name: arrays[name] for name in _ARRAYS},
            bearing_nodes=tuple(rest["bearing_nodes"]),
            disc_nodes=tuple(rest["disc_nodes"]),
            total_mass=rest["total_mass"],
        )
    except (KeyError, TypeError, ValueError):
        return None


def _content(arrays: dict[str, np.ndarray], metadata: dict[str, str] | None = None) -> bytes:
    from safetensors.numpy import save

    return bytes(save({name: np.ascontiguousarray(array) for name, array in arrays.items()}, metadata))


def _arrays(content: bytes | None) -> dict[str, np.ndarray] | None:
    """The arrays of double precision; None where the content is damaged."""
    from safetensors import SafetensorError, deserialize

    if content is None:
        return None
    try:
        return {
            name: np.frombuffer(entry["data"], dtype=np.float64).reshape(entry["shape"])
            for name, entry in deserialize(content)
        }
    except (SafetensorError, ValueError):
        return None
