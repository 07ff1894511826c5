"""A comparison of methods as tables, a figure and numbers: error against noise, sensors and number of speeds, and
against the best.

An entry is the mean over the data sets of other noise, and their standard deviation. A method is better than another
only where their differences, data set by data set, have a mean beyond what their own spread explains (Student's paired
test, 5 %). The best and all that are not told from it are printed bold.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from textwrap import wrap

import numpy as np

from pipeline.comparison.cases import Case, Result
from pipeline.methods.catalogue import METHODS
from pipeline.reporting.blocks import (
    BLUE,
    GREEN,
    GREY,
    LOOKS,
    ORANGE,
    Axes,
    Curve,
    Figure,
    Panel,
    Table,
    format_markdown,
)
from pipeline.reporting.console import say, table
from pipeline.reporting.matplotlib_figures import write_figure
from pipeline.write_numbers import write_number


@dataclass(frozen=True, eq=False)
class Comparison:
    """All rows, and the case that the one-way tables go through."""

    results: tuple[Result, ...]
    main: Case
    names: tuple[str, ...]  # coefficients that are identified

    def of(self, method: str, case: Case) -> list[Result]:
        """The rows of a method in a case, of all data sets."""
        return [r for r in self.results if r.method == method and replace(r.case, data_set=0) == case]

    @property
    def methods(self) -> tuple[str, ...]:
        """The methods in the order of the results."""
        return tuple(dict.fromkeys(r.method for r in self.results))

    def entries(self, method: str, case: Case, name: str | None = None) -> dict[int, float]:
        """Data set -> median error over speed in percent, mean over bearings; of the worst coefficient, or ``name``.

        Data sets without an answer are left out.
        """
        names, answered = [name] if name else self.names, [r for r in self.of(method, case) if r.answered]
        errors = {r.case.data_set: [r.error(coefficient) for coefficient in names] for r in answered}
        return {i: float(np.nanmax(values)) for i, values in errors.items() if not np.isnan(values).all()}

    def error(self, method: str, case: Case, name: str | None = None) -> float:
        """The mean of the :meth:`entries`; NaN where there is no answer."""
        return float(np.mean(list(self.entries(method, case, name).values()) or [np.nan]))

    def spread(self, method: str, case: Case, name: str | None = None) -> float:
        """The standard deviation of the :meth:`entries`; NaN where there are fewer than two."""
        errors = list(self.entries(method, case, name).values())
        return float(np.std(errors, ddof=1)) if len(errors) > 1 else float("nan")

    def differs(self, method: str, other: str, case: Case, name: str | None = None) -> bool:
        """Whether the errors of two methods differ beyond their spread: Student's test of the paired differences, 5 %.

        On clean data, where nothing varies, they differ unless both are rounding.
        """
        mine, others = self.entries(method, case, name), self.entries(other, case, name)
        pairs = [(mine[i], others[i]) for i in sorted(set(mine) & set(others))]
        differences = [error - other for error, other in pairs]
        if not case.noise:
            return any(max(pair) >= ROUNDING_PERCENT and pair[0] != pair[1] for pair in pairs)
        if len(pairs) < 2 or np.ptp(differences) == 0:
            return len(pairs) > 1 and differences[0] != 0
        from scipy.stats import ttest_1samp

        return bool(ttest_1samp(differences, 0.0).pvalue < 0.05)

    def level_with_best(self, case: Case, name: str | None = None) -> set[str]:
        """The best method and those that are not told from it, of those that always answer.

        One data set with noise tells nothing.
        """
        least, found = 2 if case.noise else 1, {method: self.entries(method, case, name) for method in self.methods}
        enough = [method for method in self.methods if len(self.of(method, case)) == len(found[method]) >= least]
        most = max((len(found[method]) for method in enough), default=0)
        fullest = (method for method in enough if len(found[method]) == most)
        best = min(fullest, key=lambda method: self.error(method, case, name), default="")
        return {method for method in enough if method == best or not self.differs(method, best, case, name)}

    def coverage(self, method: str, case: Case) -> float | None:
        """Percent of speeds inside the nominal 95 % interval, mean over all; None where no deviation is stated."""
        shares = [
            held["within_interval"]
            for r in self.of(method, case)
            for coefficient in r.coefficients.values()
            for held in coefficient.values()
            if held["within_interval"] is not None
        ]
        return float(np.mean(shares)) if shares else None

    def cell(self, method: str, case: Case) -> str:
        """The error, with a question mark where a fit doubts itself, or the name of what the method can't do."""
        rows = self.of(method, case)
        if not rows:
            return ""
        errors = self.entries(method, case)
        if not errors:
            return rows[0].outcome.replace("_", " ")
        return (
            self.format_entry(method, case)
            + (f" ({len(errors)} of {len(rows)} answer)" if len(errors) < len(rows) else "")
            + (" ?" if any(r.doubt for r in rows) else "")
        )

    def format_entry(self, method: str, case: Case, name: str | None = None) -> str:
        """Mean, and the spread where there are several data sets; bold where it is level with the best."""
        error, spread = self.error(method, case, name), self.spread(method, case, name)
        told = error >= ROUNDING_PERCENT and not np.isnan(spread)
        text = format_error(error) + (f" ± {write_number(spread, digits=2 if spread >= 9.5 else 1)}" if told else "")
        return f"**{text}**" if method in self.level_with_best(case, name) else text

    def label(self, method: str, cases: Sequence[Case]) -> str:
        """The method's name, and what it sees less of than the others."""
        made = [(case, self.of(method, case)) for case in cases if case.noise]
        seen = [(r.used_speeds, case.speeds) for case in cases for r in self.of(method, case)]
        used = [count for count, measured in seen if count is not None and count < measured]
        notes = [f"{min(used)} speeds"] if used else []
        most = {case: max(len(self.of(m, case)) for m in self.methods) for case, _ in made}
        if fewer := {len(rows) for case, rows in made if 0 < len(rows) < most[case]}:
            notes.append(f"{min(fewer)} data set{'s' * (min(fewer) > 1)}")
        return METHODS[method].label + (f" ({', '.join(notes)})" if notes else "")

    def along(self, key: str) -> list[Case]:
        """The main case with every value of ``noise``, ``sensors`` or ``speeds`` that there is."""
        values = dict.fromkeys(getattr(r.case, key) for r in self.results)
        made = [replace(self.main, **{key: value}) for value in (values if key == "sensors" else sorted(values))]
        return [case for case in made if any(self.of(method, case) for method in self.methods)]

    def best_other(self, method: str, case: Case, name: str, *without: str) -> tuple[str, float]:
        """The best of the others but ``without`` for a coefficient, and the error of ``method`` over its error."""
        others = (other for other in self.methods if other not in (method, *without))
        errors = {other: error for other in others if not np.isnan(error := self.error(other, case, name))}
        best = min(errors, key=errors.__getitem__, default="")
        return best, self.error(method, case, name) / errors.get(best, np.nan)

    def outcomes(self) -> dict[str, dict[str, str]]:
        """Why a method gave no answer: method -> name of the reason -> its words."""
        result: dict[str, dict[str, str]] = {}
        for r in self.results:
            if not r.answered:
                result.setdefault(r.method, {}).setdefault(r.outcome, r.words)
        return result


