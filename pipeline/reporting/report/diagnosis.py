"""What the data determine, before any fit."""

from __future__ import annotations

from pipeline.coefficients import COEFFICIENTS
from pipeline.reporting.report.content import ReportContent
from pipeline.reporting.report.section import Paragraph, Section, Table, write_number


def describe_diagnosis(content: ReportContent) -> Section | None:
    """Rank, condition number and predicted deviations of each bearing; None where nothing was diagnosed."""
    diagnosis = content.files.get("diagnosis")
    if not diagnosis:
        return None
    noise = diagnosis["stated_noise"]
    rows, blocks = [], []
    for node, bearing in diagnosis["bearings"].items():
        rank, condition = bearing["rank"], bearing["condition_number"]
        rows.append(
            [
                f"node {node}",
                bearing["verdict"],
                f"{_describe_range(rank['least'], rank['most'])} of {bearing['unknowns']}",
                f"{write_number(condition['median'], digits=3)}, worst {write_number(condition['max'], digits=3)}",
                bearing["least_determined"],
            ]
        )
        if bearing["reason"]:
            blocks.append(Paragraph(f"Bearing at node {node}: {bearing['reason']}", warning=True))
    text = (
        f"At each speed by itself, at {100 * noise['multiplicative']:g} % and {1e6 * noise['additive']:g} µm noise "
        "(root mean square, zero-to-peak). A fit over all speeds does better: its own deviations follow below."
    )
    header = ["bearing", "verdict", "rank", "condition number", "determined least"]
    table = Table("What the readings tell of each bearing", header, rows)
    return Section("diagnosis", "Diagnosis", (Paragraph(text), *blocks, table, *_list_expected(content)))


def _describe_range(least: int, most: int) -> str:
    return f"{least}" if least == most else f"{least} to {most}"


def _list_expected(content: ReportContent) -> list[Table]:
    """The deviation that the fit is expected to leave to each coefficient, in percent."""
    judged = content.files["diagnosis"].get("determined")
    if not judged or not judged.get("coefficients"):
        return []
    nodes = list(judged["coefficients"])
    rows = []
    for name in COEFFICIENTS:
        cells = [judged["coefficients"][node].get(name) for node in nodes]
        if any(cells):
            rows.append([name, *(_describe(cell) for cell in cells)])
    header = ["coefficient", *(f"bearing at node {node}" for node in nodes)]
    return [Table(f"Expected standard deviation, {judged['by']} (median over the speed)", header, rows)]


def _describe(cell: dict[str, object] | None) -> str:
    if not cell:
        return "known"
    percent = cell["deviation_percent"]
    return f"{write_number(percent if isinstance(percent, float) else None, digits=2)} %, {cell['verdict']}"
