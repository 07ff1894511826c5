"""What ROSS made is kept in the cache: its import takes seconds, and is needed for a new rotor or bearing only.

A rotor's casings may move: each is a node of its own between film and support. A bearing pushes the shaft by ``-H d``
and its casing by ``+H d``, with ``d`` the shaft's motion less the casing's. Where a support
``S = K_s + j w C_s - w^2 M_s`` holds the casing, the shaft feels both in series,

    Z = (H^-1 + S^-1)^-1,    q_casing = S^-1 Z q_shaft

Here the casing's displacement stays among the unknown ones, so that modes and motions in time have it, too. SI units.
"""

from __future__ import annotations

import importlib.metadata
import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from pipeline.config.rotor import RotorConfig
from pipeline.errors import ConfigError
from pipeline.files import hash_parts, keep, look_up
from pipeline.rotor.bearing_table import BearingTable
from pipeline.rotor.bearings import BearingConfig
from pipeline.rotor.model import DOF_PER_NODE, TRANSLATIONS, RotorModel, Seals

if TYPE_CHECKING:
    from pipeline.config.measured import AnyRecordingsConfig
    from pipeline.config.runs import ProbeConfig

Recordings = TypeVar("Recordings", bound="AnyRecordingsConfig")
KIND = "rotors"
_BEARINGS = "bearings"
_CODE = ("ross_adapter", "bearings")
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
    key = hash_rotor(config)
    kept = _look_up(KIND, key, {*_ARRAYS, *_REST, _SEALS})
    if kept:
        rotor = RotorModel(
            **{name: kept[name] for name in _ARRAYS},
            bearing_nodes=tuple(kept["bearing_nodes"].astype(int).tolist()),
            disc_nodes=tuple(kept["disc_nodes"].astype(int).tolist()),
            total_mass=float(kept["total_mass"][0]),
            seals=Seals(kept[_SEALS]),
            supported_nodes=tuple(kept["supported_nodes"].astype(int).tolist()),
            bearing_shifts=(),
            casings=(),
        )
    else:
        from pipeline.rotor.ross_adapter import assemble

        rotor = assemble(config)
        _keep(KIND, key, {name: getattr(rotor, name) for name in (*_ARRAYS, *_REST)} | {_SEALS: rotor.seals.rows})
    return _put_on_ground(rotor, config) if config.n_casings else rotor


_UPRIGHT = {"mass": 1.0, "damping": 3e4, "stiffness": 1e8}
"""kg m^2, N m s, N m: a casing does not tilt, and its rotations, which nothing feels, are overdamped."""


def _put_on_ground(rotor: RotorModel, config: RotorConfig) -> RotorModel:
    """The rotor with a casing for each support, in their order; or on a base, whose modes are coordinates of unit mass.

    Two coordinates are x and y of a node of the ground. With participations ``u_r`` (2,) a point of a base moves by
    ``sum u_r eta_r``, and a force f there drives each by ``u_r f``: what the base yields is ``sum u_r u_r' / (w_r^2 -
    w^2 + 2 j zeta_r w_r w)``, which pedestals share (Friswell, Penny, Garvey and Lees 2010, Dynamics of Rotating
    Machines). Raises ConfigError for a support or a point that is at no bearing, for the second support of a bearing,
    and where bearings have supports of a rotor's file.
    """
    from scipy.linalg import block_diag

    base, free = config.base, [node for node in rotor.bearing_nodes if node not in rotor.supported_nodes]
    nodes = base.points or tuple(support.node for support in config.supports)
    if not set(nodes) <= set(free) or (config.supports and len(set(nodes)) < len(nodes)):
        key, once = ("base.points", "") if base.points else ("supports", " each once,")
        raise ConfigError(
            f"machine.rotor.{key} must have bearing nodes without a support ({', '.join(map(str, free))}),{once} but "
            f"has {', '.join(map(str, nodes))}: leave the others out, here or in the rotor file"
        )
    held = [support.matrices for support in config.supports]
    for mode in base.modes:
        w = 2 * np.pi * mode.frequency
        held.append({"mass": [[1.0]], "damping": [[2 * mode.damping_ratio * w]], "stiffness": [[w**2]]})
    count = sum(len(each["mass"]) for each in held)
    rest = DOF_PER_NODE * -(-count // TRANSLATIONS)
    wide: dict[str, Any] = {name: np.pad(getattr(rotor, name), (0, rest)) for name in _ARRAYS if name != "positions"}
    ground = np.arange(rotor.n_dof, rotor.n_dof + rest)
    at = ground[ground % DOF_PER_NODE < TRANSLATIONS][:count]
    for name, size in _UPRIGHT.items():
        wide[name][ground, ground] = size
        wide[name][np.ix_(at, at)] = block_diag(*(each[name] for each in held))
    shapes = rotor.participation
    if base.points:
        shapes = np.zeros((len(nodes), TRANSLATIONS, rest * TRANSLATIONS // DOF_PER_NODE))
        shapes[..., :count] = np.stack([mode.participation for mode in base.modes], axis=-1)
    return replace(rotor, **wide, casings=nodes, participation=shapes)


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
    """The arrays ``names``, bit by bit; None where there are none."""
    from safetensors.numpy import load

    content = look_up(kind, key)
    entries = load(content) if content else {}
    return entries if names <= entries.keys() else None


def require_nodes(rotor: RotorModel, key: str, nodes: Sequence[int]) -> None:
    """Raise ConfigError for a node that a rotor from a file lacks; other rotors are checked with the configuration."""
    for node in nodes:
        if node >= (last := rotor.n_nodes + len(rotor.casings)):
            raise ConfigError(f"{key} must use nodes 0 to {last - 1} of the rotor, but got node {node}")


def place_probe(rotor: RotorModel, key: str, probe: ProbeConfig) -> int:
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
