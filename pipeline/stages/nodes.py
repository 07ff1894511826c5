"""Whether the nodes that a configuration names are there, and what it takes as known of their bearings."""

from __future__ import annotations

from collections.abc import Sequence

from pipeline.coefficients import COEFFICIENTS
from pipeline.config.schema import Config
from pipeline.errors import ConfigError
from pipeline.rotor.model import RotorModel


def require_nodes(rotor: RotorModel, key: str, nodes: Sequence[int]) -> None:
    """Raise ConfigError for a node that a rotor from a file lacks; other rotors are checked with the configuration."""
    for node in nodes:
        if node >= rotor.n_nodes:
            raise ConfigError(f"{key} must use nodes 0 to {rotor.n_nodes - 1} of the rotor, but got node {node}")


def known_coefficients(config: Config, nodes: Sequence[int]) -> dict[int, tuple[str, ...]]:
    """The coefficients of each bearing that are not identified. Raises ConfigError for an exception without bearing."""
    for node in config.identify.bearings:
        if node not in nodes:
            raise ConfigError(
                f"identify.bearings must name bearing nodes of the rotor ({', '.join(map(str, nodes))}), but got {node}"
            )
    unknown = {node: config.identify.at(node).coefficients for node in nodes}
    return {node: tuple(name for name in COEFFICIENTS if name not in unknown[node]) for node in nodes}
