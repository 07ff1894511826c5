"""Figures of identification: modelled as a line, identified as markers, in colour-blind safe colours."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from string import ascii_lowercase
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.coefficients import COEFFICIENTS, is_direct, unit
from pipeline.data.tables import read_table
from pipeline.data.vibration_files import to_rpm
from pipeline.evaluation.errors import relative_errors
from pipeline.files import write_beside
from pipeline.rotor.bearing_table import BearingTable

if TYPE_CHECKING:
    import pandas as pd

    from pipeline.identification.residual_loss import ResidualTraining
    from pipeline.identification.training import Minimum

# Okabe and Ito's palette.
BLUE, ORANGE, GREEN, PURPLE, SKY, GREY = "#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#555555"
_STYLE: dict[Any, Any] = {
    "figure.dpi": 110,
    "savefig.dpi": 110,
    "font.size": 10,
    "axes.grid": True,
    "grid.alpha": 0.3,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "legend.frameon": False,
}
MARKERS = 30
"""About as many identified points a curve as can be told apart."""


def legend_above(ax: Any) -> None:
    """A legend in one line above the axes, where no curve can pass."""
    ax.legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=4, borderaxespad=0.2)


def draw_markers(ax: Any, x: np.ndarray, y: np.ndarray, colour: str, label: str, count: int = MARKERS) -> None:
    """About ``count`` open circles of a curve."""
    every = max(1, len(x) // count)
    ax.plot(x[::every], y[::every], ls="", marker="o", ms=5, mfc="none", mec=colour, label=label)


@contextmanager
def figure(path: Path, rows: int, columns: int, width: float, height: float, **options: Any) -> Iterator[np.ndarray]:
    """Axes (rows, columns) of a figure, written to ``path`` when the block ends well. Raises StorageError."""
    from matplotlib import rc_context
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    with rc_context(_STYLE):
        drawn = Figure(figsize=(width, height), layout="constrained")
        FigureCanvasAgg(drawn)
        yield drawn.subplots(rows, columns, squeeze=False, **options)
        write_beside(path, lambda beside: drawn.savefig(beside))


def coefficient_figure(
    path: Path,
    letter: str,
    identified: BearingTable,
    modelled: BearingTable | None,
    unknowns: Sequence[Sequence[str]],
    deviation: np.ndarray | None = None,
) -> Path:
    """Paper, Figures 3 (``letter`` k) and 4 (c): coefficients over speed, and the error below.

    ``unknowns`` are those of each bearing. A direct coefficient that was not identified is drawn as the known line that
    it is. ``deviation`` (B, S, 8) is drawn as a band, and beside the error as nominal 95 % interval.
    """
    named = {name for of in unknowns for name in of}
    names = [name for name in COEFFICIENTS if name[0] == letter and (is_direct(name) or name in named)]
    rpm = to_rpm(identified.speeds)
    kind = "stiffness" if letter == "k" else "damping"
    some = any(name in named for name in names) and modelled is not None
    ratios = {"height_ratios": [2.2, 1]} if some else {}
    with figure(
        path,
        2 if some else 1,
        len(identified.nodes),
        10.5,
        6.2 if some else 4.0,
        sharex=True,
        gridspec_kw=ratios,
    ) as axes:
        for b, node in enumerate(identified.nodes):
            _coefficients(axes[0, b], b, rpm, names, identified, modelled, unknowns[b])
            if deviation is not None:
                _bands(axes[0, b], rpm, names, identified.values[b], deviation[b])
            axes[0, b].set_title(f"bearing at node {node}")
            if some and modelled is not None:
                for name, (colour, _) in zip(names, _looks(), strict=False):
                    if name in unknowns[b]:
                        error = np.maximum(relative_errors(identified, modelled, name)[b], 1e-14)
                        axes[1, b].semilogy(rpm, error, color=colour, lw=1.2, label=name)
                        if deviation is not None:
                            c = COEFFICIENTS.index(name)
                            bound = 196.0 * deviation[b, :, c] / np.abs(modelled.values[b, :, c])
                            axes[1, b].semilogy(rpm, bound, color=colour, lw=1.0, ls=":")
                axes[1, b].set_ylabel("error (%)" if deviation is None else "error, and nominal\n95 % (dotted) (%)")
            axes[-1, b].set_xlabel("rotor speed (rpm)")
        axes[0, 0].set_ylabel(f"{kind} ({unit(names[0])})")
        if len(names) > 2:  # too many for a place among the curves
            entries = axes[0, 0].get_legend_handles_labels()
            axes[0, 0].figure.legend(*entries, loc="outside upper center", ncols=4)
        else:
            axes[0, 0].legend()
    return path


def _bands(ax: Any, rpm: np.ndarray, names: Sequence[str], values: np.ndarray, deviation: np.ndarray) -> None:
    """Two standard deviations either side."""
    for name, (colour, _) in zip(names, _looks(), strict=False):
        c = COEFFICIENTS.index(name)
        if not np.isnan(deviation[:, c]).all():
            low, high = values[:, c] - 2 * deviation[:, c], values[:, c] + 2 * deviation[:, c]
            ax.fill_between(rpm, low, high, color=colour, alpha=0.25, lw=0)


def _looks() -> list[tuple[str, str]]:
    return [(BLUE, "o"), (ORANGE, "s"), (GREEN, "^"), (PURPLE, "D")]


def _coefficients(
    ax: Any,
    b: int,
    rpm: np.ndarray,
    names: Sequence[str],
    identified: BearingTable,
    modelled: BearingTable | None,
    unknowns: Sequence[str],
) -> None:
    for name, (colour, marker) in zip(names, _looks(), strict=False):
        if name not in unknowns:
            ax.plot(
                rpm,
                identified.coefficient(name)[b],
                color=colour,
                ls="--",
                lw=1.5,
                label=f"{name} known, not identified",
            )
            continue
        if modelled is not None:
            ax.plot(rpm, modelled.coefficient(name)[b], color=colour, lw=1.5, label=f"{name} modelled")
        every = max(1, len(rpm) // MARKERS)
        ax.plot(
            rpm[::every],
            identified.coefficient(name)[b, ::every],
            ls="",
            marker=marker,
            ms=5,
            mfc="none",
            mec=colour,
            label=f"{name} identified",
        )
    values = np.concatenate([identified.coefficient(name)[b] for name in names])
    if values.min() > 0:
        ax.set_yscale("log")


def history_figure(path: Path, history: Path, label: str) -> Path:
    """The loss, which ``label`` names, over the steps of training, on training and held-out speeds."""
    table = read_table(
        history, {"step": "number", "phase": "text", "loss": "number"}, {"held_out_loss": "number or blank"}
    )
    with figure(path, 1, 1, 7.5, 4.2) as axes:
        ax = axes[0, 0]
        ax.semilogy(table["step"], table["loss"], color=BLUE, label="training speeds")
        if "held_out_loss" in table:
            ax.semilogy(table["step"], table["held_out_loss"], color=ORANGE, ls="--", label="held-out speeds")
        for phase in dict.fromkeys(table["phase"]):
            if phase != "start":
                first = table["step"][table["phase"] == phase][0]
                ax.axvline(first, color=GREY, lw=0.8, ls=":")
                ax.annotate(
                    str(phase).replace("_", "-"),
                    (first, 1),
                    xycoords=("data", "axes fraction"),
                    xytext=(4, -12),
                    textcoords="offset points",
                    color=GREY,
                )
        ax.set_xlabel("training step")
        ax.set_ylabel(label)
        ax.legend(loc="center right")
    return path


def robustness_figure(
    path: Path,
    training: ResidualTraining,
    found: Minimum,
    over: str,
    rows: pd.DataFrame,
    modelled: BearingTable | None,
) -> Path:
    """Paper, Figure 2: the stiffnesses on their way from every guess; final errors over guesses or seeds."""
    unknowns = training.model.unknowns
    if not found.trajectory:
        return _final_errors(path, rows, over)
    steps = np.array([step for step, _ in found.trajectory])
    paths = np.stack([_values(training, parameters) for _, parameters in found.trajectory])  # (T, G, M, U)
    nodes = training.measurement.rotor.bearing_nodes
    members = paths.shape[2]
    with figure(path, members, len(unknowns), 5.2 * len(unknowns), 3.4 * members, sharex=True) as axes:
        for m in range(members):
            for u, name in enumerate(unknowns):
                ax = axes[m, u]
                ax.semilogy(steps, paths[:, :, m, u], color=BLUE, lw=0.7, alpha=0.6)
                where = f"bearing at node {nodes[m]}" if members == len(nodes) else "all bearings"
                ax.set_title(f"({ascii_lowercase[m * len(unknowns) + u]}) {name}, {where}")
                if modelled is not None:
                    ax.axhline(modelled.coefficient(name)[m, 0], color=ORANGE, lw=1.5, ls="--", label="modelled")
                ax.plot([], [], color=BLUE, lw=0.7, label=f"{len(found.outcomes)} initial guesses")
                ax.set_ylabel(f"{name} ({unit(name)})")
                ax.set_xlabel("training step" if m == members - 1 else "")
        axes[0, 0].legend(loc="lower right")
    return path


def _values(training: ResidualTraining, parameters: Any) -> np.ndarray:
    model = training.model
    return model.physical(parameters, model.scale_tensor()[:, 0]).detach().numpy()


def _final_errors(path: Path, rows: pd.DataFrame, over: str) -> Path:
    with figure(path, 1, 1, 8.0, 4.2) as axes:
        ax = axes[0, 0]
        has_truth = rows["mean_error_percent"].notna().all()
        quantity = "mean_error_percent" if has_truth else "loss"
        for i, ((node, name), group) in enumerate(rows.groupby(["bearing_node", "coefficient"], sort=False)):
            colour, marker = [*_looks(), (SKY, "v"), (GREY, "x"), ("#E69F00", "P"), ("#000000", "*")][i % 8]
            ax.semilogy(
                group[over],
                group[quantity],
                ls="",
                marker=marker,
                ms=7,
                color=colour,
                mfc=colour if i < 8 else "none",
                label=f"node {node} {name}",
            )
        if over == "initial_guess":
            ax.set_xscale("log")
        ax.set_xlabel("seed" if over == "seed" else "initial guess of the stiffness (N/m)")
        ax.set_ylabel("mean error over speeds (%)" if has_truth else "loss (-)")
        ax.legend(loc="center left", bbox_to_anchor=(1.0, 0.5))
    return path
