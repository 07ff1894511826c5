"""Figures of a hyperparameter study: history, learning curves, importance, slices, parallel coordinates, finalists."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.reporting.figures import BLUE, GREEN, GREY, ORANGE, PURPLE, figure, legend_above
from pipeline.tuning.review import Finalist, TrialAccount

_STATES = {"complete": (BLUE, "o"), "pruned": (ORANGE, "x"), "failed": (PURPLE, "s")}
_LOSS = "held-out loss (share of the bearing force)"
_COLOURS = "viridis_r"


def study_figures(
    folder: Path, trials: Sequence[TrialAccount], importances: Mapping[str, float], finalists: Sequence[Finalist]
) -> list[Path]:
    """All figures of a study in ``folder``; those that need more trials than there are, are left out."""
    done = [trial for trial in trials if trial.loss is not None]
    written = [_finalists(folder / "finalists.png", finalists)]
    if done:
        written += [_history(folder / "history.png", trials), _slices(folder / "slice.png", done)]
        written.append(_parallel(folder / "parallel_coordinates.png", done))
    if any(trial.curve for trial in trials):
        written.append(_curves(folder / "learning_curves.png", trials))
    if importances:
        written.append(_importance(folder / "importance.png", importances))
    return written


def _history(path: Path, trials: Sequence[TrialAccount]) -> Path:
    with figure(path, 1, 1, 8.0, 4.4) as axes:
        ax = axes[0, 0]
        for state, (colour, marker) in _STATES.items():
            some = [t for t in trials if t.state == state]
            drawn = [t for t in some if t.loss is not None]
            if drawn:
                ax.semilogy([t.number for t in drawn], [t.loss for t in drawn], marker, color=colour, label=state)
            if len(some) > len(drawn):  # without a loss: a mark on the axis
                bare = [t.number for t in some if t.loss is None]
                ax.plot(
                    bare,
                    [0.02] * len(bare),
                    marker,
                    color=colour,
                    label=f"{state}, no loss",
                    mfc="none",
                    transform=ax.get_xaxis_transform(),
                )
        complete = [t for t in trials if t.state == "complete" and t.loss is not None]
        if complete:
            best = np.minimum.accumulate([float(t.loss or 0.0) for t in complete])
            ax.step([t.number for t in complete], best, where="post", color=GREY, lw=1.2, label="best so far")
        ax.set(xlabel="trial (0 is the configured default)", ylabel=_LOSS)
        legend_above(ax)
    return path


def _curves(path: Path, trials: Sequence[TrialAccount]) -> Path:
    with figure(path, 1, 1, 8.0, 4.4) as axes:
        ax = axes[0, 0]
        named = set()
        for trial in sorted(trials, key=lambda t: t.number == 0):
            if not trial.curve:
                continue
            default = trial.number == 0
            colour = GREEN if default else _STATES.get(trial.state, (GREY, ""))[0]
            label = "the configured default" if default else trial.state
            ax.semilogy(
                list(trial.curve),
                list(trial.curve.values()),
                color=colour,
                lw=2.2 if default else 0.9,
                alpha=1.0 if default else 0.7,
                label=None if label in named else label,
                marker=".",
                ms=4,
            )
            named.add(label)
        ax.set(xlabel="part of the last optimiser's epochs (%)", ylabel=_LOSS)
        legend_above(ax)
    return path


def _importance(path: Path, importances: Mapping[str, float]) -> Path:
    names = list(importances)[::-1]
    with figure(path, 1, 1, 7.0, 1.2 + 0.35 * len(names)) as axes:
        ax = axes[0, 0]
        ax.barh(names, [100 * importances[name] for name in names], color=BLUE)
        ax.set_xlabel("importance for the logarithm of the held-out loss (%)")
        ax.grid(axis="y", visible=False)
    return path


def _parameters(trials: Sequence[TrialAccount]) -> list[str]:
    return list(dict.fromkeys(name for trial in trials for name in trial.parameters))


def _slices(path: Path, trials: Sequence[TrialAccount]) -> Path:
    """The loss over each parameter; later trials are darker."""
    names = _parameters(trials)
    columns = min(4, len(names))
    rows = math.ceil(len(names) / columns)
    last = max(trial.number for trial in trials) or 1
    with figure(path, rows, columns, 3.1 * columns, 2.6 * rows, sharey=True) as axes:
        for ax in axes.flat[len(names) :]:
            ax.set_axis_off()
        for ax, name in zip(axes.flat, names, strict=False):
            some = [t for t in trials if name in t.parameters]
            positions, ticks, log = _positions([t.parameters[name] for t in some])
            for state, (_, marker) in _STATES.items():
                at = [i for i, t in enumerate(some) if t.state == state]
                ax.scatter(
                    [positions[i] for i in at],
                    [some[i].loss for i in at],
                    marker=marker,
                    s=22,
                    c=[some[i].number for i in at],
                    cmap=_COLOURS,
                    vmin=0,
                    vmax=last,
                )
            ax.set(xlabel=name.replace("_", " "), yscale="log")
            if ticks:
                ax.set_xticks(
                    range(len(ticks)),
                    ticks,
                    rotation=20 if len(ticks) > 2 else 0,
                    ha="right" if len(ticks) > 2 else "center",
                )
                ax.set_xlim(-0.6, len(ticks) - 0.4)
            elif log:
                ax.set_xscale("log")
        for ax in axes[:, 0]:
            ax.set_ylabel("held-out loss")
        axes.flat[0].figure.suptitle(
            "dots: complete, crosses: pruned; darker: later trials", fontsize=9, x=0.01, ha="left"
        )
    return path


def _positions(values: Sequence[Any]) -> tuple[list[float], list[str], bool]:
    """Numbers as they are, choices by their place; the names of the choices; whether a logarithmic axis suits."""
    if all(isinstance(v, (int, float)) and not isinstance(v, bool) for v in values) and len(set(values)) > 3:
        return [float(v) for v in values], [], min(values) > 0 and max(values) > 8 * min(values)
    names = sorted({str(v) for v in values})
    return [float(names.index(str(v))) for v in values], [name.replace("_", "\n") for name in names], False


def _parallel(path: Path, trials: Sequence[TrialAccount]) -> Path:
    """A line a trial through its parameters, coloured by loss; parameters that a trial lacks break its line."""
    names = _parameters(trials)
    losses = np.log10([trial.loss for trial in trials if trial.loss is not None])
    low, high = float(losses.min()), float(losses.max())
    with figure(path, 1, 1, 1.6 * len(names) + 3.0, 5.2) as axes:
        ax = axes[0, 0]
        from matplotlib import colormaps
        from matplotlib.cm import ScalarMappable
        from matplotlib.colors import Normalize

        heights, captions = {}, {}
        for name in names:
            values = [t.parameters[name] for t in trials if name in t.parameters]
            heights[name], captions[name] = _heights(values)
        norm = Normalize(low, high if high > low else low + 1)
        for trial, loss in sorted(zip(trials, losses, strict=True), key=lambda pair: -pair[1]):
            y = [heights[n](trial.parameters[n]) if n in trial.parameters else math.nan for n in names]
            ax.plot(range(len(names)), y, color=colormaps["viridis"](norm(loss)), lw=1.3, alpha=0.8, marker=".", ms=4)
        for x, name in enumerate(names):
            ax.axvline(x, color=GREY, lw=0.6)
            for height, caption in captions[name]:
                ax.annotate(
                    caption,
                    (x, height),
                    xytext=(4, 0),
                    textcoords="offset points",
                    fontsize=8,
                    va="center",
                    bbox={"facecolor": "white", "alpha": 0.7, "lw": 0, "pad": 0.5},
                )
        ax.set_xticks(range(len(names)), [n.replace("_", "\n") for n in names], fontsize=8)
        ax.set(yticks=[], ylim=(-0.08, 1.08), xlim=(-0.2, len(names) - 0.4))
        ax.grid(visible=False)
        ax.figure.colorbar(ScalarMappable(norm, "viridis"), ax=ax, label="log10 of the held-out loss", pad=0.01)
    return path


def _heights(values: Sequence[Any]) -> tuple[Any, list[tuple[float, str]]]:
    """A function from a value to its height on the axis of a parameter, and the axis' captions."""
    positions, names, log = _positions(values)
    if names:
        known = sorted({str(v) for v in values})
        step = max(len(known) - 1, 1)
        captions = [(i / step, name.replace("_", " ")) for i, name in enumerate(known)]
        return lambda value: known.index(str(value)) / step, captions
    scale = np.log if log else np.asarray
    low, high = float(scale(min(positions))), float(scale(max(positions)))
    captions = [(0.0, f"{min(positions):.3g}"), (1.0, f"{max(positions):.3g}")]
    return lambda value: (float(scale(value)) - low) / ((high - low) or 1.0), captions


