"""The verdicts on every bearing and coefficient, as stage=verdict wrote them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from pipeline.reporting.report.content import ReportContent
from pipeline.reporting.report.section import Cell, Mark, Paragraph, Section, Table
from pipeline.trust.judgement import AS_FELT


def describe_verdicts(content: ReportContent) -> Section:
    """What can be trusted, why, and what to do next; one sentence where nothing has judged."""
    judged = content.files.get("verdicts")
    title = "Can this be trusted?"
    if not judged:
        return Section("verdicts", title, (Paragraph("No verdicts were written: stage=verdict makes them."),))
    blocks: list[Paragraph | Table] = []
    machine = judged.get("machine")
    if machine:
        said = f"The machine as a whole: {machine['verdict']}. {_join(machine)}"
        felt = machine.get("identified", "")
        said += f" What is identified: {felt}." if felt == AS_FELT else ""
        blocks.append(Paragraph(said, warning=machine["verdict"] != "good"))
    bearings: list[list[Cell]] = [
        [
            f"node {bearing['node']}",
            Mark(bearing["verdict"], bearing["verdict"]),
            bearing.get("reason") or "",
            bearing.get("next") or "",
        ]
        for bearing in judged.get("bearings", [])
    ]
    if bearings:
        blocks.append(_make_table("Bearings", ["bearing", "verdict", "why", "next step"], bearings))
    rows: list[list[Cell]] = [
        [
            f"node {entry['node']} {entry['coefficient']}",
            Mark(entry["verdict"], entry["verdict"]),
            " ".join(entry.get("reasons", [])),
            entry.get("next") or "",
        ]
        for entry in judged.get("verdicts", [])
    ]
    blocks.append(_make_table("Coefficients", ["coefficient", "verdict", "why", "next step"], rows))
    return Section("verdicts", title, tuple(blocks))


def list_reservations(content: ReportContent) -> list[Paragraph]:
    """The warning that stands beside all that follows from a rejected model."""
    reservation = content.files.get("verdicts", {}).get("machine", {}).get("reservation")
    return [Paragraph(reservation, warning=True)] if reservation else []


def _make_table(caption: str, header: list[str], rows: list[list[Cell]]) -> Table:
    """The table, without its last column where nothing stands in it."""
    last = len(header) if any(row[-1] for row in rows) else len(header) - 1
    return Table(caption, header[:last], [row[:last] for row in rows])


def _join(entry: Mapping[str, Any]) -> str:
    return " ".join(text for text in (entry.get("reason"), entry.get("next")) if text)
