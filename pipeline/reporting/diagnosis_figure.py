"""Figure of what the data determine before a fit: the deviation of each coefficient, and condition numbers."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np

from pipeline.coefficients import COEFFICIENTS
from pipeline.data.vibration_files import to_rpm
from pipeline.problem.determination import WEAKLY_BELOW, WELL_BELOW
from pipeline.problem.identifiability import Identifiability, Solvability
from pipeline.reporting.figure import BLUE, GREEN, GREY, LOOKS, ORANGE, RPM, YELLOW, Axes, Curve, Figure, Panel
from pipeline.reporting.matplotlib_figures import write_figure


def draw_diagnosis(
    path: Path,
    reports: Sequence[Identifiability],
    relative: Callable[[int], Mapping[str, np.ndarray]],
    noise: str,
    largest_condition: float = 1e16,
    largest_deviation: float = 1e5,
) -> Path:
    """Deviation of each coefficient over speed that the ``noise`` implies; below it the condition number.

    ``relative`` gives, for the node of a bearing, the standard deviation (S,) over the coefficient by its name. Shades
    are the limits of well, weakly and not determined. A speed with several operating conditions has their median. An
    infinite condition number is drawn as the largest; deviations (%) beyond the largest are off the figure.
    """
    drawn, several = [], ""
    for report in reports:
        speeds, groups = np.unique(report.speeds, return_inverse=True)
        several = "\nmedian over the operating conditions" if len(speeds) < len(groups) else ""
        rpm, above = to_rpm(speeds), []
        for name, values in relative(report.nodes[0]).items():
            colour, dash = LOOKS[COEFFICIENTS.index(name) % 4][0], "solid" if name[0] == "k" else "dash"
            medians = _take_medians(np.where(np.isfinite(values), 100 * values, np.nan), groups)
            above.append(Curve(rpm, medians, name, colour, dash))
        drawn.append((report, rpm, [curve for curve in above if curve.shown], groups))
    deviations = np.concatenate([np.ones(1), *(curve.y for _, _, curves, _ in drawn for curve in curves)])
    deviations = deviations[np.isfinite(deviations)]
    reach = (min(0.8 * deviations.min(), 1.0), min(max(1.25 * deviations.max(), 100.0), largest_deviation))
    said, panels = f"standard deviation at\n{noise}\n(% of the coefficient){several}", []
    for report, rpm, curves, groups in drawn:
        shades = _shade_verdicts(rpm[[0, -1]], reach)
        if not curves:
            at, middle = np.array([rpm.mean()]), np.array([np.sqrt(reach[0] * reach[1])])
            shades.append(Curve(at, middle, "", GREY, "none", texts=["free: no finite deviation"]))
        below = [
            Curve(rpm, _take_medians(np.minimum(condition, largest_condition), groups), f"condition {text}", *look)
            for condition, text, *look in (
                (report.condition, "of the equations for the coefficients", BLUE),
                (report.orbit_condition, "of the orbits", GREY, "dash"),
            )
        ]
        known = " without noise" if report.verdict is not Solvability.NOT_IDENTIFIABLE else ""
        axes = [
            Axes([*shades, *curves], said, scale="log", y_range=reach),
            Axes(below, "condition number (-)", scale="log"),
        ]
        panels.append(Panel(f"{report.where}:\n{report.verdict.value}{known}", RPM, axes))
    return write_figure(path, Figure("diagnosis", "", panels, columns=len(reports)))


def _take_medians(values: np.ndarray, groups: np.ndarray) -> np.ndarray:
    """(U,) medians of the ``values`` (S,) at each different speed; ``groups`` (S,) says which it is."""
    order, counts = np.argsort(groups, kind="stable"), np.bincount(groups)
    return np.array([np.median(group) for group in np.split(values[order], np.cumsum(counts)[:-1])])


def _shade_verdicts(rpm: np.ndarray, reach: tuple[float, float]) -> list[Curve]:
    """Shades behind the deviations (%): well determined, weakly, and not; what no reading tells is cut off above."""
    edges, curves = (reach[0], 100 * WELL_BELOW, 100 * WEAKLY_BELOW, reach[1]), []
    shades = (("well determined", GREEN), ("weakly", YELLOW), ("not determined", ORANGE))
    for (verdict, colour), start, stop in zip(shades, edges, edges[1:], strict=False):
        middle, half = np.full(2, (start + stop) / 2), np.full(2, (stop - start) / 2)
        curves.append(Curve(rpm, middle, "", colour, "none", band=half, alpha=0.4))
        curves.append(Curve(rpm @ [[0.15], [0.85]], np.array([0.7 * stop]), "", GREY, "none", texts=[verdict]))
    return curves
