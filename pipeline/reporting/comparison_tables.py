"""The rows of a comparison as tables: error against noise, sensors and number of speeds, and against the best."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from pipeline.comparison.cases import Case
from pipeline.comparison.result import Result
from pipeline.methods.catalogue import METHODS
from pipeline.reporting.console import format_markdown


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

    def error(self, method: str, case: Case, name: str | None = None) -> float:
        """Median error over speed in percent, mean over bearings and data sets; of the worst coefficient, or ``name``.

        NaN where there is no answer.
        """
        rows = [r for r in self.of(method, case) if r.answered]
        if not rows:
            return float("nan")
        errors = [np.mean([r.error(of) for r in rows]) for of in ([name] if name else self.names)]
        return float(np.max(errors))

    def by_coefficient(self, method: str) -> dict[str, float]:
        """Coefficient -> error in the main case; empty where there is no answer."""
        errors = {name: self.error(method, self.main, name) for name in self.names}
        return {name: error for name, error in errors.items() if not np.isnan(error)}

    def coverage(self, method: str, case: Case) -> float | None:
        """Percent of speeds inside the nominal 95 % interval, mean over all; None where no deviation is stated."""
        shares = [
            of.within_interval
            for r in self.of(method, case)
            for found in r.coefficients.values()
            for of in found.values()
            if of.within_interval is not None
        ]
        return float(np.mean(shares)) if shares else None

    def seconds(self, method: str, case: Case) -> float:
        """Median processor time of an answer over the data sets."""
        return float(np.median([r.seconds for r in self.of(method, case)]))

    def cell(self, method: str, case: Case) -> str:
        """The error, with a question mark where a fit doubts itself, or the name of what the method can't do."""
        rows = self.of(method, case)
        if not rows:
            return ""
        error = self.error(method, case)
        if np.isnan(error):
            return rows[0].outcome.replace("_", " ")
        return format_error(error) + (" ?" if any(r.doubt for r in rows) else "")

    def along(self, key: str) -> list[Case]:
        """The main case with every value of ``noise``, ``sensors`` or ``speeds`` that there is."""
        values = list(dict.fromkeys(getattr(r.case, key) for r in self.results))
        values = values if key == "sensors" else sorted(values)
        made = [replace(self.main, **{key: value}) for value in values]
        return [case for case in made if any(self.of(method, case) for method in self.methods)]

    def best_other(self, method: str, case: Case, name: str) -> tuple[str, float]:
        """The best of the other methods for a coefficient, and how many times its error that of ``method`` is."""
        others = {other: self.error(other, case, name) for other in self.methods if other != method}
        answered = {other: error for other, error in others.items() if not np.isnan(error)}
        if not answered:
            return "", float("nan")
        best = min(answered, key=lambda other: answered[other])
        return best, self.error(method, case, name) / answered[best]

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
    return f"{error:.2g}" if error >= ROUNDING_PERCENT else f"< {ROUNDING_PERCENT:g}".replace("e-0", "e-")


def format_noise(noise: float) -> str:
    """A share as percent."""
    return f"{100 * noise:g} %"


_KEYS = ("noise", "sensors", "speeds")
SENSOR_TEXT = {"all": "all nodes", "bearings": "bearings", "location": "one location"}


def describe_case(case: Case, *keys: str) -> str:
    """Name the ``noise``, ``sensors`` or ``speeds`` of a case."""
    texts = {"noise": format_noise(case.noise), "sensors": SENSOR_TEXT[case.sensors], "speeds": f"{case.speeds} speeds"}
    return ", ".join(texts[key] for key in keys)


def make_tables(comparison: Comparison) -> list[tuple[str, list[str], list[list[str]]]]:
    """(title, header, rows) of every table; the first column names the method."""
    main, made = comparison.main, []
    by_noise = [
        ("noise", [replace(one, sensors=case.sensors) for one in comparison.along("noise")])
        for case in comparison.along("sensors")
    ]
    for key, columns in [*by_noise, ("speeds", comparison.along("speeds"))]:
        rows = [[METHODS[m].label, *(comparison.cell(m, case) for case in columns)] for m in comparison.methods]
        fixed = describe_case(columns[0], *(other for other in _KEYS if other != key))
        title = f"median error % of the worst coefficient against {key}; {fixed}"
        made.append((title, ["method", *(describe_case(case, key) for case in columns)], rows))
    each = []
    for m in comparison.methods:
        errors = comparison.by_coefficient(m)
        cells = [format_error(errors[name]) if name in errors else "" for name in comparison.names]
        each.append([METHODS[m].label, *cells])
    title = f"median error % of each coefficient; {describe_case(main, *_KEYS)}"
    made.append((title, ["method", *comparison.names], each))
    about = []
    for m in comparison.methods:
        held = comparison.coverage(m, main)
        inside, seconds = "" if held is None else f"{held:.0f}", f"{comparison.seconds(m, main):.2g}"
        about.append([METHODS[m].label, METHODS[m].source, METHODS[m].beforehand, inside, seconds])
    made.append(("the methods", ["method", "source", "needs beforehand", "inside 95 %, %", "seconds"], about))
    return made


def write_markdown(comparison: Comparison) -> str:
    """Write all tables as Markdown."""
    return "\n".join(f"{title}\n\n{format_markdown(header, rows)}" for title, header, rows in make_tables(comparison))