ROUNDING_PERCENT = 1e-8
"""Errors below it are rounding: their digits differ from one processor to another, and are not printed."""


def format_error(error: float) -> str:
    """An error in percent, to two digits where it has them."""
    if error < ROUNDING_PERCENT:
        return f"< {write_number(ROUNDING_PERCENT)}"
    return write_number(error, digits=3 if error >= 100 else 2)


def format_noise(noise: float) -> str:
    """A share as percent."""
    return f"{100 * noise:g} %"


SENSOR_TEXT = {"all": "all nodes", "bearings": "bearings", "location": "one location"}


def describe_case(case: Case, *keys: str) -> str:
    """Name the ``noise``, ``sensors`` or ``speeds`` of a case."""
    texts = {"noise": format_noise(case.noise), "sensors": SENSOR_TEXT[case.sensors], "speeds": f"{case.speeds} speeds"}
    return ", ".join(texts[key] for key in keys)


def make_tables(comparison: Comparison) -> list[Table]:
    """Every table; the first column names the method, bold is marked by ``**``."""
    main, methods = comparison.main, comparison.methods
    noise, speeds = comparison.along("noise"), [case for case in comparison.along("speeds") if case != main]
    fewer = f"; fewer speeds at {format_noise(main.noise)} noise" if speeds else ""
    title = f"sensors: {describe_case(main, 'sensors', 'speeds')}{fewer}"
    columns = [
        (case, describe_case(case, key)) for key, cases in (("noise", noise), ("speeds", speeds)) for case in cases
    ]
    first = _make_table(comparison, title, columns)
    shares = ["" if held is None else f"{held:.0f}" for held in (comparison.coverage(m, main) for m in methods)]
    tables = [
        Table(title, [*first.header, "inside"], [[*row, share] for row, share in zip(first.rows, shares, strict=True)])
    ]
    others = [case for case in comparison.along("sensors") if case.sensors != main.sensors]
    if others:
        pairs = [replace(case, noise=level.noise) for case in others for level in noise]
        names = " or ".join(SENSOR_TEXT[case.sensors] for case in others)
        columns = [(case, describe_case(case, "sensors", "noise")) for case in pairs]
        tables.append(_make_table(comparison, f"sensors: {names}, {describe_case(main, 'speeds')}", columns))
    each = [
        [
            comparison.label(m, [main]),
            *(comparison.format_entry(m, main, n) if comparison.entries(m, main, n) else "" for n in comparison.names),
        ]
        for m in methods
    ]
    title = f"each coefficient; {describe_case(main, 'noise', 'sensors', 'speeds')}"
    return [*tables, Table(title, ["method", *comparison.names], each)]


