"""Tables of balancing: the unbalance of each condition, the balance sheet, predicted records; on screen, in files."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from pipeline.balance.bands import bound_size
from pipeline.balance.records import PredictedRecords
from pipeline.balance.sheet import BalanceSheet
from pipeline.balance.tolerance import Tolerance
from pipeline.balance.unbalance import Estimates
from pipeline.data.vibration_files import to_rpm
from pipeline.ingest.records import Records
from pipeline.ingest.source_units import GRAM_MILLIMETRE, SourceUnits
from pipeline.reporting.console import say, table
from pipeline.reporting.write_numbers import format_deviation

_LEAST = 1e-3  # g mm
_SPEEDS = 6
"""Most speeds on screen."""
_SHOWN = 40
"""Most conditions on screen; all are in the file."""


def tabulate_estimates(
    by_method: Mapping[str, Estimates], planes: Sequence[int], source: SourceUnits
) -> list[dict[str, Any]]:
    """Rows of ``balance.csv``: one a method, condition and plane. Angles are those of the recordings."""
    rows: list[dict[str, Any]] = []
    for method, estimates in by_method.items():
        values, given = source.weights(estimates.unbalance), source.weights(estimates.readings.unbalance)
        radius = estimates.radius / GRAM_MILLIMETRE
        for c, (name, unbalance) in enumerate(zip(estimates.readings.names, estimates.found, strict=True)):
            sizes, angle = unbalance.magnitude_interval() / GRAM_MILLIMETRE, np.degrees(unbalance.angle_half_width())
            half, known = unbalance.half_width() / GRAM_MILLIMETRE, estimates.readings.unbalance[c]
            for n, node in enumerate(planes):
                row: dict[str, Any] = {"method": method, "condition": name, "node": node}
                row |= _show_complex("unbalance", values[c, n])
                row |= {
                    "magnitude_low_g_mm": sizes[n, 0],
                    "magnitude_high_g_mm": sizes[n, 1],
                    "angle_band_deg": angle[n],
                    "part_band_g_mm": half[n],
                    "circle_g_mm": radius[c, n],
                }
                if not np.isnan(known[n]):
                    row |= _show_complex("known", given[c, n])
                    row["known_within_95"] = int(abs(known[n] - unbalance.value[n]) <= estimates.radius[c, n])
                row |= {
                    "chance": _blank(estimates.chance[c]),
                    "inconsistent": int(estimates.inconsistent[c]),
                    "label_chance": _blank(estimates.label_chance[c]),
                    "contradicted": int(estimates.contradicted[c]),
                    "vectors": int((estimates.readings.counts[c] > 0).sum()),
                }
                rows.append({key: _blank(value) if isinstance(value, float) else value for key, value in row.items()})
    return rows


def _blank(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def _show_complex(name: str, value: complex) -> dict[str, float]:
    return {
        f"{name}_re_g_mm": float(value.real),
        f"{name}_im_g_mm": float(value.imag),
        f"{name}_g_mm": float(abs(value)),
        f"{name}_angle_deg": float(np.degrees(np.angle(value))),
    }


def print_estimates(name: str, method: str, estimates: Estimates, planes: Sequence[int], source: SourceUnits) -> None:
    """The unbalance of every condition by one method; of many conditions the first ones and those with a remark."""
    names, remarks = estimates.readings.names, [_remark(estimates, c) for c in range(len(estimates.found))]
    shown = [c for c, remark in enumerate(remarks) if remark]
    first = len(names) if len(names) <= _SHOWN else _SHOWN - len(shown)
    shown = sorted({*shown, *range(first)})
    rows = [[names[c], *_show_condition(estimates, c, source), remarks[c]] for c in shown]
    header = ["condition", *(f"node {node}, {what}" for node in planes for what in ("g mm", "deg", "known")), "remark"]
    table(f"{name}: unbalance by {method} (+- 95 %)", header, rows)
    if len(shown) < len(names):
        say(f"{len(names) - len(shown)} more conditions are in balance.csv")


def _show_condition(estimates: Estimates, c: int, source: SourceUnits) -> list[str]:
    unbalance, cells = estimates.found[c], []
    values, known = source.weights(unbalance.value), source.weights(estimates.readings.unbalance[c])
    half, angle = unbalance.half_width() / GRAM_MILLIMETRE, np.degrees(unbalance.angle_half_width())
    for n, value in enumerate(values):
        known_to = _blank(half[n])
        cells.append(_show_size(abs(value)) if known_to is None else format_deviation(float(abs(value)), known_to))
        cells.append("any" if angle[n] >= 180 else f"{_show_angle(value)} +- {angle[n]:.1f}")
        cells.append("-" if np.isnan(known[n]) else _show_known(known[n]))
    return cells


def _show_known(value: complex) -> str:
    return f"{abs(value):.4g} at {_show_angle(value)}" if abs(value) > 0 else "0"


def _remark(estimates: Estimates, c: int) -> str:
    said = []
    if estimates.inconsistent[c]:
        said.append(f"no unbalance explains it ({estimates.chance[c]:.1g})")
    if estimates.contradicted[c]:
        said.append(f"contradicts its weights ({estimates.label_chance[c]:.1g})")
    return ", ".join(said)


def describe_sheet(
    sheet: BalanceSheet, planes: Sequence[int], source: SourceUnits, tolerance: Tolerance | None
) -> dict[str, Any]:
    """The sheet for ``balance.json``: of each plane the weights, the unbalance before and what remains."""
    before, left, at_most = source.weights(sheet.unbalance), source.weights(sheet.remaining), sheet.at_most()
    rows = [
        {
            "node": node,
            "weights": [{"hole": w.hole, "mass_g": 1e3 * w.mass} for w in sheet.weights[n]],
            **_show_complex("unbalance", before[n]),
            **_show_complex("remaining", left[n]),
            "circle_g_mm": _blank(sheet.circle[n] / GRAM_MILLIMETRE),
            "remaining_at_most_g_mm": _blank(at_most[n] / GRAM_MILLIMETRE),
        }
        for n, node in enumerate(planes)
    ]
    return {
        "planes": rows,
        "tolerance": judge_tolerance(sheet, tolerance),
    }


def print_sheet(
    title: str, sheet: BalanceSheet, planes: Sequence[int], source: SourceUnits, tolerance: Tolerance | None
) -> None:
    """Which mass goes into which hole, what remains in each plane, and whether the tolerance holds."""
    rows = []
    for plane in describe_sheet(sheet, planes, source, tolerance)["planes"]:
        weights = ", ".join(f"{w['mass_g']:.4g} g in hole {w['hole']}" for w in plane["weights"]) or "no weight"
        vectors = [
            f"{_show_size(plane[f'{vector}_g_mm'])} at {plane[f'{vector}_angle_deg'] % 360:.0f} deg"
            for vector in _VECTORS
        ]
        bounds = [_show_bound(plane[key]) for key in ("circle_g_mm", "remaining_at_most_g_mm")]
        rows.append([f"node {plane['node']}", weights, *vectors, *bounds])
    header = ["plane", "put in", "unbalance, g mm", "remains, g mm", "+- (95 % circle)", "at most (95 %)"]
    table(title, header, rows)
    for plane in judge_tolerance(sheet, tolerance):
        verdict = {"met": "is met", "not met": "is not met", "open": "may or may not be met"}[plane["verdict"]]
        say(
            f"bearing at node {plane['node']}: {_show_size(plane['remaining_g_mm'])} g mm remain "
            f"(at most {_show_bound(plane['at_most_g_mm'])}, 95 %), permissible are {plane['permissible_g_mm']:.3g}: "
            f"the tolerance {verdict}"
        )


def print_fewer(sheets: Sequence[BalanceSheet], planes: Sequence[int], source: SourceUnits) -> None:
    """What at most one, two ... weights a plane leave: whether another screw is worth it."""
    rows = []
    for k, sheet in enumerate(sheets, 1):
        put = [", ".join(f"{1e3 * w.mass:.4g} g in {w.hole}" for w in weight) or "none" for weight in sheet.weights]
        left = ", ".join(_show_size(float(size)) for size in np.abs(source.weights(sheet.remaining)))
        grams = 1e3 * sum(w.mass for weight in sheet.weights for w in weight)
        vibration = 1e6 * float(np.sqrt(np.nanmean(np.abs(sheet.after) ** 2)))
        rows.append([str(k), *put, left, f"{vibration:.3g}", f"{grams:.4g}"])
    holes = [f"node {node}: in hole" for node in planes]
    header = ["weights a plane at most", *holes, "remain, g mm", "vibration after, um (root mean square)", "g in all"]
    table("would fewer do?", header, rows)


_VECTORS = ("unbalance", "remaining")


def judge_tolerance(sheet: BalanceSheet, tolerance: Tolerance | None) -> list[dict[str, Any]]:
    """Of each bearing: met where even the 95 % bound is permissible, not met where the estimate itself is not."""
    if tolerance is None:
        return []
    remaining = tolerance.remaining(sheet.remaining)
    most = bound_size(remaining, tolerance.circle(sheet.covariance, sheet.circle))
    rows = []
    for node, left, bound, permissible in zip(
        tolerance.nodes, np.abs(remaining), most, tolerance.permissible, strict=True
    ):
        verdict = "met" if bound <= permissible else "not met" if left > permissible else "open"
        rows.append(
            {
                "node": node,
                "remaining_g_mm": float(left / GRAM_MILLIMETRE),
                "at_most_g_mm": _blank(bound / GRAM_MILLIMETRE),
                "permissible_g_mm": float(permissible / GRAM_MILLIMETRE),
                "verdict": verdict,
            }
        )
    return rows


def tabulate_vibration_change(
    sheet: BalanceSheet, speeds: np.ndarray, channels: Sequence[tuple[int, float]], source: SourceUnits
) -> list[dict[str, Any]]:
    """Rows of expected vibration before and after, one a speed and probe, in the unit of the recordings."""
    shape = (len(speeds), len(channels))
    sizes = np.abs(source.sizes(speeds)) + np.zeros(shape)
    before, after, half = (
        np.abs(vibration).reshape(shape) / sizes for vibration in (sheet.before, sheet.after, sheet.half_width)
    )
    names = source.probes or tuple(f"node {node}, {angle:g} deg" for node, angle in channels)
    return [
        {
            "speed_rpm": float(to_rpm(speeds[s : s + 1])[0]),
            "probe": names[p],
            "unit": source.unit,
            "before": None if np.isnan(before[s, p]) else float(before[s, p]),
            "after": None if np.isnan(after[s, p]) else float(after[s, p]),
            "band_95": _blank(half[s, p]),
        }
        for s in range(shape[0])
        for p in range(shape[1])
    ]


def print_vibration_change(rows: Sequence[Mapping[str, Any]], unit: str) -> None:
    """Amplitudes before and after, of many speeds a few that are evenly spread."""
    read = [row for row in rows if row["before"] is not None]
    speeds = sorted({row["speed_rpm"] for row in read})
    every = max(1, -(-len(speeds) // _SPEEDS))
    shown = speeds[::-every]
    header = ["probe", "rpm", f"before, {unit}", f"after, {unit}"]
    lines = [
        [
            row["probe"],
            f"{row['speed_rpm']:.0f}",
            f"{row['before']:.3g}",
            format_deviation(row["after"], row["band_95"]),
        ]
        for row in read
        if row["speed_rpm"] in shown
    ]
    table("vibration, zero-to-peak as the recordings have it (+- 95 % of one record)", header, lines)
    if len(shown) < len(speeds):
        say(f"{len(speeds) - len(shown)} more speeds are in balance.json")


def _show_bound(size: float | None) -> str:
    return "unknown" if size is None else f"{size:.3g}"


def _show_size(size: float) -> str:
    return f"{size:.3g}" if size >= _LEAST else "0"


def _show_angle(value: complex) -> str:
    return f"{np.degrees(np.angle(value)) % 360:.0f}"


def tabulate_predicted(
    identity: Mapping[str, Sequence[str] | np.ndarray],
    records: Records,
    predicted: PredictedRecords,
    source: SourceUnits,
    columns: Sequence[tuple[str, str]],
    method: str,
) -> dict[str, Any]:
    """Columns of ``predicted_records.csv``: those that name a record, then those of each probe.

    A probe has its predicted vector, the standard deviation and half of the 95 % band of both parts, and the radius of
    the circle that holds 95 % of such vectors; where it was measured, what it departs by, and whether that lies in the
    circle.
    """
    mean, off = (source.vectors(vibration, records.speeds) for vibration in (predicted.mean, predicted.off))
    sizes = np.abs(source.sizes(records.speeds))
    std, half, circle = (
        vibration / sizes for vibration in (predicted.deviation, predicted.half_width, predicted.circle)
    )
    table_of: dict[str, Any] = dict(identity) | {"method": np.full(len(records.speeds), method, dtype=object)}
    for p, (real, imaginary) in enumerate(columns):
        measured = predicted.measured[:, p]
        table_of[real], table_of[imaginary] = mean[:, p].real, mean[:, p].imag
        table_of[f"{real}_std"] = table_of[f"{imaginary}_std"] = std[:, p]
        table_of[f"{real}_band"] = table_of[f"{imaginary}_band"] = half[:, p]
        table_of[f"{records.probes[p]}_circle"] = circle[:, p]
        if measured.any():
            table_of[f"{real}_off"], table_of[f"{imaginary}_off"] = off[:, p].real, off[:, p].imag
            inside = [int(w) if t else None for w, t in zip(predicted.within[:, p], measured, strict=True)]
            table_of[f"{records.probes[p]}_within_95"] = np.array(inside, dtype=object)
    return table_of
