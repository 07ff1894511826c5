"""The verdicts on every bearing and coefficient, as stage=verdict wrote them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from pipeline.reporting.report.content import ReportContent
from pipeline.reporting.report.section import Mark, Paragraph, Section, Table


def describe_verdicts(content: ReportContent) -> Section:
    """What can be trusted, why, and what to do next; one sentence where nothing has judged."""
    found = content.files.get("verdicts")
    title = "Can this be trusted?"
    if not found:
        return Section("verdicts", title, (Paragraph("No verdicts were written: stage=verdict makes them."),))
    blocks: list[Paragraph | Table] = []
    machine = found.get("machine")
    if machine:
        said = f"The machine as a whole: {machine['verdict']}. {_join(machine)}"
        blocks.append(Paragraph(said, warning=machine["verdict"] != "good"))
    bearings = [
        [f"node {one['node']}", Mark(one["verdict"], one["verdict"]), one.get("reason") or "", one.get("next") or ""]
        for one in found.get("bearings", [])
    ]
    if bearings:
        blocks.append(Table("Bearings", ["bearing", "verdict", "why", "next step"], bearings))
    rows = [
        [
            f"node {one['node']} {one['coefficient']}",
            Mark(one["verdict"], one["verdict"]),
            " ".join(one.get("reasons", [])),
            one.get("next") or "",
        ]
        for one in found.get("verdicts", [])
    ]
    blocks.append(Table("Coefficients", ["coefficient", "verdict", "why", "next step"], rows))
    return Section("verdicts", title, tuple(blocks))


def _join(one: Mapping[str, Any]) -> str:
    return " ".join(text for text in (one.get("reason"), one.get("next")) if text)
