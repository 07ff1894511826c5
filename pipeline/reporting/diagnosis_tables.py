"""What the data determine, before any fit: on the terminal, and for files."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from pipeline.coefficients import COEFFICIENTS
from pipeline.data.operating_points import list_columns
from pipeline.data.vibration_files import to_rpm
from pipeline.identification.quality import finite
from pipeline.problem.determination import Determined, Deviations
from pipeline.problem.diagnosis import Diagnosis
from pipeline.reporting.console import table
from pipeline.write_numbers import write_percent


def summarize_diagnosis(diagnosis: Diagnosis) -> dict[str, object]:
    """Return the diagnosis by node; an infinite number is null, since JSON has none."""
    result: dict[str, object] = {}
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
            deviations = {name: finite(100 * np.median(v)) for name, v in diagnosis.relative(node).items()}
            result[str(node)] = shared | {"median_deviation_percent": deviations}
    return result


def tabulate_diagnosis(
    diagnosis: Diagnosis, judged: Sequence[Determined], operating: Mapping[str, np.ndarray]
) -> list[dict[str, object]]:
    """A row a bearing and operating point; the verdicts are those over all points."""
    rows: list[dict[str, object]] = []
    for report in diagnosis.reports:
        for node in report.nodes:
            b = diagnosis.answer.nodes.index(node)
            columns = {
                "speed_rpm": to_rpm(report.speeds),
                **list_columns(operating),
                "unknowns": np.full(len(report.speeds), len(report.unknowns)),
                "rank": report.rank,
                "condition_number": report.condition,
                "orbit_rank": report.orbit_rank,
                "orbit_condition_number": report.orbit_condition,
            }
            columns |= {f"singular_value_{i + 1}": values for i, values in enumerate(report.singular_values.T)}
            columns |= {
                f"{name}_std": diagnosis.deviation[b, :, COEFFICIENTS.index(name)] for name in diagnosis.relative(node)
            }
            verdicts = {
                f"{coefficient.name}_verdict": coefficient.verdict.value
                for coefficient in judged
                if coefficient.node == node
            }
            names, values = list(columns), [column.tolist() for column in columns.values()]
            every = zip(*values, strict=True)
            rows += [{"bearing_node": node, **dict(zip(names, row, strict=True)), **verdicts} for row in every]
    return rows


def print_determined(name: str, expected: Deviations, judged: Sequence[Determined], noise: str) -> None:
    """The verdict on each coefficient, a column a bearing; ``noise`` in words."""
    nodes = expected.table.nodes
    coefficients = list(dict.fromkeys(coefficient.name for coefficient in judged))
    cells = {(each.node, each.name): f"{write_percent(each.deviation, '+- ')}, {each.verdict.value}" for each in judged}
    rows = [[row, *(cells.get((node, row), "") for node in nodes)] for row in coefficients]
    header = ["coefficient", *(f"bearing at node {node}" for node in nodes)]
    table(f"{name}: each coefficient at {noise}, {expected.of} (medians)", header, rows)


def print_diagnosis(name: str, diagnosis: Diagnosis, noise: str) -> None:
    """Rank, condition and the worst coefficient of each bearing; ``noise`` in words."""
    header = ["bearing", "rank", "orbits", "condition (median)", "worst", "worst coefficient", "determined least"]
    rows = []
    for report in diagnosis.reports:
        coefficient, deviation = diagnosis.worst(report)
        size = write_percent(deviation, "+- ") if np.isfinite(deviation) else "free"
        rows.append(
            [
                report.where,
                f"{int(np.median(report.rank))} of {len(report.unknowns)}",
                "" if np.isnan(report.orbit_rank).any() else f"{int(np.median(report.orbit_rank))} of 2",
                f"{np.median(report.condition):.3g}",
                f"{report.condition.max():.3g}",
                f"{coefficient} {size}",
                report.free_combination(),
            ]
        )
    table(f"{name}: what the data determine at each speed, at {noise} (medians)", header, rows)