def _finalists(path: Path, finalists: Sequence[Finalist]) -> Path:
    """Every seed of the default and of the finalists: whether a difference is more than luck."""
    with figure(path, 1, 1, 6.5, 4.0) as axes:
        ax = axes[0, 0]
        for x, finalist in enumerate(finalists):
            losses = finalist.losses[np.isfinite(finalist.losses)]
            ax.semilogy(x + np.linspace(-0.12, 0.12, len(losses)), losses, "o", color=GREEN if x == 0 else BLUE, ms=5)
            if np.isfinite(finalist.median):
                ax.hlines(finalist.median, x - 0.25, x + 0.25, color=GREY, lw=2, label="median" if x == 0 else None)
        names = ["default" if f.trial == 0 else f"trial {f.trial}" for f in finalists]
        ax.set_xticks(range(len(names)), names)
        ax.set(ylabel=_LOSS, xlabel="one dot a seed", xlim=(-0.6, len(names) - 0.4))
        legend_above(ax)
    return path


def samplers_figure(path: Path, best: Mapping[str, np.ndarray]) -> Path:
    """Best loss so far over the trials: the median of a sampler's studies, and their range."""
    with figure(path, 1, 1, 8.0, 4.4) as axes:
        ax = axes[0, 0]
        for (name, losses), colour in zip(best.items(), (BLUE, ORANGE, GREEN), strict=False):
            trials = np.arange(losses.shape[1])
            ax.fill_between(trials, losses.min(axis=0), losses.max(axis=0), color=colour, alpha=0.15, lw=0)
            ax.semilogy(trials, np.median(losses, axis=0), color=colour, lw=1.8, label=name)
        ax.set(xlabel="trial", ylabel=f"best {_LOSS}", yscale="log")
        legend_above(ax)
    return path
