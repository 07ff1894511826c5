"""The runs that an experimenter could make.

Legend: R runs.
"""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np

from pipeline.config.runs import CandidateConfig
from pipeline.data.dataset import Excitation

Runs = tuple[tuple[Excitation, ...], ...]
"""What acts in each run."""


def list_candidates(can: CandidateConfig) -> Runs:
    """Every run that could be made: single unbalances, pairs of them, and rotating forces."""

    def unbalance(name: str, node: int, degrees: float) -> Excitation:
        return Excitation(name, "unbalance", node, can.unbalance, float(np.radians(degrees)))

    # The phase of a single source does not matter.
    made: list[tuple[Excitation, ...]] = [(unbalance(f"unbalance_{node}", node, 0.0),) for node in can.unbalance_nodes]
    for (first, second), degrees in itertools.product(itertools.combinations(can.unbalance_nodes, 2), can.phases_deg):
        name = f"unbalance_{first}_and_{second}_at_{degrees:g}_deg"
        made.append((unbalance(name, first, 0.0), unbalance(name, second, degrees)))
    made += [
        (Excitation(f"{whirl}_force_{node}", "force", node, can.force, 0.0, whirl),)
        for node, whirl in itertools.product(can.force_nodes, can.whirls)
    ]
    return tuple(made)


def scale_runs(runs: Runs, scale: np.ndarray) -> Runs:
    """The runs with all that acts in each times its ``scale`` (R,)."""
    return tuple(
        tuple(replace(weight, magnitude=weight.magnitude * float(s)) for weight in acting)
        for acting, s in zip(runs, scale, strict=True)
    )
