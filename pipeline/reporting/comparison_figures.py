"""Figure of a comparison: a row a method, and how far each is off, for each set of sensors and number of speeds."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from pipeline.comparison.cases import Case
from pipeline.methods.catalogue import METHODS
from pipeline.reporting.comparison_tables import SENSOR_TEXT, Comparison, describe_case, format_noise
from pipeline.reporting.figure import BLUE, GREEN, GREY, LOOKS, ORANGE, Axes, Curve, Figure, Panel
from pipeline.reporting.matplotlib_figures import write_figure

_NOISE_LOOKS = ((GREY, "o"), (BLUE, "s"), (ORANGE, "^"), (GREEN, "D"), *LOOKS[3:])


def draw_comparison(path: Path, comparison: Comparison, least: float = 1e-4) -> Path:
    """Median error of the worst coefficient: a row a method, best above, a marker a noise or a number of speeds.

    The number of speeds has a panel where there are several. A method without an answer has words in its row. What is
    smaller than ``least`` (%) is exact for every purpose, and drawn as a hollow marker on the edge.
    """
    noise, main, methods = comparison.along("noise"), comparison.main, _sort_methods(comparison)
    shown: list[tuple[str, list[Case], str]] = []
    for case in comparison.along("sensors"):
        title = f"sensors: {SENSOR_TEXT[case.sensors]}, {case.speeds} speeds"
        shown.append((title, [Case(level.noise, case.sensors, case.speeds) for level in noise], "noise"))
    if len(by_speeds := comparison.along("speeds")) > 1:
        title = f"sensors: {SENSOR_TEXT[main.sensors]}, {format_noise(main.noise)} noise"
        shown.append((title, by_speeds, "speeds"))
    every = [comparison.error(method, case) for _, cases, _ in shown for case in cases for method in methods]
    reach = (least, 2 * float(np.nanmax([10 * least, *every])))
    panels = [_draw_panel(title, comparison, methods, cases, key, reach) for title, cases, key in shown]
    return write_figure(path, Figure("comparison", "", panels, columns=1))


def _sort_methods(comparison: Comparison) -> list[str]:
    """The methods by their error in the main case; those without an answer there last."""
    errors = {method: comparison.error(method, comparison.main) for method in comparison.methods}
    return sorted(errors, key=lambda method: (np.isnan(errors[method]), errors[method]))


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
    axes = Axes(curves, "", y_names=names)
    below = f"median error of the worst coefficient (%); hollow: below {least:g}"
    return Panel(title, below, [axes], log_x=True, x_range=(0.7 * least, most), wide=True)