def _make_table(comparison: Comparison, title: str, columns: Sequence[tuple[Case, str]]) -> Table:
    cases = [case for case, _ in columns]
    return Table(
        title,
        ["method", *(name for _, name in columns)],
        [[comparison.label(m, cases), *(comparison.cell(m, case) for case in cases)] for m in comparison.methods],
    )


def write_markdown(comparison: Comparison) -> str:
    """Write all tables as Markdown; methods that answer in no case of a table are named below it."""
    texts = []
    for made in make_tables(comparison):
        answered = [row for row in made.rows if any(character.isdigit() for cell in row[1:] for character in str(cell))]
        named = "; ".join(f"{row[0]} ({row[1]})" for row in made.rows if row not in answered and row[1])
        below = "\n".join(["", *wrap(f"No answer: {named}.", 100), ""]) if named else ""
        texts.append(f"Median error in percent, {made.caption}:\n\n{format_markdown(made.header, answered)}" + below)
    return "\n".join(texts)


def tabulate(comparison: Comparison) -> list[dict[str, object]]:
    """A row a method, case, bearing and coefficient, over its data sets; one without coefficient where none answers.

    ``median_error_percent`` is the mean over the data sets; ``_std``, ``_median``, ``_min`` and ``_max`` follow it.
    """
    rows: list[dict[str, object]] = []
    for method, case in dict.fromkeys((r.method, replace(r.case, data_set=0)) for r in comparison.results):
        results = comparison.of(method, case)
        answered = [r for r in results if r.answered]
        about: dict[str, object] = {
            "method": method,
            "noise": case.noise,
            "sensors": case.sensors,
            "speeds": case.speeds,
            "used_speeds": results[0].used_speeds or case.speeds,
            "data_sets": len(results),
            "answered": len(answered),
            "outcome": (answered or results)[0].outcome,
            "words": (answered or results)[0].words,
            "doubt": next((r.doubt for r in results if r.doubt), ""),
            "seconds": float(np.median([r.seconds for r in results])),
        }
        places: dict[tuple[str | None, str | None], None] = dict.fromkeys(
            (node, name) for r in answered for node, coefficient in r.coefficients.items() for name in coefficient
        )
        rows += [
            about | {"bearing_node": node, "coefficient": name} | _summarize(answered, node, name)
            for node, name in places or [(None, None)]
        ]
    return rows


def _summarize(answered: Sequence[Result], node: str | None, name: str | None) -> dict[str, object]:
    """Over the data sets; None for what none of them has."""
    import pandas as pd

    answers = [each[name] for r in answered for at, each in r.coefficients.items() if at == node and name in each]
    frame = pd.DataFrame(
        answers, columns=["median_error", "p95_error", "median_deviation", "within_interval"], dtype=float
    )
    errors = frame["median_error"]
    numbers = {f"median_error_percent_{key}": getattr(errors, key)() for key in ("std", "median", "min", "max")}
    numbers = {"median_error_percent": errors.mean(), **numbers}
    numbers |= {f"{key}_percent": frame[key].mean() for key in ("p95_error", "median_deviation", "within_interval")}
    return {key: None if np.isnan(number) else float(number) for key, number in numbers.items()}


# --- figure, numbers and screen ------------------------------------------------------------------------

_NOISE_LOOKS = ((GREY, "o"), (BLUE, "s"), (ORANGE, "^"), (GREEN, "D"), *LOOKS[3:])


def draw_comparison(path: Path, comparison: Comparison, least: float = 1e-4) -> Path:
    """Median error of the worst coefficient: a row a method, best above, a marker a noise or a number of speeds.

    The number of speeds has a panel where there are several. A method without an answer has words in its row. What is
    smaller than ``least`` (%) is exact for every purpose, and drawn as a hollow marker on the edge.
    """
    noise, main = comparison.along("noise"), comparison.main
    # By the error in the main case; those without an answer there last.
    methods = sorted(comparison.methods, key=lambda method: np.nan_to_num(comparison.error(method, main), nan=np.inf))
    shown = [
        (f"sensors: {describe_case(case, 'sensors', 'speeds')}", [replace(case, noise=n.noise) for n in noise], "noise")
        for case in comparison.along("sensors")
    ]
    if len(by_speeds := comparison.along("speeds")) > 1:
        shown.append((f"sensors: {describe_case(main, 'sensors', 'noise')} noise", by_speeds, "speeds"))
    every = [comparison.error(method, case) for _, cases, _ in shown for case in cases for method in methods]
    reach = (least, 2 * float(np.nanmax([10 * least, *every])))
    return write_figure(
        path,
        Figure(
            "comparison",
            "",
            [_draw_panel(title, comparison, methods, cases, key, reach) for title, cases, key in shown],
            columns=1,
        ),
    )


