"""What the data determine before any fit: on the terminal, in files and figures."""

from __future__ import annotations

from collections.abc import Callable, Collection, Hashable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.coefficients import COEFFICIENTS
from pipeline.data.operating import list_columns
from pipeline.data.vibration_files import to_rpm
from pipeline.identification.combinations import WORTH, Combinations
from pipeline.identification.quality import finite
from pipeline.parameters.model import KINDS
from pipeline.problem.determination import WEAKLY_BELOW, WELL_BELOW, Determined
from pipeline.problem.diagnosis import Diagnosis
from pipeline.problem.identifiability import Identifiability, Solvability
from pipeline.problem.ranking import rank
from pipeline.reporting.blocks import (
    BLACK,
    BLUE,
    GREEN,
    GREY,
    LOOKS,
    ORANGE,
    RPM,
    YELLOW,
    Axes,
    Curve,
    Figure,
    HeatMap,
    Panel,
    Table,
    shade,
)
from pipeline.reporting.console import table
from pipeline.reporting.matplotlib_figures import write_figure, write_panel
from pipeline.units import RAD_S_PER_RPM
from pipeline.write_numbers import write_number, write_percent, write_rough


def summarize_diagnosis(diagnosis: Diagnosis) -> dict[str, dict[str, Any]]:
    """Return the diagnosis by node; an infinite number is null, since JSON has none."""
    result: dict[str, dict[str, Any]] = {}
    for report in diagnosis.reports:
        shared = {
            "verdict": report.verdict.value,
            "reason": report.reason,
            "unknowns": len(report.unknowns),
            "rank": {"least": int(report.rank.min()), "most": int(report.rank.max())},
            "orbit_rank": {"least": finite(report.orbit_rank.min()), "most": finite(report.orbit_rank.max())},
            "condition_number": {
                "median": finite(np.median(report.condition)),
                "max": finite(report.condition.max()),
            },
            "least_determined": report.free_combination(),
        }
        for node in report.nodes:
            result[str(node)] = shared | {
                "median_deviation_percent": {
                    name: finite(100 * np.median(v)) for name, v in diagnosis.relative(node).items()
                }
            }
    return result


def tabulate_diagnosis(
    diagnosis: Diagnosis, judged: Sequence[Determined], operating: Mapping[str, np.ndarray]
) -> list[dict[Hashable, Any]]:
    """A row a bearing and operating point; the verdicts are those over all points."""
    rows: list[dict[Hashable, Any]] = []
    for report in diagnosis.reports:
        for node in report.nodes:
            names, b = diagnosis.relative(node), diagnosis.expected.nodes.index(node)
            columns = {
                "bearing_node": np.full(len(report.speeds), node),
                "speed_rpm": to_rpm(report.speeds),
                **list_columns(operating),
                "unknowns": np.full(len(report.speeds), len(report.unknowns)),
                "rank": report.rank,
                "condition_number": report.condition,
                "orbit_rank": report.orbit_rank,
                "orbit_condition_number": report.orbit_condition,
                **{f"singular_value_{i + 1}": values for i, values in enumerate(report.singular_values.T)},
                **{f"{name}_std": diagnosis.expected.spread[b, :, COEFFICIENTS.index(name)] for name in names},
                **{f"{e.name}_verdict": [e.verdict.determined] * len(report.speeds) for e in judged if e.node == node},
            }
            rows += [{name: column[s] for name, column in columns.items()} for s in range(len(report.speeds))]
    return rows


def list_determined(caption: str, judged: Sequence[Determined]) -> Table:
    """The verdict on each coefficient, a column a bearing, on screen and in the report."""
    nodes = dict.fromkeys(each.node for each in judged)
    cells = {
        (each.node, each.name): f"{write_percent(each.deviation, '+- ')}, {each.verdict.determined}" for each in judged
    }
    names = dict.fromkeys(name for _, name in cells)
    rows = [[name, *(cells.get((node, name), "known") for node in nodes)] for name in names]
    return Table(caption, ["coefficient", *(f"bearing at node {node}" for node in nodes)], rows)


def list_bearings(caption: str, bearings: Mapping[str, Mapping[str, Any]]) -> Table:
    """Rank, condition and worst coefficient of ``bearings`` of ``diagnosis.json``, on screen and in the report."""
    rows = []
    for node, bearing in bearings.items():
        deviations = {
            name: np.inf if percent is None else percent / 100
            for name, percent in bearing["median_deviation_percent"].items()
        }
        coefficient = rank(deviations)[0]
        size = write_percent(deviations[coefficient], "+- ") if np.isfinite(deviations[coefficient]) else "free"
        told = None not in bearing["orbit_rank"].values()
        rows.append(
            [
                f"node {node}",
                bearing["verdict"],
                f"{_span(bearing['rank'])}\u00a0of\u00a0{bearing['unknowns']}",
                f"{_span(bearing['orbit_rank'])} of 2" if told else "",
                *(write_number(bearing["condition_number"][key], digits=3) for key in ("median", "max")),
                f"{coefficient} {size}",
                bearing["least_determined"],
            ]
        )
    return Table(
        caption,
        [
            "bearing",
            "verdict",
            "rank",
            "orbits",
            "condition (median)",
            "worst",
            "worst coefficient (median)",
            "determined least",
        ],
        rows,
    ).without_blank()


def _span(ends: Mapping[str, float]) -> str:
    return f"{ends['least']:.0f}" + (f" to {ends['most']:.0f}" if ends["most"] > ends["least"] else "")


