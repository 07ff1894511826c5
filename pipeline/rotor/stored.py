"""What ROSS made is kept in the cache: its import takes seconds, and is needed for a new rotor or bearing only."""

from __future__ import annotations

import importlib.metadata
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from pipeline.config.rotor import RotorConfig
from pipeline.errors import ConfigError
from pipeline.files import hash_parts, keep, look_up
from pipeline.rotor.bearing_table import BearingTable
from pipeline.rotor.bearings import BearingConfig
from pipeline.rotor.model import RotorModel
from pipeline.rotor.seals import Seals
from pipeline.rotor.soft_ground import put_on_base, put_on_supports

if TYPE_CHECKING:
    from pipeline.config import runs
    from pipeline.config.measured import AnyRecordingsConfig, ProbeConfig

Recordings = TypeVar("Recordings", bound="AnyRecordingsConfig")
KIND = "rotors"
_BEARINGS = "bearings"
_CODE = ("ross_adapter", "supports", "bearings")
_LAWS = ("oil", "numbers", "short_bearing", "table")
_MADE_BY = [
    *(Path(__file__).with_name(f"{name}.py") for name in _CODE),
    *(Path(__file__).parents[1] / "laws" / f"{name}.py" for name in _LAWS),
]
_ARRAYS = ("mass", "damping", "gyroscopic", "stiffness", "shaft_mass", "shaft_gyroscopic", "positions")
_REST = ("bearing_nodes", "disc_nodes", "total_mass", "supported_nodes")
_SEALS = "seals"


def hash_rotor(config: RotorConfig) -> str:
    """Identity of what a rotor is assembled from: configuration, its file's bytes, ROSS's version, and our own code."""
    file = Path(config.file or "")
    return hash_parts(
        # Where a rotor file lies makes no other rotor, and what it stands on no other shaft.
        json.dumps(config.model_dump(mode="json", exclude={"file", "supports", "base"}), sort_keys=True),
        file.read_bytes() if file.is_file() else b"",
        file.suffix,
        importlib.metadata.version("ross-rotordynamics"),
        *(path.read_bytes() for path in _MADE_BY),
    )


def load_rotor(config: RotorConfig) -> RotorModel:
    """Shaft and discs as matrices: from the cache, or by ROSS where this rotor is new.

    Raises ConfigError where ``config.file`` can't be read, and for a support where no bearing is.
    """
    return put_on_base(put_on_supports(_load_shaft(config), config.supports), config.base)


def _load_shaft(config: RotorConfig) -> RotorModel:
    """The rotor with its bearings on the ground."""
    key = hash_rotor(config)
    kept = _look_up(KIND, key, {*_ARRAYS, *_REST, _SEALS})
    if kept:
        return RotorModel(
            **{name: kept[name] for name in _ARRAYS},
            bearing_nodes=tuple(kept["bearing_nodes"].astype(int).tolist()),
            disc_nodes=tuple(kept["disc_nodes"].astype(int).tolist()),
            total_mass=float(kept["total_mass"][0]),
            seals=Seals(kept[_SEALS]),
            supported_nodes=tuple(kept["supported_nodes"].astype(int).tolist()),
            bearing_shifts=(),
            casings=(),
        )
    from pipeline.rotor.ross_adapter import assemble

    rotor = assemble(config)
    _keep(KIND, key, {name: getattr(rotor, name) for name in (*_ARRAYS, *_REST)} | {_SEALS: rotor.seals.rows})
    return rotor


def load_modelled_bearings(
    config: RotorConfig, bearing: BearingConfig, speeds: np.ndarray, operating: Mapping[str, np.ndarray] | None = None
) -> BearingTable:
    """The modelled coefficients at ``speeds`` (S,) rad/s and ``operating`` conditions (S,): from the cache, or by ROSS.

    Raises ConfigError where the rotor file can't be read, where a bearing needs a condition that is not there, or the
    bearings give no finite coefficients.
    """
    speeds, operating = np.ascontiguousarray(speeds, dtype=float), operating or {}
    states = [entry for name, values in operating.items() for entry in (name, np.array(values, dtype=float).tobytes())]
    ingredients = (bearing.model_dump_json(), bearing.read_bytes())
    key = hash_parts(hash_rotor(config), *ingredients, speeds.tobytes(), *states)
    kept = _look_up(_BEARINGS, key, {"nodes", "values"})
    if kept:
        return BearingTable(tuple(kept["nodes"].astype(int).tolist()), speeds, kept["values"], operating)
    from pipeline.rotor.ross_adapter import bearing_table

    table = bearing_table(config, bearing, speeds, operating)
    _keep(_BEARINGS, key, {"nodes": table.nodes, "values": table.values})
    return table


def _keep(kind: str, key: str, values: Mapping[str, Any]) -> None:
    """Keep the values in double precision."""
    from safetensors.numpy import save

    arrays = {name: np.ascontiguousarray(value, dtype=float) for name, value in values.items()}
    keep(kind, key, bytes(save(arrays)))


def _look_up(kind: str, key: str, names: set[str]) -> dict[str, np.ndarray] | None:
    """The arrays ``names``, bit by bit; None where there are none, or a damaged entry."""
    from safetensors import SafetensorError, deserialize

    content = look_up(kind, key)
    try:
        entries = dict(deserialize(content or b""))
        if not names <= entries.keys():
            return None
        return {
            name: np.frombuffer(entries[name]["data"], dtype=np.float64).reshape(entries[name]["shape"])
            for name in names
        }
    except (SafetensorError, ValueError):
        return None


def require_nodes(rotor: RotorModel, key: str, nodes: Sequence[int]) -> None:
    """Raise ConfigError for a node that a rotor from a file lacks; other rotors are checked with the configuration."""
    for node in nodes:
        if node >= (last := rotor.n_nodes + len(rotor.casings)):
            raise ConfigError(f"{key} must use nodes 0 to {last - 1} of the rotor, but got node {node}")


def place_probe(rotor: RotorModel, key: str, probe: ProbeConfig | runs.ProbeConfig) -> int:
    """The node that a probe of the configuration has in the data, see :meth:`pipeline.rotor.model.RotorModel.views`.

    Raises ConfigError for a node that the rotor lacks, and for a casing where the bearing stands on the ground.
    """
    require_nodes(rotor, key, [probe.node])
    if probe.measures == "shaft":
        return probe.node
    if probe.node not in rotor.casings:
        raise ConfigError(
            f"{key} must measure the casing where machine.rotor.supports has one "
            f"({', '.join(map(str, rotor.casings)) or 'nowhere'}), but got node {probe.node} with measures: "
            f"{probe.measures}; state the support, or leave measures out"
        )
    first = rotor.n_nodes if probe.measures == "casing" else rotor.n_nodes + len(rotor.casings)
    return first + rotor.casings.index(probe.node)


def place_probes(rotor: RotorModel, recordings: Recordings) -> Recordings:
    """The recordings whose probes have their nodes in the data. Raises as :func:`place_probe`."""
    placed = {
        name: probe.model_copy(
            update={"node": place_probe(rotor, f"machine.recordings.probes.{name}", probe), "measures": "shaft"}
        )
        for name, probe in recordings.probes.items()
    }
    return recordings.model_copy(update={"probes": placed})
