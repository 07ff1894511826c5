"""Balancing: the unbalance of each condition, the balance sheet, predicted records; on screen, in files, drawn."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.balance.linear_vibration import bound_size
from pipeline.balance.records import PredictedRecords
from pipeline.balance.sheet import BalanceSheet, Tolerance
from pipeline.balance.unbalance import Estimates
from pipeline.data.vibration_files import to_rpm
from pipeline.identification.quality import finite
from pipeline.ingest.conventions import GRAM_MILLIMETRE, SourceUnits
from pipeline.ingest.records import Records
from pipeline.reporting.blocks import BLUE, GREY, ORANGE, Axes, Curve, Figure, Panel
from pipeline.reporting.console import say, table
from pipeline.reporting.matplotlib_figures import write_figure
from pipeline.write_numbers import write_number


def tabulate_estimates(
    method: str, estimates: Estimates, planes: Sequence[int], source: SourceUnits
) -> list[dict[str, Any]]:
    """Rows of ``balance.csv`` by a method: one a condition and plane. Angles are those of the recordings."""
    rows: list[dict[str, Any]] = []
    readings, radius = estimates.readings, estimates.radius
    values, given = source.weights(estimates.unbalance), source.weights(readings.unbalance)
    for c, (name, unbalance) in enumerate(zip(readings.names, estimates.found, strict=True)):
        sizes, angle = unbalance.magnitude_interval() / GRAM_MILLIMETRE, np.degrees(unbalance.angle_half_width())
        half, known = unbalance.half_width() / GRAM_MILLIMETRE, readings.unbalance[c]
        for n, node in enumerate(planes):
            within = abs(known[n] - unbalance.value[n]) <= radius[c, n]
            weight = _show_complex("known", given[c, n]) | {"known_within_95": int(within)}
            row: dict[str, Any] = {
                "method": method,
                "condition": name,
                "node": node,
                **_show_complex("unbalance", values[c, n]),
                "magnitude_low_g_mm": sizes[n, 0],
                "magnitude_high_g_mm": sizes[n, 1],
                "angle_band_deg": angle[n],
                "part_band_g_mm": half[n],
                "circle_g_mm": radius[c, n] / GRAM_MILLIMETRE,
                **({} if np.isnan(known[n]) else weight),
                "chance": estimates.chance[c],
                "inconsistent": int(estimates.inconsistent[c]),
                "label_chance": estimates.label_chance[c],
                "contradicted": int(estimates.contradicted[c]),
                "vectors": int((~np.isnan(readings.displacement[c])).sum()),
            }
            rows.append({key: finite(value) if isinstance(value, float) else value for key, value in row.items()})
    return rows


def _show_complex(name: str, value: complex) -> dict[str, float]:
    return {
        f"{name}_re_g_mm": float(value.real),
        f"{name}_im_g_mm": float(value.imag),
        f"{name}_g_mm": float(abs(value)),
        f"{name}_angle_deg": float(np.degrees(np.angle(value))),
    }


def print_estimates(name: str, method: str, rows: Sequence[Mapping[str, Any]], most: int = 40) -> None:
    """The unbalance of every condition, from the rows of a method; of more than ``most`` the first ones and those with
    a remark."""
    planes = list(dict.fromkeys(row["node"] for row in rows))
    conditions = [rows[first : first + len(planes)] for first in range(0, len(rows), len(planes))]
    lines = [
        [by_plane[0]["condition"], *(cell for row in by_plane for cell in _show_plane(row)), _remark(by_plane[0])]
        for by_plane in conditions
    ]
    plain = most - sum(bool(line[-1]) for line in lines) if len(lines) > most else most
    shown = [line for i, line in enumerate(lines) if line[-1] or i < plain]
    table(
        f"{name}: unbalance by {method} (+- 95 %)",
        ["condition", *(f"node {node}, {what}" for node in planes for what in ("g mm", "deg", "known")), "remark"],
        shown,
    )
    if len(shown) < len(lines):
        say(f"{len(lines) - len(shown)} more conditions are in balance.csv")


def _show_plane(row: Mapping[str, Any]) -> list[str]:
    """Size, angle and known weight of a condition in a plane."""
    turn, known = row["angle_band_deg"], row.get("known_g_mm")
    angle = "any" if turn >= 180 else f"{_show_angle(row, 'unbalance')} +- {turn:.1f}"
    given = f"{write_number(known)} at {_show_angle(row, 'known')}" if known else "0"
    return [_show_size(row["unbalance_g_mm"], row["part_band_g_mm"]), angle, "-" if known is None else given]


def _remark(row: Mapping[str, Any]) -> str:
    remarks = {
        "inconsistent": ("no unbalance explains it", "chance"),
        "contradicted": ("contradicts its weights", "label_chance"),
    }
    said = (f"{text} ({write_number(row[chance], digits=1)})" for key, (text, chance) in remarks.items() if row[key])
    return ", ".join(said)


def describe_sheet(
    sheet: BalanceSheet, planes: Sequence[int], source: SourceUnits, tolerance: Tolerance | None
) -> dict[str, Any]:
    """The sheet for ``balance.json``: of each plane the weights, the unbalance before and what remains."""
    before, left, at_most = source.weights(sheet.unbalance), source.weights(sheet.remaining), sheet.at_most()
    return {
        "planes": [
            {
                "node": node,
                "weights": [{"hole": w.hole, "mass_g": 1e3 * w.mass} for w in sheet.weights[n]],
                **_show_complex("unbalance", before[n]),
                **_show_complex("remaining", left[n]),
                "circle_g_mm": finite(sheet.circle[n] / GRAM_MILLIMETRE),
                "remaining_at_most_g_mm": finite(at_most[n] / GRAM_MILLIMETRE),
            }
            for n, node in enumerate(planes)
        ],
        "tolerance": _judge_tolerance(sheet, tolerance),
    }


def print_sheet(title: str, described: Mapping[str, Any]) -> None:
    """Which mass goes into which hole, what remains in each plane, and whether the tolerance holds."""
    rows = []
    for plane in described["planes"]:
        weights = [f"{write_number(w['mass_g'])} g in hole {w['hole']}" for w in plane["weights"]]
        vectors = [
            f"{_show_size(plane[f'{vector}_g_mm'])} at {_show_angle(plane, vector)} deg"
            for vector in ("unbalance", "remaining")
        ]
        bounds = [_show_bound(plane[key]) for key in ("circle_g_mm", "remaining_at_most_g_mm")]
        rows.append([f"node {plane['node']}", ", ".join(weights) or "no weight", *vectors, *bounds])
    table(title, ["plane", "put in", "unbalance, g mm", "remains, g mm", "+- (95 % circle)", "at most (95 %)"], rows)
    verdicts = {"met": "is met", "not met": "is not met", "open": "may or may not be met"}
    for plane in described["tolerance"]:
        permissible = write_number(plane["permissible_g_mm"], digits=3)
        say(
            f"bearing at node {plane['node']}: {_show_size(plane['remaining_g_mm'])} g mm remain "
            f"(at most {_show_bound(plane['at_most_g_mm'])}, 95 %), permissible are {permissible}: "
            f"the tolerance {verdicts[plane['verdict']]}"
        )


def print_fewer(sheets: Sequence[BalanceSheet], planes: Sequence[int], source: SourceUnits) -> None:
    """What at most one, two ... weights a plane leave: whether another screw is worth it."""
    rows = []
    for k, sheet in enumerate(sheets, 1):
        put = [", ".join(f"{write_number(1e3 * w.mass)} g in {w.hole}" for w in ws) or "none" for ws in sheet.weights]
        left = ", ".join(_show_size(float(size)) for size in np.abs(source.weights(sheet.remaining)))
        grams = 1e3 * sum(w.mass for weight in sheet.weights for w in weight)
        vibration = 1e6 * float(np.sqrt(np.nanmean(np.abs(sheet.after) ** 2)))
        rows.append([str(k), *put, left, write_number(vibration, digits=3), write_number(grams)])
    holes = [f"node {node}: in hole" for node in planes]
    header = ["weights a plane at most", *holes, "remain, g mm", "vibration after, um (root mean square)", "g in all"]
    table("would fewer do?", header, rows)


def _judge_tolerance(sheet: BalanceSheet, tolerance: Tolerance | None) -> list[dict[str, Any]]:
    """Of each bearing: met where even the 95 % bound is permissible, not met where the estimate itself is not."""
    if tolerance is None:
        return []
    remaining = tolerance.remaining(sheet.remaining)
    most = bound_size(remaining, tolerance.circle(sheet.covariance, sheet.circle))
    return [
        {
            "node": node,
            "remaining_g_mm": float(left / GRAM_MILLIMETRE),
            "at_most_g_mm": finite(bound / GRAM_MILLIMETRE),
            "permissible_g_mm": float(permissible / GRAM_MILLIMETRE),
            "verdict": "met" if bound <= permissible else "not met" if left > permissible else "open",
        }
        for node, left, bound, permissible in zip(
            tolerance.nodes, np.abs(remaining), most, tolerance.permissible, strict=True
        )
    ]


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
            "speed_rpm": float(rpm),
            "probe": names[p],
            "unit": source.unit,
            "before": finite(before[s, p]),
            "after": finite(after[s, p]),
            "band_95": finite(half[s, p]),
        }
        for s, rpm in enumerate(to_rpm(speeds))
        for p in range(shape[1])
    ]


def print_vibration_change(rows: Sequence[Mapping[str, Any]], unit: str, most: int = 6) -> None:
    """Amplitudes before and after, of more than ``most`` speeds so many that are evenly spread."""
    read = [row for row in rows if row["before"] is not None]
    speeds = sorted({row["speed_rpm"] for row in read})
    every = max(1, -(-len(speeds) // most))
    shown = speeds[::-every]
    table(
        "vibration, zero-to-peak as the recordings have it (+- 95 % of one record)",
        ["probe", "rpm", f"before, {unit}", f"after, {unit}"],
        [
            [
                row["probe"],
                f"{row['speed_rpm']:.0f}",
                write_number(row["before"], digits=3),
                write_number(row["after"], row["band_95"]),
            ]
            for row in read
            if row["speed_rpm"] in shown
        ],
    )
    if len(shown) < len(speeds):
        say(f"{len(speeds) - len(shown)} more speeds are in balance.json")


def _show_bound(size: float | None) -> str:
    return "unknown" if size is None else write_number(size, digits=3)


def _show_size(size: float, known_to: float | None = None, least: float = 1e-3) -> str:
    """In g mm, with its 95 % band where that is known; nothing below the ``least``."""
    return write_number(size, known_to, 3) if size >= least or known_to is not None else "0"


def _show_angle(row: Mapping[str, Any], vector: str) -> str:
    return f"{row[f'{vector}_angle_deg'] % 360:.0f}"


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


def draw_balance(
    path: Path, method: str, estimates: Estimates, planes: Sequence[int], source: SourceUnits, most_names: int = 12
) -> Path:
    """The unbalance of every condition in each plane, polar, as a balancing engineer draws it.

    A panel a plane: estimates with the circle that holds 95 %, and lines from the known weights to them. Conditions
    that no unbalance explains, or that contradict their weights, have another colour, and always their names; the
    others have them where there are at most ``most_names``.
    """
    values, known = source.weights(estimates.unbalance), source.weights(estimates.readings.unbalance)
    radius, remarked = 1e6 * estimates.radius, estimates.inconsistent | estimates.contradicted
    names = estimates.readings.names
    reach = 1.15 * float(np.nanmax(np.abs([*values.ravel(), *known.ravel(), 1e-9])))
    turn, panels = np.exp(2j * np.pi * np.linspace(0, 1, 181)), []
    for n, node in enumerate(planes):
        curves = _draw_grid(reach, turn)
        for c, name in enumerate(names):
            colour = ORANGE if remarked[c] else BLUE
            label = "inconsistent, or contradicts its label" if remarked[c] else f"from the vibration ({method}), 95 %"
            circle = values[c, n] + min(radius[c, n], 4 * reach) * turn
            pair = np.array([known[c, n], values[c, n]])
            texts = [name] if remarked[c] or len(names) <= most_names else []
            curves += [
                Curve(circle.real, circle.imag, "", colour, filled=True, width=0.8),
                Curve(pair.real, np.where(np.isnan(known[c, n]), np.nan, pair.imag), "", colour, width=1.0),
                Curve(pair[:1].real, pair[:1].imag, "known weight", GREY, "none", "+", size=7),
                Curve(pair[1:].real, pair[1:].imag, label, colour, "none", "o", full=True, texts=texts),
            ]
        panels.append(
            Panel(
                f"plane at node {node}: g mm and angle on the shaft",
                "",
                [Axes(curves, "")],
                equal=True,
                bare=True,
                wide=True,
            )
        )
    return write_figure(path, Figure("balance", "", panels, columns=1))


def _draw_grid(reach: float, turn: np.ndarray) -> list[Curve]:
    """Circles of equal size (each a ``turn``) with their numbers, and rays every 45 degrees."""
    step = 10 ** np.floor(np.log10(reach / 2))
    step *= next(k for k in (1, 2, 5, 10) if reach / (k * step) <= 5)
    sizes, rays = np.arange(step, reach, step), reach * np.exp(0.25j * np.pi * np.arange(8))[:, None] * [0, 1]
    lines = (*(size * turn for size in sizes), *rays)
    curves = [Curve(line.real, line.imag, "", GREY, width=0.5, alpha=0.5) for line in lines]
    ends = 0.97 * rays[:, 1]
    return [
        *curves,
        Curve(ends.real, ends.imag, "", GREY, "none", texts=[f"{angle}°" for angle in range(0, 360, 45)]),
        Curve(0 * sizes, sizes, "", GREY, "none", texts=[f"{size:g}" for size in sizes]),
    ]
