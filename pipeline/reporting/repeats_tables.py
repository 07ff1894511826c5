"""Trainings from many starts, and measurements that were identified many times, on screen."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from pipeline.reporting.console import say, table


def print_starts(name: str, over: str, summary: Mapping[str, Any], seconds: float) -> None:
    """The outcomes of all starts, and the worst and the median error of each coefficient."""
    outcomes = ", ".join(f"{count} {label.replace('_', ' ')}" for label, count in summary["outcomes"].items())
    varied = {"seed": "seeds", "initial_guess": "initial guesses"}[over]
    say(f"{name}: {summary['starts']} {varied} trained at once in {seconds:.1f} s ({outcomes})")
    rows = [
        [
            f"node {node} {coefficient}",
            f"{values['worst_mean_error_percent']:.2g}",
            f"{values['median_mean_error_percent']:.2g}",
        ]
        for node, entry in summary["coefficients"].items()
        for coefficient, values in entry.items()
    ]
    if rows:
        table(
            f"{name}: mean error % over all {varied}",
            ["bearing and coefficient", "worst", "median"],
            rows,
        )


def print_refits(name: str, summary: Mapping[str, Any]) -> None:
    """Error, bound and coverage of each coefficient over the data sets, and of the numbers of bearing laws."""
    shown = [
        [
            f"node {node} {coefficient}",
            f"{measures['median_error_percent']:.3g}",
            f"{measures['worst_median_error_percent']:.3g}",
            f"{measures['median_bound_percent']:.3g}",
            f"{measures['rmse_over_bound']:.2f}",
            f"{measures['within_95_percent_interval']:.1f}",
        ]
        for node, coefficients in summary["coefficients"].items()
        for coefficient, measures in coefficients.items()
    ]
    errors = ["median error %, typical", "worst data set", "standard deviation by the bound, %", "error over bound"]
    header = ["bearing and coefficient", *errors, "inside the 95 % interval, %"]
    table(f"{name}: {summary['data_sets']} measurements of the machine, each identified by itself", header, shown)
    say(
        f"all coefficients: median error {summary['median_error_percent']:.3g} %, "
        f"{summary['within_95_percent_interval']:.1f} % inside the 95 % interval; the model is rejected in "
        f"{summary['rejected_percent']:.0f} % of the data sets"
    )
    for state, bearings in summary.get("unmeasured", {}).items():
        worst = max(entry["median_error_percent"] for names in bearings.values() for entry in names.values())
        typical = summary["all_unmeasured"][state]["median_error_percent"]
        say(f"at {state}, which no run has: median error {typical:.3g} %, of the worst coefficient {worst:.3g} %")
    for number, error in summary.get("numbers", {}).items():
        say(
            f"{number}: error {error['median_error_percent']:.3g} %, typically, "
            f"{error['worst_error_percent']:.3g} % at worst; "
            f"{error['within_95_percent_interval']:.0f} % inside the 95 % interval"
        )
