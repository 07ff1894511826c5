"""Residual unbalance of each plane, and the weights that take it away."""

from __future__ import annotations

import numpy as np

from pipeline.reporting.report.content import ReportContent
from pipeline.reporting.report.section import Paragraph, Section, Table, write_number


def describe_balancing(content: ReportContent) -> Section | None:
    """One row a plane; a sentence where no residual unbalance was identified. None without a fit."""
    if content.fit is None:
        return None
    title, table = "Residual unbalance and correction weights", content.tables.get("residual_unbalance")
    if table is None or not len(table["node"]):
        text = (
            "No residual unbalance was identified: identify.unbalance_planes names no node. With planes there and "
            "loss=response, this section has the correction weights."
        )
        return Section("balancing", title, (Paragraph(text),))
    rows = []
    for node, size, angle, deviation in zip(
        table["node"], table["magnitude"], table["phase_deg"], table["magnitude_std"], strict=True
    ):
        spread = float(np.degrees(np.arcsin(min(deviation / size, 1.0)))) if size > 0 else None
        amount = write_number(1e6 * size, 1e6 * deviation)
        rows.append(
            [
                f"node {node:.0f}",
                amount,
                write_number(_to_shaft(content, angle) % 360, spread),
                amount,
                write_number(_to_shaft(content, angle + 180) % 360, spread),
            ]
        )
    header = ["plane", "unbalance, g mm", "at, deg", "correction, g mm", "at, deg (opposite)"]
    caption = f"Angles {_name_angle(content)}; ± one standard deviation. "
    caption += "Add the correction, or remove as much at the unbalance."
    return Section("balancing", title, (Table(caption, header, rows),))


def _to_shaft(content: ReportContent, phase: float) -> float:
    """The angle (deg) as the machine's file counts those of weights, from an angle from x at the tacho pulse."""
    recordings = content.config.machine.recordings
    if recordings.tacho.angle is None:
        return phase
    tacho = float(np.degrees(recordings.tacho.angle))
    return {"with_rotation": phase - tacho, "against_rotation": tacho - phase}.get(recordings.shaft_angle or "", phase)


def _name_angle(content: ReportContent) -> str:
    return {
        "with_rotation": "are from the tacho mark, with the rotation",
        "against_rotation": "are from the tacho mark, against the rotation",
    }.get(content.config.machine.recordings.shaft_angle or "", "are from x towards y, at the tacho pulse")
