"""Training: its loss over the steps, and answers from other guesses, seeds and data sets, or of a multirun's jobs; in
figures and on screen."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from string import ascii_lowercase
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.coefficients import unit
from pipeline.data.tables import read_table, write_table
from pipeline.errors import DataError
from pipeline.files import read_json
from pipeline.reporting.blocks import BLUE, GREY, LOOKS, ORANGE, Axes, Curve, Figure, Panel, shade
from pipeline.reporting.console import say, table
from pipeline.reporting.matplotlib_figures import write_figure, write_panel
from pipeline.rotor.bearing_table import BearingTable
from pipeline.write_numbers import write_number, write_rough, write_value

if TYPE_CHECKING:
    import pandas as pd
    import torch

    from pipeline.identification.residual_loss import ResidualTraining


def draw_history(path: Path, history: Path, label: str, large_ratio: float = 2.0) -> Path:
    """The loss, which ``label`` names, over the steps of training, on training and held-out speeds.

    A loss that falls by less than ``large_ratio`` is read better on a linear axis.
    """
    table = read_table(history, {"step": "number", "phase": "text", "loss": "number"})
    step, loss, phase = table["step"], table["loss"], table["phase"]
    curves = [
        Curve(step, table[column], label, colour, dash)
        for column, label, colour, dash in (
            ("loss", "training speeds", BLUE, "solid"),
            ("held_out_loss", "held-out speeds", ORANGE, "dash"),
        )
        if column in table
    ]
    rules = [(step[phase == name][0], str(name).replace("_", "-")) for name in dict.fromkeys(phase) if name != "start"]
    linear = loss.max() <= large_ratio * loss.min()  # false of a loss that is no number, which has a large range
    return write_panel(
        path, Panel("", "training step", [Axes(curves, label, scale="linear" if linear else "log", rules=rules)])
    )


def draw_robustness(
    path: Path,
    training: ResidualTraining,
    trajectory: Sequence[torch.Tensor],
    over: str,
    rows: pd.DataFrame,
    modelled: BearingTable | None,
) -> Path:
    """Paper, Figure 2: the stiffnesses on their way from every guess; final errors over guesses or seeds.

    ``trajectory`` has the parameters (G, M, Q) of every step; none where that is not to be shown.
    """
    if not trajectory:
        return _draw_final_errors(path, rows, over)
    model, nodes = training.problem.model, training.measurement.rotor.bearing_nodes
    steps = np.arange(len(trajectory))
    scale = model.scale_tensor()[:, 0]
    # (T, G, M, U)
    paths = np.stack([model.physical(state, scale)[0].detach().numpy() for state in trajectory])
    guesses, members = paths.shape[1:3]
    panels: list[Panel] = []
    for m in range(members):
        where = f"bearing at node {nodes[m]}" if members == len(nodes) else "all bearings"
        for u, name in enumerate(model.unknowns):
            label = f"{guesses} initial guesses"
            curves = [Curve(steps, paths[:, g, m, u], label, width=0.9, alpha=0.6) for g in range(guesses)]
            if modelled is not None:
                true = np.full(2, modelled.coefficient(name)[m, 0])
                curves.append(Curve(steps[[0, -1]], true, "modelled", ORANGE, "dash", width=2.0))
            panels.append(
                Panel(
                    f"({ascii_lowercase[len(panels)]}) {name}, {where}",
                    "training step",
                    [Axes(curves, f"{name} ({unit(name)})", scale="log")],
                )
            )
    return write_figure(path, Figure("robustness", "", panels, columns=len(model.unknowns)))


def _draw_final_errors(path: Path, rows: pd.DataFrame, over: str) -> Path:
    """A marker a guess or seed, bearing and coefficient; open ones where colours repeat."""
    has_truth = rows["mean_error_percent"].notna().all()
    quantity, label = ("mean_error_percent", "mean error over speeds (%)") if has_truth else ("loss", "loss (-)")
    curves = []
    for i, ((node, name), group) in enumerate(rows.groupby(["bearing_node", "coefficient"], sort=False)):
        x, y, look = group[over].to_numpy(), group[quantity].to_numpy(), LOOKS[i % len(LOOKS)]
        curves.append(Curve(x, y, f"node {node} {name}", look[0], "none", look[1], size=6, full=i < len(LOOKS)))
    return write_panel(
        path,
        Panel(
            "",
            "seed" if over == "seed" else "initial guess of the stiffness (N/m)",
            [Axes(curves, label, scale="log")],
            log_x=over == "initial_guess",
        ),
    )


def draw_refits(path: Path, rows: pd.DataFrame) -> Path:
    """Above, the median error over speed of every data set; below, the share of speeds inside the 95 % interval."""
    groups = list(rows.groupby(["bearing_node", "coefficient"], sort=False))
    generator, places = np.random.default_rng(0), np.arange(len(groups))
    errors = [group["median_error_percent"].to_numpy() for _, group in groups]
    aside = [i + generator.uniform(-0.25, 0.25, len(group)) for i, group in enumerate(errors)]
    medians = np.array([np.median(group) for group in errors])
    dots = Curve(np.concatenate(aside), np.concatenate(errors), "data set", BLUE, "none", "o", size=3, alpha=0.5)
    inside = np.array([group["within_95_percent_interval"].mean() for _, group in groups])
    ends = np.array([-0.5, len(groups) - 0.5])
    return write_panel(
        path,
        Panel(
            "",
            "",
            [
                Axes(
                    [dots, Curve(places, medians, "median", ORANGE, "none", "_", size=14)],
                    "median error over speed (%)",
                    scale="log",
                ),
                Axes(
                    [
                        shade(ends, np.full(2, 90.0), np.full(2, 98.0), GREY),
                        Curve(ends, np.full(2, 95.0), "", GREY, "dash", width=1.3),
                        Curve(places, inside, "", BLUE, "none", "s", size=6, full=True),
                    ],
                    "inside the nominal\n95 % interval (%)",
                    y_range=(80, 100),
                ),
            ],
            x_names=[f"{name}\nnode {node}" for (node, name), _ in groups],
            wide=True,
        ),
    )


def print_starts(name: str, over: str, summary: Mapping[str, Any], seconds: float) -> None:
    """The outcomes of all starts, and the worst and the median error of each coefficient."""
    outcomes = ", ".join(f"{count} {label.replace('_', ' ')}" for label, count in summary["outcomes"].items())
    varied = {"seed": "seeds", "initial_guess": "initial guesses"}[over]
    say(f"{name}: {summary['starts']} {varied} trained at once in {seconds:.1f} s ({outcomes})")
    table(
        f"{name}: mean error % over all {varied}",
        ["bearing and coefficient", "worst", "median"],
        [
            [
                f"node {node} {coefficient}",
                write_rough(values["worst_mean_error_percent"]),
                write_rough(values["median_mean_error_percent"]),
            ]
            for node, entry in summary["coefficients"].items()
            for coefficient, values in entry.items()
        ],
    )


def print_refits(name: str, summary: Mapping[str, Any]) -> None:
    """Error, bound and coverage of each coefficient over the data sets, and of the numbers of bearing laws."""
    table(
        f"{name}: {summary['data_sets']} measurements of the machine, each identified by itself",
        [
            "bearing and coefficient",
            "median error %, typical",
            "worst data set",
            "standard deviation by the bound, %",
            "error over bound",
            "inside the 95 % interval, %",
        ],
        [
            [
                f"node {node} {coefficient}",
                write_number(measures["median_error_percent"], digits=3),
                write_number(measures["worst_median_error_percent"], digits=3),
                write_number(measures["median_bound_percent"], digits=3),
                f"{measures['rmse_over_bound']:.2f}",
                f"{measures['within_95_percent_interval']:.1f}",
            ]
            for node, coefficients in summary["coefficients"].items()
            for coefficient, measures in coefficients.items()
        ],
    )
    say(
        f"all coefficients: median error {write_number(summary['median_error_percent'], digits=3)} %, "
        f"{summary['within_95_percent_interval']:.1f} % inside the 95 % interval; the model is rejected in "
        f"{summary['rejected_percent']:.0f} % of the data sets"
    )
    for state, bearings in summary.get("unmeasured", {}).items():
        worst = max(entry["median_error_percent"] for names in bearings.values() for entry in names.values())
        typical = summary["all_unmeasured"][state]["median_error_percent"]
        say(
            f"at {state}, which no run has: median error {write_number(typical, digits=3)} %, "
            f"of the worst coefficient {write_number(worst, digits=3)} %"
        )
    for number, error in summary.get("numbers", {}).items():
        say(
            f"{number}: error {write_number(error['median_error_percent'], digits=3)} %, typically, "
            f"{write_number(error['worst_error_percent'], digits=3)} % at worst; "
            f"{error['within_95_percent_interval']:.0f} % inside the 95 % interval"
        )


# --- the jobs of a multirun, side by side -------------------------------------------------------------

_COLUMNS = ("outcome", "steps", "loss", "held_out_loss", "worst_mean_error_percent")


def compare_jobs(jobs: Mapping[str, str], since: float) -> None:
    """Print a table of the jobs, and write ``jobs.csv`` and ``jobs.png`` in the folder that they share.

    :param jobs: what is the job's own -> its folder
    :param since: a training is of this multirun if it was written after it (seconds since 1970)

    Nothing where fewer than two jobs have a training.
    """
    summaries = {job: _read_job(Path(folder), since) for job, folder in jobs.items()}
    if sum("outcome" in job_summary for job_summary in summaries.values()) < 2:
        return
    shown = [name for name in _COLUMNS if any(name in job_summary for job_summary in summaries.values())]
    rows = [
        [job, *(write_value(job_summary.get(name, "-")) for name in shown)] for job, job_summary in summaries.items()
    ]
    table("the jobs of this command", ["job", *(name.replace("_", " ") for name in shown)], rows)
    folder = Path(os.path.commonpath(list(jobs.values())))
    columns = {
        "job": list(summaries),
        "folder": list(jobs.values()),
        **{name: [job_summary.get(name) for job_summary in summaries.values()] for name in shown},
    }
    written = [write_table(folder / "jobs.csv", columns), _draw_jobs(folder / "jobs.png", summaries)]
    say(f"side by side in '{written[0]}' and '{written[1]}'")


def _read_job(folder: Path, since: float) -> dict[str, Any]:
    """What a job's files say; empty where it has no training of this multirun."""
    path = folder / "training.json"
    if not path.exists() or path.stat().st_mtime < since:
        return {}
    job: dict[str, Any] = {}
    with suppress(DataError):
        training = read_json(path)
        job = {name: training[name] for name in _COLUMNS if training.get(name) is not None}
    metrics = folder / "metrics.json"
    if metrics.exists() and metrics.stat().st_mtime >= since:
        with suppress(DataError, KeyError, ValueError, AttributeError):
            bearings = read_json(metrics)["coefficients"].values()
            job["worst_mean_error_percent"] = max(c["mean_error_percent"] for node in bearings for c in node.values())
    return job


