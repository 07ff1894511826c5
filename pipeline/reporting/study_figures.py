"""Figures of a hyperparameter study: history, learning curves, importance, slices, parallel coordinates, finalists."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.config.tuning import Dimension, Value
from pipeline.reporting.figures import BLUE, GREEN, GREY, ORANGE, PURPLE, open_figure, place_legend
from pipeline.tuning.finalists import Finalist, TrialSummary

_STATES = {"complete": (BLUE, "o"), "pruned": (ORANGE, "x"), "failed": (PURPLE, "s")}
_LOSS = "held-out loss (over the bearing force, or the noise)"


def draw_study(
    folder: Path,
    trials: Sequence[TrialSummary],
    space: Mapping[str, Dimension],
    importances: Mapping[str, float],
    finalists: Sequence[Finalist],
) -> list[Path]:
    """Draw all figures of a study into ``folder``, except those that need more trials than there are."""
    done = [trial for trial in trials if trial.loss is not None]
    written = [_draw_finalists(folder / "finalists.png", finalists)]
    if done:
        written += [_draw_history(folder / "history.png", trials), _draw_slices(folder / "slice.png", done, space)]
        written.append(_draw_parallel(folder / "parallel_coordinates.png", done, space))
    if any(trial.curve for trial in trials):
        written.append(_draw_curves(folder / "learning_curves.png", trials))
    if importances:
        written.append(_draw_importance(folder / "importance.png", importances))
    return written


def _draw_history(path: Path, trials: Sequence[TrialSummary]) -> Path:
    with open_figure(path, 1, 1, 8.0, 4.4) as axes:
        ax = axes[0, 0]
        for state, (colour, marker) in _STATES.items():
            losses = {t.number: t.loss for t in trials if t.state == state and t.loss is not None}
            if losses:
                ax.semilogy(list(losses), list(losses.values()), marker, color=colour, label=state)
            bare = [t.number for t in trials if t.state == state and t.loss is None]
            if bare:  # a mark on the axis
                look = {"color": colour, "mfc": "none", "label": f"{state}, no loss"}
                ax.plot(bare, [0.02] * len(bare), marker, transform=ax.get_xaxis_transform(), **look)
        complete = {t.number: t.loss for t in trials if t.state == "complete" and t.loss is not None}
        if complete:
            best = np.minimum.accumulate(list(complete.values()))
            ax.step(list(complete), best, where="post", color=GREY, lw=1.2, label="best so far")
        ax.set(xlabel="trial (0 is the configured default)", ylabel=_LOSS)
        place_legend(ax)
    return path


def _draw_curves(path: Path, trials: Sequence[TrialSummary]) -> Path:
    with open_figure(path, 1, 1, 8.0, 4.4) as axes:
        ax, named = axes[0, 0], set()
        for trial in sorted((t for t in trials if t.curve), key=lambda t: t.number == 0):
            colour, width, alpha, label = _STATES.get(trial.state, (GREY,))[0], 0.9, 0.7, trial.state
            if trial.number == 0:
                colour, width, alpha, label = GREEN, 2.2, 1.0, "the configured default"
            look = {"color": colour, "lw": width, "alpha": alpha, "label": None if label in named else label}
            ax.semilogy(list(trial.curve), list(trial.curve.values()), marker=".", ms=4, **look)
            named.add(label)
        ax.set(xlabel="part of the last optimiser's epochs (%)", ylabel=_LOSS)
        place_legend(ax)
    return path


def _draw_importance(path: Path, importances: Mapping[str, float]) -> Path:
    names = [name for name, share in importances.items() if share > 0.005][::-1]
    with open_figure(path, 1, 1, 7.5, 1.5 + 0.38 * len(names)) as axes:
        ax = axes[0, 0]
        bars = ax.barh([name.replace("_", " ") for name in names], [100 * importances[n] for n in names], color=BLUE)
        ax.bar_label(bars, fmt="%.0f %%", padding=3, fontsize=9)
        ax.set_title("what sets the best trials of the study apart from the others", fontsize=10, loc="left")
        ax.set_xlabel("importance (%); parameters below 0.5 % are left out")
        ax.margins(x=0.1)
        ax.grid(axis="y", visible=False)
    return path


def _list_names(trials: Sequence[TrialSummary], space: Mapping[str, Dimension], least: float) -> list[str]:
    """The parameters that at least ``least`` trials have."""
    return [name for name in space if sum(name in trial.parameters for trial in trials) >= least]


def _draw_slices(path: Path, trials: Sequence[TrialSummary], space: Mapping[str, Dimension]) -> Path:
    """The loss over each parameter; the default and the best trial stand out."""
    names = _list_names(trials, space, 1)
    columns = min(4, len(names))
    rows = math.ceil(len(names) / columns)
    best = min((t for t in trials if t.state == "complete"), key=lambda t: t.loss or math.inf, default=None)
    generator = np.random.default_rng(0)
    with open_figure(path, rows, columns, 3.1 * columns, 0.5 + 2.6 * rows, sharey=True) as axes:
        for ax in axes.flat[len(names) :]:
            ax.set_axis_off()
        for ax, name in zip(axes.flat, names, strict=False):
            choices = _list_choices(space[name])
            having = [t for t in trials if name in t.parameters]
            aside = generator.uniform(-0.22, 0.22, len(having)) if choices else np.zeros(len(having))
            places = [choices.index(str(t.parameters[name])) if choices else t.parameters[name] for t in having]
            for trial, place, shift in zip(having, places, aside, strict=True):
                look = _choose_mark(trial, best)
                ax.plot(float(place) + shift, trial.loss, ls="", clip_on=False, **look)
            ax.set(xlabel=name.replace("_", " "), yscale="log")
            _set_ticks(ax, choices, getattr(space[name], "log", False))
        for ax in axes[:, 0]:
            ax.set_ylabel("held-out loss")
        handles = {line.get_label(): line for ax in axes.flat for line in ax.lines}
        axes[0, 0].figure.legend(handles.values(), handles.keys(), loc="outside upper left", ncols=4)
    return path


def _choose_mark(trial: TrialSummary, best: TrialSummary | None) -> dict[str, Any]:
    if trial.number == 0:
        return {"marker": "D", "ms": 7, "color": GREEN, "zorder": 4, "label": "the configured default"}
    if trial is best:
        return {"marker": "*", "ms": 13, "color": PURPLE, "zorder": 5, "label": "the best trial"}
    colour, marker = _STATES[trial.state]
    return {"marker": marker, "ms": 5, "mfc": "none", "color": colour, "label": trial.state}


def _list_choices(dimension: Dimension) -> list[str]:
    """The values of a choice as texts; none for a range."""
    return [str(value) for value in dimension.options() or ()]


def _set_ticks(ax: Any, choices: Sequence[str], log: bool) -> None:
    from matplotlib.ticker import LogLocator, NullFormatter, StrMethodFormatter

    if choices:
        ax.set_xticks(range(len(choices)), [name.replace("_", "\n") for name in choices], fontsize=8)
        ax.set_xlim(-0.6, len(choices) - 0.4)
    elif log:
        ax.set_xscale("log")
        low, high = ax.get_xlim()
        ax.xaxis.set_major_locator(LogLocator(subs=(1.0,) if high > 30 * low else (1.0, 2.0, 5.0)))
        ax.xaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
        ax.xaxis.set_minor_formatter(NullFormatter())


def _draw_parallel(path: Path, trials: Sequence[TrialSummary], space: Mapping[str, Dimension]) -> Path:
    """A line a trial through the parameters that half of the trials have; the best tenth and the default stand out."""
    names = _list_names(trials, space, len(trials) / 2)
    trials = sorted(trials, key=lambda trial: -(trial.loss or math.nan))  # the best lie above the others
    few = max(1, len(trials) // 10)
    with open_figure(path, 1, 1, min(1.35 * len(names) + 2.0, 16.0), 5.0) as axes:
        ax, heights = axes[0, 0], np.empty((len(trials), len(names)))
        for x, name in enumerate(names):
            heights[:, x], captions = _scale_values([t.parameters.get(name) for t in trials], space[name])
            ax.axvline(x, color=GREY, lw=0.8, zorder=1)
            look: dict[str, Any] = {"xytext": (4, 0), "textcoords": "offset points", "fontsize": 8, "va": "center"}
            for caption, height in captions.items():
                box = {"facecolor": "white", "alpha": 0.85, "lw": 0, "pad": 0.8}
                ax.annotate(caption.replace("_", " "), (x, height), bbox=box, zorder=6, **look)
        for i, (trial, line) in enumerate(zip(trials, heights, strict=True)):
            style = {"color": GREY, "lw": 0.6, "alpha": 0.35, "zorder": 2, "label": "the other trials"}
            if i >= len(trials) - few:
                style = {"color": BLUE, "lw": 1.8, "alpha": 0.9, "zorder": 4, "label": "the best tenth"}
            if trial.number == 0:
                style = {"color": GREEN, "lw": 2.4, "ls": "--", "zorder": 5, "label": "the configured default"}
            ax.plot(line, marker=".", ms=5, **style)
        handles = {line.get_label(): line for line in ax.lines if not str(line.get_label()).startswith("_")}
        ax.figure.legend(handles.values(), handles.keys(), loc="outside upper left", ncols=3)
        ax.set_xticks(range(len(names)), [name.replace("_", "\n") for name in names], fontsize=9)
        ax.set(yticks=[], ylim=(-0.08, 1.08), xlim=(-0.2, len(names) - 0.3))
        ax.grid(visible=False)
    return path


def _scale_values(values: Sequence[Value | None], dimension: Dimension) -> tuple[np.ndarray, dict[str, float]]:
    """(trials,) 0 to 1 on the axis of a parameter, NaN where a trial lacks it; and the captions with their heights."""
    if choices := _list_choices(dimension):
        captions = {name: i / max(len(choices) - 1, 1) for i, name in enumerate(choices)}
        return np.array([captions.get(str(value), math.nan) for value in values]), captions
    numbers = np.array([math.nan if value is None else float(value) for value in values])
    scaled = np.log(numbers) if getattr(dimension, "log", False) else numbers
    low, high = np.nanmin(scaled), np.nanmax(scaled)
    if low == high:
        return np.where(np.isnan(scaled), math.nan, 0.5), {f"{np.nanmin(numbers):.3g}": 0.5}
    return (scaled - low) / (high - low), {f"{np.nanmin(numbers):.3g}": 0.0, f"{np.nanmax(numbers):.3g}": 1.0}


def _draw_finalists(path: Path, finalists: Sequence[Finalist]) -> Path:
    """Every seed of the default and of the finalists: whether a difference is more than luck."""
    with open_figure(path, 1, 1, 6.5, 4.0) as axes:
        ax = axes[0, 0]
        for x, finalist in enumerate(finalists):
            losses = finalist.losses[np.isfinite(finalist.losses)]
            ax.semilogy(x + np.linspace(-0.12, 0.12, len(losses)), losses, "o", color=GREEN if x == 0 else BLUE, ms=5)
            if np.isfinite(finalist.median):
                ax.hlines(finalist.median, x - 0.25, x + 0.25, color=GREY, lw=2, label="median" if x == 0 else None)
        names = ["default" if f.trial == 0 else f"trial {f.trial}" for f in finalists]
        ax.set_xticks(range(len(names)), names)
        ax.set(ylabel=_LOSS, xlabel="one dot a seed", xlim=(-0.6, len(names) - 0.4))
        place_legend(ax)
    return path


def draw_samplers(path: Path, best: Mapping[str, np.ndarray]) -> Path:
    """Best loss so far over the trials: the median of a sampler's studies, and their range."""
    with open_figure(path, 1, 1, 8.0, 4.4) as axes:
        ax = axes[0, 0]
        for (name, losses), colour in zip(best.items(), (BLUE, ORANGE, GREEN), strict=False):
            trials = 1 + np.arange(losses.shape[1])
            ax.fill_between(trials, losses.min(axis=0), losses.max(axis=0), color=colour, alpha=0.15, lw=0)
            ax.semilogy(trials, np.median(losses, axis=0), color=colour, lw=1.8, label=name)
        ax.set(xlabel="trial", ylabel=f"best {_LOSS}", yscale="log")
        place_legend(ax)
    return path
