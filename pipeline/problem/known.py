"""The coefficients that an experiment takes as known, from wherever its configuration says."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from pipeline.coefficients import COEFFICIENTS
from pipeline.config.measured import AS_MODELLED, KnownConfig
from pipeline.config.schema import Config
from pipeline.data.coefficient_files import read_known
from pipeline.data.operating_points import Operating
from pipeline.errors import ConfigError
from pipeline.rotor.bearing_table import BearingTable
from pipeline.rotor.stored import load_modelled_bearings


def load_known(
    config: Config,
    given: str | KnownConfig | None,
    key: str,
    nodes: Sequence[int],
    speeds: np.ndarray,
    operating: Operating | None = None,
) -> BearingTable | None:
    """The known coefficients of the bearings at ``nodes``, ``speeds`` (S,) rad/s and ``operating`` conditions (S,)
    each; the others are zero.

    ``given`` is what the configuration has at ``key``. None where some are needed and nothing gives them. Raises
    ConfigError for values that lack one, DataError as :func:`pipeline.data.coefficient_files.read_known`.
    """
    needed = list_known(config, nodes)
    operating = operating or {}
    blank = BearingTable(tuple(nodes), speeds, np.zeros((len(nodes), len(speeds), len(COEFFICIENTS))), operating)
    if not any(needed.values()):
        return blank
    if given is None:
        return None
    if given == AS_MODELLED:
        bearings = load_modelled_bearings(config.machine.rotor, config.machine.bearings, speeds, operating)
        stays = np.array([[name in needed[node] for name in COEFFICIENTS] for node in bearings.nodes])
        return replace(bearings, values=np.where(stays[:, None], bearings.values, 0.0))
    if isinstance(given, KnownConfig):
        return _fill(given, key, needed, blank)
    return read_known(Path(given), nodes, speeds, needed, operating)


def require_known(known: BearingTable | None, config: Config, nodes: Sequence[int]) -> BearingTable:
    """``known``. Raises ConfigError where there is none: it says what is missing, and how to give it."""
    if known is not None:
        return known
    every = [name for name in COEFFICIENTS if any(name in names for names in list_known(config, nodes).values())]
    values = ", ".join(f"{name}: 0 {'N/m' if name.startswith('k') else 'N s/m'}" for name in every)
    raise ConfigError(
        f"coefficients that are not identified must be known, but nothing gives {', '.join(every)}: give values or a "
        f"file as machine.recordings.known (of vibration of your own: data.known), such as {{{values}}}, or "
        f"'{AS_MODELLED}' for those of the machine's bearings; or identify them too (identify.unknowns)"
    )


def _fill(given: KnownConfig, key: str, needed: dict[int, tuple[str, ...]], blank: BearingTable) -> BearingTable:
    values = blank.values.copy()
    for b, names in enumerate(needed.values()):
        for name in names:
            value = getattr(given, name)
            if value is None:
                raise ConfigError(
                    f"{key} must have a value of every coefficient that is not identified, but {name} is missing"
                )
            values[b, :, COEFFICIENTS.index(name)] = value
    return replace(blank, values=values)


def list_known(config: Config, nodes: Sequence[int]) -> dict[int, tuple[str, ...]]:
    """The coefficients of each bearing that are not identified. Raises ConfigError for an exception without bearing."""
    for node in config.identify.bearings:
        if node not in nodes:
            raise ConfigError(
                f"identify.bearings must name bearing nodes of the rotor ({', '.join(map(str, nodes))}), but got {node}"
            )
    unknown = {node: config.identify.at(node).coefficients for node in nodes}
    return {node: tuple(name for name in COEFFICIENTS if name not in unknown[node]) for node in nodes}