def describe_combinations(combinations: Combinations) -> str:
    """Sentences: the best and the least known combination, the run that would tell more, and the tolerances."""
    ends = (("best", combinations.strongest), ("least", combinations.weakest))
    text = ", ".join(f"known {which} is {end.words} (+- {write_rough(100 * end.deviation)} %)" for which, end in ends)
    if run := combinations.next_run:
        rpm, deviation = write_number(run.speed / RAD_S_PER_RPM), write_rough(100 * run.deviation)
        text += f"; '{run.run}' at {rpm} rpm besides would tell that to +- {deviation} %"
    told = {kind: span for kind, span in combinations.parameters.items() if span[0] < WORTH}
    if told:
        ranges = {kind: [least] if most - least < 0.05 else [least, most] for kind, (least, most) in told.items()}
        shares = (f"{kind} {' to '.join(map(write_rough, span))}" for kind, span in ranges.items())
        text += f". The data narrow the tolerances (what is left, as a share): {', '.join(shares)}"
    if untold := [kind for kind in combinations.parameters if kind not in told]:
        text += f". They tell next to nothing of {', '.join(untold)}"
    return text + "."


def describe_series(combinations: Combinations, unseen: Collection[int], kept: float = 0.4) -> str:
    """A sentence on the bearings (nodes) whose casings are ``unseen`` by probes, where the data leave ``kept`` or more
    of what is stated of every number of the support; empty where there are none."""
    spans = combinations.parameters.items()
    left = {
        node: min((least for name, (least, _) in spans if f" node {node} " in name), default=0.0) for node in unseen
    }
    series = [node for node in unseen if left[node] > kept]
    if not series:
        return ""
    return (
        f"of bearing and support at node {' and '.join(map(str, series))} these probes tell only the two in series, "
        f"since none looks at the casing ({write_rough(min(left[node] for node in series))} or more of what is stated "
        "of the support is left): add probes there (measures: casing); stage=design design.accuracy=0.02 says what "
        "they bring"
    )


def summarize_combinations(combinations: Combinations) -> dict[str, Any]:
    """The same for JSON, deviations in percent."""
    run, ends = combinations.next_run, {"strongest": combinations.strongest, "weakest": combinations.weakest}
    return {
        "sentence": describe_combinations(combinations),
        **{
            name: {"deviation_percent": 100 * combination.deviation, "shares": dict(combination.shares)}
            for name, combination in ends.items()
        },
        "posterior_over_prior": {kind: list(span) for kind, span in combinations.parameters.items()},
        "next_run": run
        and {"run": run.run, "speed_rpm": run.speed / RAD_S_PER_RPM, "deviation_percent": 100 * run.deviation},
    }


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
        panels.append(
            Panel(
                f"{report.where}:\n{report.verdict.value}{known}",
                RPM,
                [
                    Axes([*shades, *curves], said, scale="log", y_range=reach),
                    Axes(below, "condition number (-)", scale="log"),
                ],
            )
        )
    return write_figure(path, Figure("diagnosis", "", panels, columns=len(reports)))


def _take_medians(values: np.ndarray, groups: np.ndarray) -> np.ndarray:
    """(U,) medians of the ``values`` (S,) at each different speed; ``groups`` (S,) says which it is."""
    return np.array([np.median(values[groups == group]) for group in range(groups.max() + 1)])


def _shade_verdicts(rpm: np.ndarray, reach: tuple[float, float]) -> list[Curve]:
    """Shades behind the deviations (%): well determined, weakly, and not; what no reading tells is cut off above."""
    edges, curves = (reach[0], 100 * WELL_BELOW, 100 * WEAKLY_BELOW, reach[1]), []
    shades = (("well determined", GREEN), ("weakly", YELLOW), ("not determined", ORANGE))
    for (verdict, colour), start, stop in zip(shades, edges, edges[1:], strict=False):
        curves += [
            shade(rpm, np.full(2, start), np.full(2, stop), colour, alpha=0.4),
            Curve(rpm @ [[0.15], [0.85]], np.array([0.7 * stop]), "", GREY, "none", texts=[verdict]),
        ]
    return curves


def name_tolerance(kind: str, tolerance: float) -> str:
    """A kind of model parameter with its ``tolerance`` (in its unit), such as ``length (0.1 %)``."""
    unit, factor = KINDS[kind].shown_unit
    return f"{kind} ({write_number(factor * tolerance, digits=3)} {unit})"


def print_budget(name: str, coefficients: Sequence[str], percent: Mapping[str, np.ndarray]) -> None:
    """What each tolerance (by its name) does to each coefficient, such as "kxx node 1": down, tolerances across."""
    table(
        f"{name}: systematic budget, what each tolerance does to a coefficient in percent (medians over speed)",
        ["coefficient", *percent],
        [
            [coefficient, *(write_rough(float(values[a])) for values in percent.values())]
            for a, coefficient in enumerate(coefficients)
        ],
    )


def draw_budget(path: Path, coefficients: Sequence[str], percent: Mapping[str, np.ndarray]) -> Path:
    """The same as a map: darker for more percent, with the numbers."""
    values = np.array(list(percent.values()))
    shade = np.log10(np.clip(values, 0.1, 100.0))
    down, across = np.meshgrid(*map(np.arange, values.shape), indexing="ij")
    texts = np.array([[write_rough(float(value)) for value in row] for row in values])
    numbers = [
        Curve(across[chosen], down[chosen] + 0.12, "", colour, "none", texts=texts[chosen].tolist())
        for colour, chosen in (("#ffffff", shade > 1), (BLACK, shade <= 1))
    ]
    return write_panel(
        path,
        Panel(
            "change of the coefficient by the tolerance in brackets (%, median over speed)",
            "",
            [Axes(numbers, "", y_names=list(percent))],
            heat=HeatMap(np.arange(values.shape[1]), np.arange(values.shape[0]), shade, "", "Blues", (-1.0, 2.0)),
            x_names=coefficients,
            wide=True,
        ),
    )
