"""The loads of the runs, ``excitation.csv``: ``run, kind, node, magnitude, phase_deg, whirl``.

Kind ``unbalance`` (kg m) or ``force`` (N); a run without any weight has an unbalance of zero. The order of the rows
means nothing.

Beside them the runs that an experimenter could make. Legend: R runs.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from pipeline.config.measured import MeasuredRunConfig
from pipeline.config.runs import CandidateConfig, RunConfig
from pipeline.data.dataset import Excitation, VibrationDataset
from pipeline.data.tables import read_table, write_table
from pipeline.errors import DataError

_EXCITATION = {
    "run": "text",
    "kind": "text",
    "node": "number",
    "magnitude": "number",
    "phase_deg": "number",
    "whirl": "text",
}


def write_excitation(path: Path, dataset: VibrationDataset) -> Path:
    """Write what excited the runs; a run that nothing excites (the baseline) has no row. Raises StorageError."""
    return write_table(
        path,
        {
            "run": [e.run for e in dataset.excitations],
            "kind": [e.kind for e in dataset.excitations],
            "node": [e.node for e in dataset.excitations],
            "magnitude": [e.magnitude for e in dataset.excitations],
            "phase_deg": [float(np.degrees(e.phase)) for e in dataset.excitations],
            "whirl": [e.whirl for e in dataset.excitations],
        },
    )


def read_excitations(path: Path, n_nodes: int | None = None) -> tuple[Excitation, ...]:
    """What acts in the runs, in the order of the rows. Raises DataError."""
    table = read_table(path, _EXCITATION)
    _check_words(table["kind"], ("unbalance", "force"), path, "kind")
    _check_words(table["whirl"], ("forward", "backward"), path, "whirl")
    nodes, magnitudes = read_nodes(table["node"], path, n_nodes), table["magnitude"]
    wrong = (magnitudes < 0) | ((magnitudes == 0) & (table["kind"] == "force"))
    if wrong.any():
        raise DataError(
            f"'{path}' must have magnitudes above zero (an unbalance of zero is a run without weight), but got "
            f"{magnitudes[wrong].min():g}"
        )
    rows = zip(
        table["run"], table["kind"], nodes, magnitudes, np.radians(table["phase_deg"]), table["whirl"], strict=True
    )
    return tuple(
        Excitation(str(run), kind, int(node), float(magnitude), float(phase), whirl)
        for run, kind, node, magnitude, phase, whirl in rows
    )


def read_nodes(values: np.ndarray, path: Path, n_nodes: int | None) -> np.ndarray:
    """Nodes as integers. Raises DataError for one that a rotor of ``n_nodes`` lacks; None: it is not known how many."""
    bad = values[(values != np.round(values)) | (values < 0) | (values >= (np.inf if n_nodes is None else n_nodes))]
    if len(bad):
        nodes = "nodes 0, 1, 2 and so on" if n_nodes is None else f"nodes 0 to {n_nodes - 1}"
        raise DataError(f"'{path}' must use the rotor's {nodes}, but got node {bad[0]:g}")
    return values.astype(int)


def _check_words(values: np.ndarray, allowed: tuple[str, ...], path: Path, column: str) -> None:
    for value in dict.fromkeys(values.tolist()):
        if value not in allowed:
            raise DataError(
                f"'{path}' must have {' or '.join(map(repr, allowed))} in the column '{column}', but got {value!r}"
            )


# --- runs that an experimenter could make ---------------------------------------------------------


def run_excitations(
    run: RunConfig | MeasuredRunConfig, turn: Callable[[float], float] = float
) -> tuple[Excitation, ...]:
    """What acts in a configured run; ``turn`` makes the angle from x, rad, of an unbalance's phase."""
    weights = [Excitation(run.name, "unbalance", u.node, u.magnitude, turn(u.phase)) for u in run.unbalances]
    forces = [Excitation(run.name, "force", f.node, f.magnitude, f.phase, f.whirl) for f in run.forces]
    return (*weights, *forces)


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
