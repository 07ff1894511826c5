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
from pipeline.evaluation.errors import measure_relative_errors
from pipeline.files import write_beside
from pipeline.rotor.bearing_table import BearingTable

if TYPE_CHECKING:
    import pandas as pd

    from pipeline.identification.residual_loss import ResidualTraining
    from pipeline.identification.training import Minimum

# Okabe and Ito's palette.
BLUE, ORANGE, GREEN, PURPLE, SKY, GREY = "#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#555555"
YELLOW, BLACK = "#E69F00", "#000000"
LOOKS = ((BLUE, "o"), (ORANGE, "s"), (GREEN, "^"), (PURPLE, "D"), (SKY, "v"), (GREY, "x"), (YELLOW, "P"), (BLACK, "*"))
"""Colours and markers of the curves that share a panel."""
MICROMETRES = 1e6
KINDS = {"k": "stiffness", "c": "damping"}
MARKERS = 30
"""About as many identified points a curve as can be told apart."""
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


def place_legend(ax: Any) -> None:
    """Put the legend in one line above the axes, where no curve can pass."""
    ax.legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=4, borderaxespad=0.2)


def draw_markers(
    ax: Any,
    x: np.ndarray,
    y: np.ndarray,
    colour: str,
    label: str = "",
    marker: str = "o",
    count: int = MARKERS,
    shift: float = 0.0,
) -> None:
    """Draw about ``count`` open markers of a curve; the first lies by ``shift`` of their distance from its start."""
    every = max(1, len(x) // count)
    shown = slice(int(shift * every), None, every)
    ax.plot(x[shown], y[shown], ls="", marker=marker, ms=5, mfc="none", mec=colour, label=label)


def draw_band(
    ax: Any, x: np.ndarray, y: np.ndarray, deviation: np.ndarray, colour: str, least: float | np.ndarray = -np.inf
) -> None:
    """Fill two standard deviations either side of a curve, down to ``least``."""
    ax.fill_between(x, np.maximum(y - 2 * deviation, least), y + 2 * deviation, color=colour, alpha=0.25, lw=0)


@contextmanager
def open_figure(
    path: Path, rows: int, columns: int, width: float, height: float, **options: Any
) -> Iterator[np.ndarray]:
    """Axes (rows, columns) of a figure, written to ``path`` when the block ends well. Raises StorageError."""
    from matplotlib import rc_context
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    with rc_context(_STYLE):
        drawn = Figure(figsize=(width, height), layout="constrained")
        FigureCanvasAgg(drawn)
        yield drawn.subplots(rows, columns, squeeze=False, **options)
        write_beside(path, lambda beside: drawn.savefig(beside))


def draw_coefficients(
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
    named = {name for unknown in unknowns for name in unknown}
    names = [name for name in COEFFICIENTS if name[0] == letter and (is_direct(name) or name in named)]
    compared = modelled is not None and not named.isdisjoint(names)
    ratios, height = ([2.2, 1], 6.2) if compared else ([1], 4.0)
    options: dict[str, Any] = {"sharex": True, "gridspec_kw": {"height_ratios": ratios}}
    with open_figure(path, len(ratios), len(identified.nodes), 10.5, height, **options) as axes:
        for b, node in enumerate(identified.nodes):
            for name, look in zip(names, LOOKS, strict=False):
                _draw_coefficient(axes[:, b], b, name, look, identified, modelled, name in unknowns[b], deviation)
            if all(identified.coefficient(name)[b].min() > 0 for name in names):
                axes[0, b].set_yscale("log")
            axes[0, b].set_title(f"bearing at node {node}")
            if compared:
                axes[1, b].set_ylabel("error (%)" if deviation is None else "error, and nominal\n95 % (dotted) (%)")
            axes[-1, b].set_xlabel("rotor speed (rpm)")
        axes[0, 0].set_ylabel(f"{KINDS[letter]} ({unit(names[0])})")
        if len(names) > 2:  # too many for a place among the curves
            entries = axes[0, 0].get_legend_handles_labels()
            axes[0, 0].figure.legend(*entries, loc="outside upper center", ncols=4)
        else:
            axes[0, 0].legend()
    return path


def _draw_coefficient(
    axes: np.ndarray,
    b: int,
    name: str,
    look: tuple[str, str],
    identified: BearingTable,
    modelled: BearingTable | None,
    unknown: bool,
    deviation: np.ndarray | None,
) -> None:
    """Draw one coefficient of bearing ``b``, and its error into the last of ``axes``."""
    rpm, values, (colour, marker) = to_rpm(identified.speeds), identified.coefficient(name)[b], look
    if not unknown:
        axes[0].plot(rpm, values, color=colour, ls="--", lw=1.5, label=f"{name} known, not identified")
        return
    stated = None if deviation is None else deviation[b, :, COEFFICIENTS.index(name)]
    if modelled is not None:
        true = modelled.coefficient(name)[b]
        axes[0].plot(rpm, true, color=colour, lw=1.5, label=f"{name} modelled")
        error = np.maximum(measure_relative_errors(identified, modelled, name)[b], 1e-14)
        axes[-1].semilogy(rpm, error, color=colour, lw=1.2)
        if stated is not None:
            axes[-1].semilogy(rpm, 196.0 * stated / np.abs(true), color=colour, lw=1.0, ls=":")
    draw_markers(axes[0], rpm, values, colour, f"{name} identified", marker)
    if stated is not None:
        draw_band(axes[0], rpm, values, stated, colour)


_LARGE_RATIO = 2.0
"""A loss that falls by less is read better on a linear axis."""


def draw_history(path: Path, history: Path, label: str) -> Path:
    """The loss, which ``label`` names, over the steps of training, on training and held-out speeds."""
    table = read_table(history, {"step": "number", "phase": "text", "loss": "number"})
    with open_figure(path, 1, 1, 7.5, 4.2) as axes:
        ax = axes[0, 0]
        ax.plot(table["step"], table["loss"], color=BLUE, label="training speeds")
        if "held_out_loss" in table:
            ax.plot(table["step"], table["held_out_loss"], color=ORANGE, ls="--", label="held-out speeds")
        if not table["loss"].max() <= _LARGE_RATIO * table["loss"].min():  # a loss that is no number has a large range
            ax.set_yscale("log")
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
        ax.legend()
    return path


def draw_robustness(
    path: Path,
    training: ResidualTraining,
    minimum: Minimum,
    over: str,
    rows: pd.DataFrame,
    modelled: BearingTable | None,
) -> Path:
    """Paper, Figure 2: the stiffnesses on their way from every guess; final errors over guesses or seeds."""
    unknowns = training.model.unknowns
    if not minimum.trajectory:
        return _draw_final_errors(path, rows, over)
    steps = np.array([step for step, _ in minimum.trajectory])
    model = training.model
    scale = model.scale_tensor()[:, 0]
    # (T, G, M, U)
    paths = np.stack([model.physical(state, scale)[0].detach().numpy() for _, state in minimum.trajectory])
    nodes = training.measurement.rotor.bearing_nodes
    members = paths.shape[2]
    with open_figure(path, members, len(unknowns), 5.2 * len(unknowns), 3.4 * members, sharex=True) as axes:
        for m in range(members):
            for u, name in enumerate(unknowns):
                ax = axes[m, u]
                ax.semilogy(steps, paths[:, :, m, u], color=BLUE, lw=0.7, alpha=0.6)
                where = f"bearing at node {nodes[m]}" if members == len(nodes) else "all bearings"
                ax.set_title(f"({ascii_lowercase[m * len(unknowns) + u]}) {name}, {where}")
                if modelled is not None:
                    ax.axhline(modelled.coefficient(name)[m, 0], color=ORANGE, lw=1.5, ls="--", label="modelled")
                ax.plot([], [], color=BLUE, lw=0.7, label=f"{len(minimum.outcomes)} initial guesses")
                ax.set_ylabel(f"{name} ({unit(name)})")
                ax.set_xlabel("training step" if m == members - 1 else "")
        axes[0, 0].legend(loc="lower right")
    return path


def _draw_final_errors(path: Path, rows: pd.DataFrame, over: str) -> Path:
    with open_figure(path, 1, 1, 8.0, 4.2) as axes:
        ax = axes[0, 0]
        has_truth = rows["mean_error_percent"].notna().all()
        quantity = "mean_error_percent" if has_truth else "loss"
        for i, ((node, name), group) in enumerate(rows.groupby(["bearing_node", "coefficient"], sort=False)):
            colour, marker = LOOKS[i % len(LOOKS)]
            look = {"color": colour, "marker": marker, "ms": 7, "mfc": colour if i < len(LOOKS) else "none"}
            ax.semilogy(group[over], group[quantity], ls="", label=f"node {node} {name}", **look)
        if over == "initial_guess":
            ax.set_xscale("log")
        ax.set_xlabel("seed" if over == "seed" else "initial guess of the stiffness (N/m)")
        ax.set_ylabel("mean error over speeds (%)" if has_truth else "loss (-)")
        ax.legend(loc="center left", bbox_to_anchor=(1.0, 0.5))
    return path


def draw_refits(path: Path, rows: pd.DataFrame) -> Path:
    """Above, the median error over speed of every data set; below, the share of speeds inside the 95 % interval."""
    groups = list(rows.groupby(["bearing_node", "coefficient"], sort=False))
    generator = np.random.default_rng(0)
    with open_figure(path, 2, 1, max(6.0, 0.75 * len(groups) + 2), 6.0, sharex=True) as axes:
        above, below = axes[:, 0]
        for i, (_, group) in enumerate(groups):
            errors, aside = group["median_error_percent"], i + generator.uniform(-0.25, 0.25, len(group))
            above.semilogy(aside, errors, ls="", marker="o", ms=3, color=BLUE, alpha=0.5)
            above.semilogy(i, errors.median(), ls="", marker="_", ms=18, mew=2, color=ORANGE)
            below.plot(i, group["within_95_percent_interval"].mean(), ls="", marker="s", ms=7, color=BLUE)
        below.axhspan(90, 98, color=GREY, alpha=0.15, lw=0)
        below.axhline(95, color=GREY, lw=1.0, ls="--")
        above.set_ylabel("median error over speed (%)\none dot a data set")
        below.set(ylim=(80, 100), ylabel="inside the nominal\n95 % interval (%)")
        below.set_xticks(range(len(groups)), [f"{name}\nnode {node}" for (node, name), _ in groups])
    return path
