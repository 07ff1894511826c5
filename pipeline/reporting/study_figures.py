"""Figures of a hyperparameter study: history, learning curves, importance, slices, parallel coordinates, finalists."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.config.tuning import Dimension, Value
from pipeline.reporting.figures import BLUE, GREEN, GREY, ORANGE, PURPLE, figure, legend_above
from pipeline.tuning.finalists import Finalist, TrialSummary

_STATES = {"complete": (BLUE, "o"), "pruned": (ORANGE, "x"), "failed": (PURPLE, "s")}
_LOSS = "held-out loss (share of the bearing force)"
_COLOURS = "viridis_r"


def study_figures(
    folder: Path,
    trials: Sequence[TrialSummary],
    space: Mapping[str, Dimension],
    importances: Mapping[str, float],
    finalists: Sequence[Finalist],
) -> list[Path]:
    """All figures of a study in ``folder``; those that need more trials than there are, are left out."""
    done = [trial for trial in trials if trial.loss is not None]
    written = [_finalists(folder / "finalists.png", finalists)]
    if done:
        written += [_history(folder / "history.png", trials), _slices(folder / "slice.png", done, space)]
        written.append(_parallel(folder / "parallel_coordinates.png", done, space))
    if any(trial.curve for trial in trials):
        written.append(_curves(folder / "learning_curves.png", trials))
    if importances:
        written.append(_importance(folder / "importance.png", importances))
    return written


def _history(path: Path, trials: Sequence[TrialSummary]) -> Path:
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


def _curves(path: Path, trials: Sequence[TrialSummary]) -> Path:
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
    names = [name for name, share in importances.items() if share > 0.005][::-1]
    with figure(path, 1, 1, 7.0, 1.2 + 0.35 * len(names)) as axes:
        ax = axes[0, 0]
        ax.barh(names, [100 * importances[name] for name in names], color=BLUE)
        ax.set_xlabel("importance: what sets the best trials apart (%)")
        ax.grid(axis="y", visible=False)
    return path


@dataclass(frozen=True)
class _Axis:
    """Where the values of a parameter lie: choices by their place, numbers as they are or by their logarithm."""

    name: str
    choices: tuple[str, ...]  # empty for a range
    log: bool

    def position(self, value: Value) -> float:
        return float(self.choices.index(str(value))) if self.choices else float(value)


def _axes(trials: Sequence[TrialSummary], space: Mapping[str, Dimension], least: int) -> list[_Axis]:
    """An axis for every parameter that ``least`` trials have."""
    axes = []
    for name, dimension in space.items():
        if sum(name in trial.parameters for trial in trials) >= least:
            choices = tuple(str(value) for value in dimension.options() or ())
            axes.append(_Axis(name, choices, getattr(dimension, "log", False)))
    return axes


def _slices(path: Path, trials: Sequence[TrialSummary], space: Mapping[str, Dimension]) -> Path:
    """The loss over each parameter; later trials are darker."""
    shown = _axes(trials, space, 1)
    columns = min(4, len(shown))
    rows = math.ceil(len(shown) / columns)
    last = max(trial.number for trial in trials) or 1
    with figure(path, rows, columns, 3.1 * columns, 2.6 * rows, sharey=True) as axes:
        for ax in axes.flat[len(shown) :]:
            ax.set_axis_off()
        for ax, axis in zip(axes.flat, shown, strict=False):
            for state, (_, marker) in _STATES.items():
                some = [t for t in trials if axis.name in t.parameters and t.state == state]
                x = [axis.position(t.parameters[axis.name]) for t in some]
                numbers = [t.number for t in some]
                ax.scatter(x, [t.loss for t in some], marker=marker, s=22, c=numbers, cmap=_COLOURS, vmin=0, vmax=last)
            ax.set(xlabel=axis.name.replace("_", " "), yscale="log")
            _ticks(ax, axis)
        for ax in axes[:, 0]:
            ax.set_ylabel("held-out loss")
        title = "dots: complete, crosses: pruned; darker: later trials"
        axes.flat[0].figure.suptitle(title, fontsize=9, x=0.01, ha="left")
    return path


def _ticks(ax: Any, axis: _Axis) -> None:
    from matplotlib.ticker import LogLocator, NullFormatter, StrMethodFormatter

    if axis.choices:
        ax.set_xticks(range(len(axis.choices)), [name.replace("_", "\n") for name in axis.choices], fontsize=8)
        ax.set_xlim(-0.6, len(axis.choices) - 0.4)
    elif axis.log:
        ax.set_xscale("log")
        low, high = ax.get_xlim()
        ax.xaxis.set_major_locator(LogLocator(subs=(1.0,) if high > 30 * low else (1.0, 2.0, 5.0)))
        ax.xaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
        ax.xaxis.set_minor_formatter(NullFormatter())


def _parallel(path: Path, trials: Sequence[TrialSummary], space: Mapping[str, Dimension]) -> Path:
    """A line a trial through the parameters that half of the trials have, coloured by its loss."""
    shown = _axes(trials, space, math.ceil(len(trials) / 2))
    losses = np.log10([float(trial.loss or math.nan) for trial in trials])
    low, high = float(losses.min()), float(losses.max())
    with figure(path, 1, 1, min(1.25 * len(shown) + 2.5, 15.0), 4.6) as axes:
        from matplotlib import colormaps
        from matplotlib.cm import ScalarMappable
        from matplotlib.colors import Normalize

        ax = axes[0, 0]
        norm = Normalize(low, high if high > low else low + 1)
        spans = [
            _span([axis.position(t.parameters[axis.name]) for t in trials if axis.name in t.parameters], axis)
            for axis in shown
        ]
        for trial, loss in sorted(zip(trials, losses, strict=True), key=lambda pair: -pair[1]):
            y = [_height(trial.parameters.get(axis.name), axis, span) for axis, span in zip(shown, spans, strict=True)]
            ax.plot(range(len(shown)), y, color=colormaps["viridis"](norm(loss)), lw=1.3, alpha=0.8, marker=".", ms=4)
        for x, (axis, span) in enumerate(zip(shown, spans, strict=True)):
            ax.axvline(x, color=GREY, lw=0.6)
            captions = axis.choices or [f"{value:.3g}" for value in span]
            for caption in captions:
                height = _height(caption if axis.choices else float(caption), axis, span)
                ax.annotate(
                    caption.replace("_", " "),
                    (x, height),
                    xytext=(4, 0),
                    textcoords="offset points",
                    fontsize=7,
                    va="center",
                    bbox={"facecolor": "white", "alpha": 0.7, "lw": 0, "pad": 0.5},
                )
        ax.set_xticks(range(len(shown)), [axis.name.replace("_", "\n") for axis in shown], fontsize=8)
        ax.set(yticks=[], ylim=(-0.08, 1.08), xlim=(-0.2, len(shown) - 0.3))
        ax.grid(visible=False)
        ax.figure.colorbar(ScalarMappable(norm, "viridis"), ax=ax, label="log10 of the held-out loss", pad=0.01)
    return path


def _span(positions: Sequence[float], axis: _Axis) -> tuple[float, float]:
    if axis.choices:
        return 0.0, float(max(len(axis.choices) - 1, 1))
    return min(positions), max(positions)


def _height(value: Value | None, axis: _Axis, span: tuple[float, float]) -> float:
    """0 to 1 on the axis of a parameter; NaN, which breaks the line, where a trial lacks it."""
    if value is None:
        return math.nan
    low, high = (math.log(v) for v in span) if axis.log else span
    position = math.log(float(value)) if axis.log else axis.position(value)
    return (position - low) / (high - low) if high > low else 0.5


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
            trials = 1 + np.arange(losses.shape[1])
            ax.fill_between(trials, losses.min(axis=0), losses.max(axis=0), color=colour, alpha=0.15, lw=0)
            ax.semilogy(trials, np.median(losses, axis=0), color=colour, lw=1.8, label=name)
        ax.set(xlabel="trial", ylabel=f"best {_LOSS}", yscale="log")
        legend_above(ax)
    return path
