"""What a study says to a person: tables, a summary and its text."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from pipeline.config.promotion import get_value, has_value
from pipeline.config.schema import Config
from pipeline.evaluation.errors import find_worst_mean, measure_errors
from pipeline.identification.identified import IdentifiedModel
from pipeline.identification.residual_loss import ChebyshevFit
from pipeline.reporting.blocks import format_markdown
from pipeline.rotor.bearing_table import BearingTable
from pipeline.tuning.finalists import Finalist, TrialSummary
from pipeline.tuning.study import describe_objective
from pipeline.write_numbers import write_number, write_rough, write_value

if TYPE_CHECKING:
    import pandas as pd

ROUNDING_LEVEL = 1e-12
"""A held-out loss below this leaves nothing to tune."""


@dataclass(frozen=True, eq=False, kw_only=True)
class StudyReport:
    """Everything that a study found. ``finalists`` begins with the default; ``best`` is the promoted one of them."""

    config: Config
    trials: Sequence[TrialSummary]
    finalists: Sequence[Finalist]
    best: Finalist
    chebyshev: ChebyshevFit | None
    importances: Mapping[str, float]
    known: BearingTable
    modelled: BearingTable | None

    @property
    def default(self) -> Finalist:
        """The configured values."""
        return self.finalists[0]

    @cached_property
    def errors(self) -> dict[int, dict[str, np.ndarray]]:
        """Trial -> coefficient -> (seeds,) mean error over speed in percent, worse bearing; empty without a truth."""
        errors = {f.trial: [self._measure(model) for model in f.models] for f in self.finalists}
        return {
            trial: {name: np.array([error[name] for error in each]) for name in self.names}
            for trial, each in errors.items()
            if self.modelled is not None
        }

    @cached_property
    def chebyshev_errors(self) -> dict[str, float]:
        """The same of the Chebyshev series."""
        return {} if self.chebyshev is None else self._measure(self.chebyshev.identified)

    def _measure(self, model: IdentifiedModel) -> dict[str, float]:
        if self.modelled is None:
            return {}
        errors = measure_errors(model.table(self.known), self.modelled, model.unknowns.by_bearing)
        return {name: find_worst_mean(errors, name) for name in self.names}

    @property
    def names(self) -> tuple[str, ...]:
        """The coefficients that are identified."""
        return tuple(self.config.identify.named())

    def medians(self, name: str) -> tuple[float, float]:
        """The median error of a coefficient in percent, of the default and of the promoted values."""
        before, after = (float(np.median(self.errors[f.trial][name])) for f in (self.default, self.best))
        return before, after


# --- tables ------------------------------------------------------------------------------------------


def tabulate_trials(report: StudyReport) -> pd.DataFrame:
    """Make one row for each trial."""
    import pandas as pd

    fields = {"number": "trial", "state": "state", "loss": "held_out_loss", "seconds": "training_seconds"}
    fields |= {name: name for name in ("epochs", "outcome", "reason")}
    trials = pd.DataFrame([vars(trial) for trial in report.trials])[list(fields)].rename(columns=fields)
    return trials.astype({"epochs": "Int64"}).join(
        pd.DataFrame([dict(trial.parameters) for trial in report.trials]).reindex(
            columns=list(report.config.tuning.space)
        )
    )


def tabulate_finalists(report: StudyReport) -> pd.DataFrame:
    """Make one row for each finalist and seed."""
    import pandas as pd

    return pd.concat(
        [
            pd.DataFrame(
                {
                    "trial": f.trial,
                    "seed": report.config.tuning.seeds,
                    "held_out_loss": f.losses,
                    "outcome": [outcome.label for outcome in f.outcomes],
                }
                | {f"{name}_mean_error_percent": error for name, error in report.errors.get(f.trial, {}).items()}
            )
            for f in report.finalists
        ],
        ignore_index=True,
    )


# --- summary -----------------------------------------------------------------------------------------


def summarize_study(report: StudyReport) -> dict[str, object]:
    """Collect the content of ``summary.json``."""
    summary: dict[str, object] = {
        "experiment": report.config.name,
        "promoted_trial": report.best.trial,
        "verdict": judge_study(report),
        "trials": dict(Counter(t.state for t in report.trials)),
        "held_out_loss_gain": _divide(report.default.median, report.best.median),
        "default": _summarize_finalist(report, report.default),
        "tuned": _summarize_finalist(report, report.best),
    }
    if report.chebyshev is not None:
        summary["chebyshev_series"] = {
            "degree": report.chebyshev.degree,
            "held_out_loss": report.chebyshev.held_out_loss,
            "mean_error_percent": report.chebyshev_errors,
        }
    if report.errors:
        summary["error_gain"] = {name: _divide(*report.medians(name)) for name in report.names}
    return summary


def _summarize_finalist(report: StudyReport, finalist: Finalist) -> dict[str, object]:
    losses = finalist.losses[np.isfinite(finalist.losses)]
    summary: dict[str, object] = {"seeds": len(finalist.losses), "diverged": len(finalist.losses) - len(losses)}
    if np.isfinite(finalist.median):
        extremes = {"lowest": float(losses.min()), "highest": float(losses.max())}
        summary["held_out_loss"] = {"median": finalist.median, **extremes}
    summary["median_error_percent"] = {
        name: float(np.median(errors)) for name, errors in report.errors.get(finalist.trial, {}).items()
    }
    return summary


def _divide(before: float, after: float) -> float | None:
    return before / after if np.isfinite(before) and after > 0 else None


def judge_study(report: StudyReport) -> str:
    """Say in a sentence whether tuning helped."""
    before, after = report.default.median, report.best.median
    stated, chosen, gain = (write_number(number, digits=3) for number in (before, after, before / after))
    if report.best is not report.default:
        return (
            f"trial {report.best.trial} is worth promoting: median held-out loss {chosen}, "
            f"{gain} times below the default's {stated}"
        )
    if before < ROUNDING_LEVEL:
        return (
            f"the configured default stays: its held-out loss is below {ROUNDING_LEVEL:g}, which is rounding, and "
            "tuning can't help"
        )
    return (
        f"the configured default stays: over {len(report.default.losses)} seeds no finalist lowers its median held-out "
        f"loss {stated} by {report.config.tuning.least_gain:g} times, with every seed below its luckiest one, "
        "so tuning does not help"
    )


# --- text --------------------------------------------------------------------------------------------


def write_report(report: StudyReport) -> str:
    """Write the ``README.md`` of the study."""
    config, tuning = report.config, report.config.tuning
    states = Counter(t.state for t in report.trials)
    seconds = sum(t.seconds or 0.0 for t in report.trials)
    every, overridden = config.training.holdout_every, "(and what else was overridden when the study was begun)"
    command = [
        f"python -m pipeline stage=tune {config.chosen} tuning.n_trials={tuning.n_trials}",
        *([f"training.holdout_every={every}"] if every else []),
        *([f"tuning.study={tuning.study} {overridden}"] if tuning.study != config.name else []),
    ]
    shares = ", ".join(f"{name} {100 * share:.0f} %" for name, share in list(report.importances.items())[:4])
    drawn = {"importance": report.importances, "learning_curves": any(trial.curve for trial in report.trials)}
    parts = [
        f"# Study `{tuning.study}`",
        f"**Question.** Which hyperparameters identify {', '.join(report.names)} of `{config.name}` best - "
        f"{config.description}?",
        f"**Objective.** The loss on the held-out speeds (every {every}th): "
        f"{describe_objective(config)}. No modelled coefficient is used, neither by the search nor by the choice.",
        f"**Budget.** {len(report.trials)} trials ({', '.join(f'{n} {s}' for s, n in sorted(states.items()))}), "
        f"{seconds:.0f} s of training, sampler {tuning.sampler} with seed {tuning.sampler_seed}, the first "
        f"{tuning.startup_trials} at random. Trial 0 is the configured default.",
        f"    {' '.join(command)}",
        f"**Result.** {judge_study(report).capitalize()}.",
        _compare(report),
        *_explain_limits(report),
        _list_values(report),
        f"What sets the best trials apart (importance by PED-ANOVA): {shares}." if shares else "",
        "`trials.csv` has every trial, `finalists.csv` every finalist and seed, `best.yaml` what training uses.",
        *(f"![{title}](figures/{name}.png)" for name, title in _FIGURES.items() if drawn.get(name, True)),
    ]
    return "\n\n".join(filter(None, parts)) + "\n"


_FIGURES = {
    "history": "Held-out loss of every trial, and the best so far",
    "finalists": "Held-out loss of the default and the finalists, one dot a seed",
    "learning_curves": "Learning curves of all trials",
    "importance": "Importance of the parameters",
    "slice": "Held-out loss over each parameter",
    "parallel_coordinates": "Parallel coordinates of all trials",
}


def _compare(report: StudyReport) -> str:
    """Set the default, the finalists and the Chebyshev series side by side."""
    names = report.names if report.errors else ()
    head = ["", "held-out loss", *(f"{name} error %" for name in names), "time of one training"]
    rows = []
    for f in report.finalists:
        title = "default" if f.trial == 0 else f"trial {f.trial}"
        if f is report.best:
            title = f"**{title}, {'chosen' if f.trial else 'which stays'}**"
        losses = f.losses[np.isfinite(f.losses)]
        span = _write_span(f.median, losses, 3) if len(losses) else "diverged"
        errors = [report.errors[f.trial][name] for name in names]
        cells = [_write_span(float(np.median(error)), error) for error in errors]
        rows.append([title, span, *cells, f"{f.seconds / len(f.losses):.1f} s"])
    if (series := report.chebyshev) is not None:
        cells = [write_rough(report.chebyshev_errors[name]) for name in names]
        loss = write_number(series.held_out_loss, digits=3)
        rows.append([f"Chebyshev series, degree {series.degree}", loss, *cells, ""])
    caption = f"Median over {len(report.config.tuning.seeds)} seeds (lowest to highest)"
    if names:
        caption += "; errors are the mean over speed of the worse bearing, evaluated after the choice"
    return f"{format_markdown(head, rows)}\n{caption}."


def _write_span(middle: float, values: np.ndarray, digits: int = 2) -> str:
    return f"{write_number(middle, digits=digits)} ({write_rough(values.min())} to {write_rough(values.max())})"


def _explain_limits(report: StudyReport) -> list[str]:
    """Say how much there was to gain."""
    if report.chebyshev is None:
        return []
    series, best = report.chebyshev, report.best
    room = report.default.median / series.held_out_loss
    gain = (
        "Smooth functions of the speed hardly do better: the default had a factor of "
        f"{write_rough(room)} to gain there."
    )
    text = (
        "**What limits it.** A Chebyshev series of the speed, fitted by linear least squares (one answer, no "
        f"training), reaches a held-out loss of {write_number(series.held_out_loss, digits=3)} at its best degree, "
        f"{series.degree}. {gain if room > 1 else 'The default network is below that already.'}"
    )
    if best is report.default:
        return [text]
    sentences = [f"{text} The chosen values have {write_rough(max(best.median / series.held_out_loss, 1.0))} left."]
    medians = {name: report.medians(name) for name in report.chebyshev_errors}
    gains = (
        f"{name} {write_rough(before)} to {write_rough(after)} % "
        f"({write_rough(before / after)} times; series {write_rough(report.chebyshev_errors[name])} %)"
        for name, (before, after) in medians.items()
    )
    sentences += [f"Median errors, default to chosen: {', '.join(gains)}."] if medians else []
    worse = [name for name, (before, after) in medians.items() if after > before]
    if worse:
        sentences.append(
            f"A lower held-out loss is not a better {' and '.join(worse)} here: so close to the limit, the loss "
            "can't tell which of two answers is nearer to the truth."
        )
    return sentences


def _list_values(report: StudyReport) -> str:
    before = {k: get_value(report.config, k) if has_value(report.config, k) else "-" for k in report.best.values}
    changed = {key: value for key, value in report.best.values.items() if before[key] != value}
    rows = [[f"`{key}`", write_value(before[key]), write_value(value)] for key, value in changed.items()]
    return format_markdown(["value", "default", "chosen"], rows).rstrip() if rows else ""
