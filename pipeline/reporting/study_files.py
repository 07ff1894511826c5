"""What came of a study, as files: trials, finalists, a report, the values that training may use, and figures."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.config.promotion import BEST, PromotedTrial
from pipeline.config.tuning import Dimension, HeldOutLoss, Value
from pipeline.data.tables import write_table
from pipeline.files import write_json, write_text
from pipeline.reporting.blocks import BLUE, GREEN, GREY, ORANGE, PURPLE, Axes, Curve, Figure, Panel
from pipeline.reporting.matplotlib_figures import write_figure
from pipeline.reporting.study_report import StudyReport, tabulate_finalists, tabulate_trials, write_report
from pipeline.tuning.finalists import TRIALS, Finalist, TrialSummary, format_trials
from pipeline.write_numbers import write_number

_STATES = {"complete": (BLUE, "o"), "pruned": (ORANGE, "x"), "failed": (PURPLE, "s")}
HELD_OUT = "held-out loss\n(over the bearing force, or the noise)"


SUMMARY = "summary.json"
AGAIN = "run stage=tune again after moving it away"
STUDY_FILES = (BEST, SUMMARY, "README.md", TRIALS, "trials.csv", "finalists.csv")


def write_study(folder: Path, study: Any, report: StudyReport, summary: dict[str, object]) -> list[Path]:
    """Write :data:`STUDY_FILES` and figures into ``folder``; the summary comes last. Raises StorageError."""
    import yaml

    config, medians = report.config, {"configured": report.default.median, "promoted": report.best.median}
    losses = {name: median if math.isfinite(median) else None for name, median in medians.items()}
    values = PromotedTrial(
        study=config.tuning.study,
        trial=report.best.trial,
        values=dict(report.best.values),
        held_out_loss=HeldOutLoss(**losses),
    )
    head = (
        f"# Found by: python -m pipeline stage=tune {config.chosen}\n"
        "# Training uses these values; one given on the command line wins, and tuned=false leaves them all out.\n"
    )
    return [
        write_table(folder / "trials.csv", tabulate_trials(report)),
        write_table(folder / "finalists.csv", tabulate_finalists(report)),
        *draw_study(folder / "figures", report.trials, config.tuning.space, report.importances, report.finalists),
        write_text(folder / TRIALS, format_trials(study)),
        write_text(folder / "README.md", write_report(report)),
        write_text(folder / BEST, head + yaml.safe_dump(values.model_dump(mode="json"), sort_keys=False)),
        write_json(folder / SUMMARY, summary),
    ]


def draw_study(
    folder: Path,
    trials: Sequence[TrialSummary],
    space: Mapping[str, Dimension],
    importances: Mapping[str, float],
    finalists: Sequence[Finalist],
) -> list[Path]:
    """Draw all figures of a study into ``folder``, except those that need more trials than there are."""
    done = [trial for trial in trials if trial.loss is not None]
    drawn = {
        "finalists": [_draw_finalists(finalists)],
        "history": [_draw_history(trials)] if done else [],
        "slice": _draw_slices(done, space) if done else [],
        "parallel_coordinates": [_draw_parallel(done, space)] if done else [],
        "learning_curves": [_draw_curves(trials)] if any(trial.curve for trial in trials) else [],
        "importance": [_draw_importance(importances)] if importances else [],
    }
    return [
        write_figure(folder / f"{name}.png", Figure(name, "", panels, columns=min(4, len(panels))))
        for name, panels in drawn.items()
        if panels
    ]


def _draw_history(trials: Sequence[TrialSummary]) -> Panel:
    curves, losses = [], np.array([math.nan if trial.loss is None else trial.loss for trial in trials])
    numbers = np.array([trial.number for trial in trials])
    for state, (colour, marker) in _STATES.items():
        chosen = np.array([trial.state == state for trial in trials])
        bare = chosen & np.isnan(losses)
        curves.append(Curve(numbers, np.where(chosen, losses, np.nan), state, colour, "none", marker, full=True))
        if bare.any():  # a mark on the axis
            least = np.full(bare.sum(), np.nanmin(losses))
            curves.append(Curve(numbers[bare], least, f"{state}, no loss", colour, "none", marker))
    complete = np.array([trial.state == "complete" for trial in trials]) & np.isfinite(losses)
    best = np.minimum.accumulate(losses[complete])
    steps = np.repeat(numbers[complete], 2)[1:], np.repeat(best, 2)[:-1]
    curves.append(Curve(*steps, "best so far" if complete.any() else "", GREY))
    return Panel("", "trial (0 is the configured default)", [Axes(curves, HELD_OUT, scale="log")], wide=True)


def _draw_curves(trials: Sequence[TrialSummary]) -> Panel:
    curves = []
    for trial in sorted((t for t in trials if t.curve), key=lambda t: t.number == 0):
        x, y = np.array(list(trial.curve)), np.array(list(trial.curve.values()))
        colour, label = _STATES.get(trial.state, (GREY,))[0], trial.state
        look: dict[str, Any] = {"width": 1.2, "alpha": 0.7}
        if trial.number == 0:
            colour, label, look = GREEN, "the configured default", {"width": 2.8}
        curves.append(Curve(x, y, label, colour, "solid", ".", full=True, **look))
    return Panel("", "part of the last optimiser's epochs (%)", [Axes(curves, HELD_OUT, scale="log")], wide=True)


def _draw_importance(importances: Mapping[str, float]) -> Panel:
    """A bar a parameter."""
    shares = {name.replace("_", " "): 100 * share for name, share in importances.items() if share > 0.005}
    ends = np.array(list(shares.values()))
    places = np.arange(len(ends))
    bars = [Curve(np.array([0.0, share]), np.full(2, place), width=12.0) for place, share in enumerate(ends)]
    texts = Curve(ends, places - 0.25, "", GREY, "none", texts=[f"{share:.0f} %" for share in ends])
    return Panel(
        "what sets the best trials of the study apart from the others",
        "importance (%); parameters below 0.5 % are left out",
        [Axes([*bars, texts], "", y_names=list(shares))],
        wide=True,
    )


def _list_names(trials: Sequence[TrialSummary], space: Mapping[str, Dimension], least: float) -> list[str]:
    """The parameters that at least ``least`` trials have."""
    return [name for name in space if sum(name in trial.parameters for trial in trials) >= least]


def _draw_slices(trials: Sequence[TrialSummary], space: Mapping[str, Dimension]) -> list[Panel]:
    """The loss over each parameter; the default and the best trial stand out."""
    best = min((t for t in trials if t.state == "complete"), key=lambda t: t.loss or math.inf, default=None)
    generator, panels = np.random.default_rng(0), []
    every = np.array([trial.loss for trial in trials], dtype=float)
    reach = (0.7 * np.nanmin(every), 1.4 * np.nanmax(every))
    for name in _list_names(trials, space, 1):
        choices = _list_choices(space[name])
        having = [trial for trial in trials if name in trial.parameters]
        values = [trial.parameters[name] for trial in having]
        places = np.array([choices.index(str(value)) if choices else value for value in values], dtype=float)
        places += generator.uniform(-0.22, 0.22, len(having)) if choices else 0.0
        curves = [
            Curve(np.array([place]), np.array([trial.loss]), dash="none", **_choose_mark(trial, best))
            for trial, place in zip(having, places, strict=True)
        ]
        axes, log = Axes(curves, "held-out loss", scale="log", y_range=reach), getattr(space[name], "log", False)
        panels.append(
            Panel(
                "",
                name.replace("_", " "),
                [axes],
                x_names=[choice.replace("_", "\n") for choice in choices],
                log_x=log and not choices,
            )
        )
    return panels


def _choose_mark(trial: TrialSummary, best: TrialSummary | None) -> dict[str, Any]:
    if trial.number == 0:
        return {"marker": "D", "size": 6, "colour": GREEN, "full": True, "label": "the configured default"}
    if trial is best:
        return {"marker": "*", "size": 10, "colour": PURPLE, "full": True, "label": "the best trial"}
    colour, marker = _STATES[trial.state]
    return {"marker": marker, "colour": colour, "label": trial.state}


def _list_choices(dimension: Dimension) -> list[str]:
    """The values of a choice as texts; none for a range."""
    return [str(value) for value in dimension.options() or ()]


def _draw_parallel(trials: Sequence[TrialSummary], space: Mapping[str, Dimension]) -> Panel:
    """A line a trial through the parameters that half of the trials have; the best tenth and the default stand out."""
    names = _list_names(trials, space, len(trials) / 2)
    trials = sorted(trials, key=lambda trial: -(trial.loss or math.nan))  # the best lie above the others
    heights, captions = np.empty((len(trials), len(names))), []
    for x, name in enumerate(names):
        heights[:, x], ends = _scale_values([t.parameters.get(name) for t in trials], space[name])
        at = np.full(len(ends), x)
        texts = [caption.replace("_", " ") for caption in ends]
        captions.append(Curve(at, np.array(list(ends.values())), "", GREY, texts=texts, width=1.0))
    curves, few = [], max(1, len(trials) // 10)
    for i, (trial, line) in enumerate(zip(trials, heights, strict=True)):
        look: dict[str, Any] = {"colour": GREY, "width": 0.8, "alpha": 0.35, "label": "the other trials"}
        if i >= len(trials) - few:
            look = {"colour": BLUE, "width": 2.4, "alpha": 0.9, "label": "the best tenth"}
        if trial.number == 0:
            look = {"colour": GREEN, "width": 3.0, "dash": "dash", "label": "the configured default"}
        curves.append(Curve(np.arange(len(names)), line, marker=".", full=True, **look))
    return Panel(
        "",
        "",
        [Axes([*curves, *captions], "place in the parameter's range (-)", y_range=(-0.08, 1.12))],
        x_names=[name.replace("_", "\n") for name in names],
        wide=True,
    )


def _scale_values(values: Sequence[Value | None], dimension: Dimension) -> tuple[np.ndarray, dict[str, float]]:
    """(trials,) 0 to 1 on the axis of a parameter, NaN where a trial lacks it; and the captions with their heights."""
    if choices := _list_choices(dimension):
        captions = {name: i / max(len(choices) - 1, 1) for i, name in enumerate(choices)}
        return np.array([captions.get(str(value), math.nan) for value in values]), captions
    numbers = np.array([math.nan if value is None else float(value) for value in values])
    scaled = np.log(numbers) if getattr(dimension, "log", False) else numbers
    low, high = np.nanmin(scaled), np.nanmax(scaled)
    least, most = (write_number(float(end), digits=3) for end in (np.nanmin(numbers), np.nanmax(numbers)))
    if low == high:
        return np.where(np.isnan(scaled), math.nan, 0.5), {least: 0.5}
    return (scaled - low) / (high - low), {least: 0.0, most: 1.0}


def _draw_finalists(finalists: Sequence[Finalist]) -> Panel:
    """Every seed of the default and of the finalists: whether a difference is more than luck."""
    curves = []
    for x, finalist in enumerate(finalists):
        losses, ends = finalist.losses[np.isfinite(finalist.losses)], np.array([x - 0.25, x + 0.25])
        aside, colour = x + np.linspace(-0.12, 0.12, len(losses)), BLUE if x else GREEN
        curves += [
            Curve(aside, losses, "", colour, "none", "o", full=True),
            Curve(ends, np.full(2, finalist.median), "median", GREY, width=2.6),
        ]
    return Panel(
        "",
        "one dot a seed",
        [Axes(curves, HELD_OUT, scale="log")],
        x_names=["default" if f.trial == 0 else f"trial {f.trial}" for f in finalists],
        wide=True,
    )
