"""The runs that an experimenter could make, and the file that a design writes of those that are chosen."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from pipeline.config.runs import CandidateConfig, SpeedsConfig
from pipeline.config.schema import Config
from pipeline.data.dataset import Excitation


def list_candidates(can: CandidateConfig) -> tuple[tuple[Excitation, ...], ...]:
    """Every run that could be made: single unbalances, pairs of them, and rotating forces."""
    made: list[tuple[Excitation, ...]] = []

    def unbalance(name: str, node: int, degrees: float) -> Excitation:
        return Excitation(name, "unbalance", node, can.unbalance, float(np.radians(degrees)))

    for node in can.unbalance_nodes:  # the phase of a single source does not matter
        made.append((unbalance(f"unbalance_{node}", node, 0.0),))
    for (first, second), degrees in itertools.product(itertools.combinations(can.unbalance_nodes, 2), can.phases_deg):
        name = f"unbalance_{first}_and_{second}_at_{degrees:g}_deg"
        made.append((unbalance(name, first, 0.0), unbalance(name, second, degrees)))
    for node, whirl in itertools.product(can.force_nodes, can.whirls):
        made.append((Excitation(f"{whirl}_force_{node}", "force", node, can.force, 0.0, whirl),))
    return tuple(made)


Runs = tuple[tuple[Excitation, ...], ...]
"""What acts in each run."""


def scale_runs(runs: Runs, scale: np.ndarray) -> Runs:
    """The runs with all that acts in each times its ``scale`` (R,)."""
    return tuple(
        tuple(replace(weight, magnitude=weight.magnitude * float(s)) for weight in acting)
        for acting, s in zip(runs, scale, strict=True)
    )


def format_runs(config: Config, chosen: Sequence[Sequence[Excitation]], speeds: SpeedsConfig) -> str:
    """The YAML that ``machine.runs_file`` takes."""
    import yaml

    runs = []
    for acting in chosen:
        run: dict[str, object] = {"name": acting[0].run}
        for key, kind in (("unbalances", "unbalance"), ("forces", "force")):
            alike = [excitation for excitation in acting if excitation.kind == kind]
            if alike:
                run[key] = [_format_source(excitation) for excitation in alike]
        runs.append(run)
    content = {"speeds": speeds.model_dump(), "runs": runs}
    head = f"# Chosen by: python -m pipeline stage=design {config.chosen}\n"
    return head + yaml.safe_dump(content, sort_keys=False)


def _format_source(excitation: Excitation) -> dict[str, object]:
    unit = "kg m" if excitation.kind == "unbalance" else "N"
    source: dict[str, object] = {"node": excitation.node, "magnitude": f"{excitation.magnitude:.12g} {unit}"}
    source["phase"] = f"{np.degrees(excitation.phase):.12g} deg"
    return source | ({"whirl": excitation.whirl} if excitation.kind == "force" else {})
