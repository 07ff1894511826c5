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
    with open_figure(path, 1, 1, 7.0, 1.2 + 0.35 * len(names)) as axes:
        ax = axes[0, 0]
        ax.barh(names, [100 * importances[name] for name in names], color=BLUE)
        ax.set_xlabel("importance: what sets the best trials apart (%)")
        ax.grid(axis="y", visible=False)
    return path


def _list_names(trials: Sequence[TrialSummary], space: Mapping[str, Dimension], least: float) -> list[str]:
    """The parameters that at least ``least`` trials have."""
    return [name for name in space if sum(name in trial.parameters for trial in trials) >= least]


def _draw_slices(path: Path, trials: Sequence[TrialSummary], space: Mapping[str, Dimension]) -> Path:
    """The loss over each parameter; later trials are darker."""
    names = _list_names(trials, space, 1)
    columns = min(4, len(names))
    rows = math.ceil(len(names) / columns)
    last = max(trial.number for trial in trials) or 1
    with open_figure(path, rows, columns, 3.1 * columns, 2.6 * rows, sharey=True) as axes:
        for ax in axes.flat[len(names) :]:
            ax.set_axis_off()
        for ax, name in zip(axes.flat, names, strict=False):
            choices = _list_choices(space[name])
            for state, (_, marker) in _STATES.items():
                some = [t for t in trials if name in t.parameters and t.state == state]
                x = [choices.index(str(t.parameters[name])) if choices else t.parameters[name] for t in some]
                look = {"marker": marker, "s": 22, "cmap": "viridis_r", "vmin": 0, "vmax": last}
                ax.scatter(x, [t.loss for t in some], c=[t.number for t in some], **look)
            ax.set(xlabel=name.replace("_", " "), yscale="log")
            _set_ticks(ax, choices, getattr(space[name], "log", False))
        for ax in axes[:, 0]:
            ax.set_ylabel("held-out loss")
        title = "dots: complete, crosses: pruned; darker: later trials"
        axes.flat[0].figure.suptitle(title, fontsize=9, x=0.01, ha="left")
    return path


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
    """A line a trial through the parameters that half of the trials have, coloured by its loss."""
    names = _list_names(trials, space, len(trials) / 2)
    trials = sorted(trials, key=lambda trial: -(trial.loss or math.nan))  # the best lie above the others
    losses = np.log10([trial.loss or math.nan for trial in trials])
    with open_figure(path, 1, 1, min(1.25 * len(names) + 2.5, 15.0), 4.6) as axes:
        ax, heights = axes[0, 0], np.empty((len(trials), len(names)))
        for x, name in enumerate(names):
            heights[:, x], captions = _scale_values([t.parameters.get(name) for t in trials], space[name])
            ax.axvline(x, color=GREY, lw=0.6)
            look: dict[str, Any] = {"xytext": (4, 0), "textcoords": "offset points", "fontsize": 7, "va": "center"}
            for caption, height in captions.items():
                box = {"facecolor": "white", "alpha": 0.7, "lw": 0, "pad": 0.5}
                ax.annotate(caption.replace("_", " "), (x, height), bbox=box, **look)
        places = np.broadcast_to(np.arange(len(names)), heights.shape)
        points = ax.scatter(places, heights, c=np.broadcast_to(losses[:, None], heights.shape), s=4, cmap="viridis")
        for line, colour in zip(heights, points.to_rgba(losses), strict=True):
            ax.plot(line, color=colour, lw=1.3, alpha=0.8)
        ax.set_xticks(range(len(names)), [name.replace("_", "\n") for name in names], fontsize=8)
        ax.set(yticks=[], ylim=(-0.08, 1.08), xlim=(-0.2, len(names) - 0.3))
        ax.grid(visible=False)
        ax.figure.colorbar(points, ax=ax, label="log10 of the held-out loss", pad=0.01)
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
