"""A comparison as a figure, a row a method, and in numbers, as JSON and on screen."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from pipeline.comparison.cases import Case
from pipeline.methods.catalogue import METHODS
from pipeline.reporting.blocks import BLUE, GREEN, GREY, LOOKS, ORANGE, Axes, Curve, Figure, Panel
from pipeline.reporting.comparison_tables import SENSOR_TEXT, Comparison, describe_case, format_noise, make_tables
from pipeline.reporting.console import say, table
from pipeline.reporting.matplotlib_figures import write_figure

_NOISE_LOOKS = ((GREY, "o"), (BLUE, "s"), (ORANGE, "^"), (GREEN, "D"), *LOOKS[3:])


def draw_comparison(path: Path, comparison: Comparison, least: float = 1e-4) -> Path:
    """Median error of the worst coefficient: a row a method, best above, a marker a noise or a number of speeds.

    The number of speeds has a panel where there are several. A method without an answer has words in its row. What is
    smaller than ``least`` (%) is exact for every purpose, and drawn as a hollow marker on the edge.
    """
    noise, main = comparison.along("noise"), comparison.main
    # By the error in the main case; those without an answer there last.
    methods = sorted(comparison.methods, key=lambda method: np.nan_to_num(comparison.error(method, main), nan=np.inf))
    shown: list[tuple[str, list[Case], str]] = []
    for case in comparison.along("sensors"):
        title = f"sensors: {SENSOR_TEXT[case.sensors]}, {case.speeds} speeds"
        shown.append((title, [Case(level.noise, case.sensors, case.speeds) for level in noise], "noise"))
    if len(by_speeds := comparison.along("speeds")) > 1:
        title = f"sensors: {SENSOR_TEXT[main.sensors]}, {format_noise(main.noise)} noise"
        shown.append((title, by_speeds, "speeds"))
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
