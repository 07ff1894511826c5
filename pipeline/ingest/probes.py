"""From probes at any mounting angle to x and y: v_i = x cos a_i + y sin a_i at each node, solved by least squares.

Legend: S speeds, P probes, R runs, N nodes.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from pipeline.config.measured import ProbeConfig
from pipeline.data.dataset import DIRECTIONS
from pipeline.errors import ConfigError

LEAST_SPREAD = np.radians(10.0)
"""Probes that are nearer to one line amplify their errors by more than eight."""


@dataclass(frozen=True, eq=False)
class Resolved:
    """Displacements in x and y, and how far the probes contradict each other."""

    channels: tuple[tuple[int, float], ...]  # 2 N of (node, angle in degrees) of x and y
    displacement: np.ndarray  # (S, 2 N, R) complex, m
    misfit: Mapping[int, float]  # node -> root mean square of the residual over that of the vectors; 0 for two probes


def check_probes(probes: Mapping[str, ProbeConfig]) -> None:
    """Raise ConfigError for a node at which x and y can't be told apart."""
    for node in sorted({probe.node for probe in probes.values()}):
        here = {name: probe for name, probe in probes.items() if probe.node == node}
        if len(here) == 1:
            raise ConfigError(
                f"machine.recordings.probes must have two probes at a node to give x and y, but node {node} has one "
                f"only: '{next(iter(here))}'; add the other, or leave the node out"
            )
        angles = np.array([probe.angle for probe in here.values()])
        if np.abs(np.sin(angles[:, None] - angles)).max() < np.sin(LEAST_SPREAD):
            text = ", ".join(f"'{name}' at {np.degrees(probe.angle):g} deg" for name, probe in here.items())
            raise ConfigError(
                f"machine.recordings.probes must span the plane at each node, but those of node {node} lie within "
                f"{np.degrees(LEAST_SPREAD):g} deg of one line: {text}"
            )


def resolve(probes: Mapping[str, ProbeConfig], vectors: np.ndarray) -> Resolved:
    """x and y at every node, of the ``vectors`` (S, P, R) of the probes in this order; see :func:`check_probes`."""
    nodes = sorted({probe.node for probe in probes.values()})
    place = np.array([probe.node for probe in probes.values()])
    angles = np.array([probe.angle for probe in probes.values()])
    parts, misfit = [], {}
    for node in nodes:
        here = np.flatnonzero(place == node)
        matrix = np.stack([np.cos(angles[here]), np.sin(angles[here])], axis=1)
        seen = vectors[:, here]
        solved = np.einsum("dp,spr->sdr", np.linalg.pinv(matrix), seen)
        rest = seen - np.einsum("pd,sdr->spr", matrix, solved)
        size = np.sqrt((np.abs(seen) ** 2).mean())
        misfit[node] = float(np.sqrt((np.abs(rest) ** 2).mean()) / size) if size > 0 and len(here) > 2 else 0.0
        parts.append(solved)
    channels = tuple((node, angle) for node in nodes for angle in DIRECTIONS.values())
    return Resolved(channels, np.concatenate(parts, axis=1), misfit)