def _draw_panel(
    title: str,
    comparison: Comparison,
    methods: Sequence[str],
    cases: Sequence[Case],
    key: str,
    reach: tuple[float, float],
) -> Panel:
    least, most = reach
    errors = np.array([[comparison.error(method, case) for case in cases] for method in methods])  # (methods, cases)
    shown, places = np.maximum(errors, least), np.arange(len(methods))
    silent = np.isnan(errors).all(axis=1)
    curves = [
        Curve(row[np.isfinite(row)], np.full(np.isfinite(row).sum(), m), "", GREY, width=1.0)
        for m, row in enumerate(shown)
        if not silent[m]
    ]
    for c, (case, (colour, marker)) in enumerate(zip(cases, _NOISE_LOOKS, strict=False)):
        label = describe_case(case, key) + (" noise" if key == "noise" else "")
        for full, chosen in ((True, errors[:, c] >= least), (False, errors[:, c] < least)):
            rows = np.where(chosen, places, np.nan)
            curves.append(Curve(shown[:, c], rows, label, colour, "none", marker, full=full, size=6))
    texts = ["no answer"] * int(silent.sum())
    curves.append(Curve(np.full(len(texts), 4 * least), places[silent] + 0.2, "", GREY, "none", texts=texts))
    names = [METHODS[method].label for method in methods]
    return Panel(
        title,
        f"median error of the worst coefficient (%); hollow: below {least:g}",
        [Axes(curves, "", y_names=names)],
        log_x=True,
        x_range=(0.7 * least, most),
        wide=True,
    )


def _list_noises(
    comparison: Comparison, method: str, measure: Callable[[str, Case], float]
) -> dict[str, dict[str, float]]:
    """What is measured by sensors and noise, where it is finite."""
    by_sensors = {
        sensors.sensors: {
            f"{100 * noise.noise:g}_percent".replace(".", "_"): value
            for noise in comparison.along("noise")
            if np.isfinite(value := measure(method, replace(sensors, noise=noise.noise)))
        }
        for sensors in comparison.along("sensors")
    }
    return {sensors: values for sensors, values in by_sensors.items() if values}


def summarize_comparison(comparison: Comparison) -> dict[str, object]:
    """Numbers by method, sensors and noise, and the response loss against the best other method in the main case."""
    methods = {
        method: {
            "median_error_percent": _list_noises(comparison, method, comparison.error),
            "standard_deviation_percent": _list_noises(comparison, method, comparison.spread),
            "median_error_percent_by_speeds": {
                str(case.speeds): error
                for case in comparison.along("speeds")
                if np.isfinite(error := comparison.error(method, case))
            },
            "median_error_percent_by_coefficient": {
                name: error
                for name in comparison.names
                if not np.isnan(error := comparison.error(method, comparison.main, name))
            },
            "within_95_percent_interval": comparison.coverage(method, comparison.main),
            "outcomes": comparison.outcomes().get(method, {}),
        }
        for method in comparison.methods
    }
    summary: dict[str, object] = {"methods": methods}
    if "response" in comparison.methods:
        main, names = comparison.main, comparison.names
        rest = {name: comparison.best_other("response", main, name, "smoothed") for name in names}
        summary["response_over_best_of_the_rest"] = {n: ratio for n, (_, ratio) in rest.items() if np.isfinite(ratio)}
        summary["best_of_the_rest"] = {name: best for name, (best, _) in rest.items() if best}
        over = {n: comparison.error("response", main, n) / comparison.error("smoothed", main, n) for n in names}
        summary["response_over_smoothed"] = {n: ratio for n, ratio in over.items() if np.isfinite(ratio)}
    summary["level_with_the_best"] = sorted(comparison.level_with_best(comparison.main))
    return summary


def print_comparison(name: str, comparison: Comparison) -> None:
    """The tables, why a method gave no answer, and the output error against the best other."""
    for made in make_tables(comparison):
        table(f"{name}: {made.caption}", made.header, made.rows)
    for method, outcomes in comparison.outcomes().items():
        for outcome in outcomes.values():
            say(f"{METHODS[method].label}: {outcome}")
    if "response" in comparison.methods:
        for coefficient in comparison.names:
            best, ratio = comparison.best_other("response", comparison.main, coefficient)
            if best:
                apart = comparison.differs("response", best, comparison.main, coefficient)
                say(
                    f"{coefficient}: {METHODS['response'].label} has {ratio:.2f} times the error of the best other, "
                    f"{METHODS[best].label}" + ("" if apart else ", which is within the spread of the data sets")
                )