_DRAWN = {
    "held_out_loss": ("loss on held-out speeds", BLUE),
    "loss": ("loss", BLUE),
    "worst_mean_error_percent": ("largest mean error, %", ORANGE),
}


def _draw_jobs(path: Path, jobs: Mapping[str, Mapping[str, Any]]) -> Path:
    """What each job of a multirun came to: a row a job, a panel for its loss and its error.

    The loss is that of held-out speeds where there are some.
    """
    # What is no positive number has no place on a logarithmic axis.
    values = {
        name: np.array([v if isinstance(v := job.get(name), float) and v > 0 else np.nan for job in jobs.values()])
        for name in _DRAWN
    }
    names = [name for name in _DRAWN if np.isfinite(values[name]).any()]
    names = [name for name in names if name != "loss" or "held_out_loss" not in names] or ["loss"]
    panels = [
        Panel(
            "",
            _DRAWN[name][0],
            [
                Axes(
                    [Curve(values[name], np.arange(len(jobs)), "", _DRAWN[name][1], "none", "o", full=True)],
                    "",
                    y_names=list(jobs) if name == names[0] else [""] * len(jobs),
                )
            ],
            log_x=bool(np.isfinite(values[name]).any()),
        )
        for name in names
    ]
    return write_figure(path, Figure("jobs", "", panels, columns=len(panels)))
