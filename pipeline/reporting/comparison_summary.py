"""A comparison in numbers, as JSON, and on screen."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from pipeline.comparison.cases import Case
from pipeline.methods.catalogue import METHODS
from pipeline.reporting.comparison_tables import Comparison, make_tables
from pipeline.reporting.console import say, table


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
            "median_error_percent_by_coefficient": comparison.by_coefficient(method),
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
