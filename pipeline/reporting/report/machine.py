"""The machine: a sketch with bearings, discs, probes and weights, and the tables of its parts."""

from __future__ import annotations

from typing import Any

import numpy as np

from pipeline.data.dataset import Excitation, synchronous
from pipeline.reporting.figure import BLACK, BLUE, GREEN, GREY, ORANGE, PURPLE, Axes, Curve, Figure, Panel
from pipeline.reporting.report.content import ReportContent
from pipeline.reporting.tables import Paragraph, Section, Table
from pipeline.write_numbers import count, write_number

_G_MM = 1e6
_SHAFT, _DISC = 0.16, 0.75
"""Half heights in the sketch of shaft and discs whose diameters are not known."""


def describe_machine(content: ReportContent) -> Section:
    """Sketch, bearings, probes and runs."""
    rotor = content.measurement.rotor
    source = content.config.machine.rotor.file
    text = (
        f"Rotor of {write_number(rotor.total_mass)} kg, {count(rotor.n_nodes, 'node')} over "
        f"{write_number(float(rotor.positions[-1]))} m"
        + (f", from the file {source}" if source else "")
        + f"; {count(len(rotor.bearing_nodes), 'bearing')}, {count(len(rotor.disc_nodes), 'disc')}, "
        f"{count(len(content.probes), 'probe')}. Node numbers start at 0."
    )
    return Section(
        "machine", "Machine", (Paragraph(text), _draw_sketch(content), _list_probes(content), _list_runs(content))
    )


def _draw_sketch(content: ReportContent) -> Figure:
    rotor, data = content.measurement.rotor, content.dataset
    x, bearings, (curves, shaft) = rotor.positions, list(rotor.bearing_nodes), _draw_bodies(content)
    beside = shaft + 0.14
    probes = sorted({probe.node for probe in content.probes}) if len(content.probes) < 2 * rotor.n_nodes else []
    acting = {kind: sorted({e.node for e in data.excitations if e.kind == kind}) for kind in ("unbalance", "force")}
    marks: tuple[tuple[list[int], float, str, str, str, dict[str, Any]], ...] = (
        (list(range(len(x))), 0.0, "node", BLACK, "o", {"full": True, "size": 2.5}),
        (bearings, -beside, "bearing", BLUE, "^", {}),
        (bearings, beside, "", BLUE, "v", {}),
        (bearings, -1.32, "", BLUE, "", {"texts": [f"node {node}" for node in bearings]}),
        (probes, 1.05, "probes", GREEN, "D", {}),
        (acting["unbalance"], 1.25, "weights", ORANGE, "s", {}),
        (acting["force"], 1.45, "forces", PURPLE, "s", {}),
    )
    for nodes, height, label, colour, marker, look in marks:
        places = np.full(len(nodes), height)
        curves += [Curve(x[nodes], places, label, colour, "none", marker, **look)] if nodes else []
    panel = Panel("", "position along the shaft (m)", [Axes(curves, "", y_range=(-1.5, 1.65))], wide=True, bare=True)
    caption = "The machine as it is modelled; radii are drawn larger than lengths. Dots are nodes."
    if not probes:
        caption += " Probes see x and y at every node."
    return Figure("sketch", caption, [panel])


def _draw_bodies(content: ReportContent) -> tuple[list[Curve], float]:
    """Outlines of shaft and discs, and the half height of the shaft; plain bars where a file holds the diameters."""
    x, given, curves, start = content.measurement.rotor.positions, content.config.machine.rotor, [], 0.0
    thickest = max((segment.outer_diameter for segment in given.shaft), default=np.nan)
    largest = max(4 * thickest, *(disc.outer_diameter or 0.0 for disc in given.discs)) if given.shaft else 1.0
    for segment in given.shaft:
        halves = segment.outer_diameter / largest, (segment.end_diameter or segment.outer_diameter) / largest
        curves.append(_draw_box(start, start + segment.length, halves, "shaft", GREY))
        start += segment.length
    curves = curves or [_draw_box(x[0], x[-1], (_SHAFT, _SHAFT), "shaft", GREY)]
    stated = {disc.node: (disc.width, disc.outer_diameter) for disc in given.discs}
    for node in content.measurement.rotor.disc_nodes:
        width, diameter = stated.get(node, (None, None))
        side, half = (width or 0.02 * x[-1]) / 2, diameter / largest if diameter else _DISC
        curves.append(_draw_box(x[node] - side, x[node] + side, (half, half), "disc", BLACK))
    return curves, thickest / largest if given.shaft else _SHAFT


def _draw_box(start: float, stop: float, halves: tuple[float, float], label: str, colour: str) -> Curve:
    x, (first, last) = np.array([start, stop, stop, start, start]), halves
    return Curve(x, np.array([first, last, -last, -first, first]), label, colour, filled=True, width=1.0)


def _list_probes(content: ReportContent) -> Table:
    positions = content.measurement.rotor.positions
    rows = [
        [p.name, f"{p.node}", write_number(1e3 * float(positions[p.node])), f"{p.angle:g}"]
        for p in content.shown_probes
    ]
    caption = "Probes" + (" (those that are drawn)" if len(rows) < len(content.probes) else "")
    return Table(caption, ["probe", "node", "position, mm", "angle from x towards y, deg"], rows)


def _list_runs(content: ReportContent, most: int = 30) -> Table:
    data, rows = content.dataset, []
    for r, run in enumerate(data.runs):
        acting = [excitation for excitation in data.excitations if excitation.run == run and excitation.magnitude]
        use = "predicted, not fitted" if content.held_out(r) else "fitted"
        turning, hertz = synchronous(data.frequencies[:, r], data.speeds).all(), data.frequencies[:, r] / (2 * np.pi)
        constant = np.ptp(hertz) < 1e-9 * hertz[0]
        at = "rotor speed" if turning else f"{write_number(float(hertz[0]))} Hz" if constant else "own ratio"
        rows.append([run, "; ".join(map(describe_excitation, acting)) or "nothing", at, use])
    if len(rows) > most:
        rows = [*rows[: most - 1], [f"and {len(rows) - most + 1} more", "", "", ""]]
    return Table("Runs", ["run", "excited by", "frequency", "use"], rows)


def describe_excitation(excitation: Excitation) -> str:
    """Such as ``node 2: 200 g mm at 30°``; angles are from x towards y at the tacho pulse."""
    if excitation.kind == "unbalance":
        return f"node {excitation.node}: {describe_weight(excitation.magnitude, excitation.phase)}"
    size = f"{write_number(excitation.magnitude)} N {excitation.whirl}"
    return f"node {excitation.node}: {size} at {write_number(float(np.degrees(excitation.phase)))}°"


def describe_weight(magnitude: float, phase: float) -> str:
    """Such as ``200 g mm at 30°``, from kg m and rad."""
    return f"{write_number(_G_MM * magnitude)} g mm at {write_number(float(np.degrees(phase)))}°"
