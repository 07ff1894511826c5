"""The machine: a sketch with bearings, discs, probes and weights, and the tables of its parts."""

from __future__ import annotations

import numpy as np

from pipeline.data.dataset import Excitation, synchronous
from pipeline.reporting.figures import BLACK, BLUE, GREEN, GREY, ORANGE, PURPLE
from pipeline.reporting.report.content import ReportContent, count
from pipeline.reporting.report.figure import Axes, Curve, Figure, Panel
from pipeline.reporting.report.section import Paragraph, Section, Table

_G_MM = 1e6
_SHAFT, _DISC = 0.16, 0.75
"""Half heights in the sketch of shaft and discs whose diameters are not known."""


def describe_machine(content: ReportContent) -> Section:
    """Sketch, bearings, probes and runs."""
    rotor = content.measurement.rotor
    source = content.config.machine.rotor.file
    text = (
        f"Rotor of {rotor.total_mass:.4g} kg, {count(rotor.n_nodes, 'node')} over {rotor.positions[-1]:.4g} m"
        + (f", from the file {source}" if source else "")
        + f"; {count(len(rotor.bearing_nodes), 'bearing')}, {count(len(rotor.disc_nodes), 'disc')}, "
        f"{count(len(content.probes), 'probe')}. Node numbers start at 0."
    )
    return Section(
        "machine", "Machine", (Paragraph(text), _draw_sketch(content), _list_probes(content), _list_runs(content))
    )


def _draw_sketch(content: ReportContent) -> Figure:
    rotor = content.measurement.rotor
    x = rotor.positions
    curves = [*_draw_shaft(content), *_draw_discs(content)]
    curves.append(Curve(x, np.zeros(len(x)), "node", BLACK, "none", ".", named=False))
    bearings = x[list(rotor.bearing_nodes)]
    labels = tuple(f"node {node}" for node in rotor.bearing_nodes)
    for side in (-1, 1):
        label, said = ("bearing", labels) if side < 0 else ("", ())
        curves.append(
            Curve(
                bearings,
                np.full(len(bearings), side * (_half(content) + 0.14)),
                label,
                BLUE,
                "none",
                "^" if side < 0 else "v",
                words=(),
            )
        )
        if said:
            curves.append(Curve(bearings, np.full(len(bearings), -1.32), "", BLUE, "none", words=said))
    nodes = sorted({probe.node for probe in content.probes})
    if len(content.probes) < 2 * rotor.n_nodes:
        curves.append(Curve(x[nodes], np.full(len(nodes), 1.05), "probes", GREEN, "none", "D"))
    weights = sorted({excitation.node for excitation in content.dataset.excitations if excitation.kind == "unbalance"})
    forces = sorted({excitation.node for excitation in content.dataset.excitations if excitation.kind == "force"})
    for acting, label, colour, at in ((weights, "weights", ORANGE, 1.25), (forces, "forces", PURPLE, 1.45)):
        if acting:
            curves.append(Curve(x[acting], np.full(len(acting), at), label, colour, "none", "s"))
    axes = Axes(tuple(curves), "", y_range=(-1.5, 1.65))
    panel = Panel("", "position along the shaft (m)", (axes,), wide=True, bare=True)
    caption = "The machine as it is modelled; radii are drawn larger than lengths. Dots are nodes."
    if len(content.probes) >= 2 * rotor.n_nodes:
        caption += " Probes see x and y at every node."
    return Figure("sketch", caption, (panel,))


def _draw_shaft(content: ReportContent) -> list[Curve]:
    """The outline of the shaft; a plain bar where a file holds its diameters."""
    x, shaft = content.measurement.rotor.positions, content.config.machine.rotor.shaft
    if not shaft:
        return [_box(x[0], x[-1], _SHAFT, "shaft", GREY)]
    largest = _largest(content)
    curves, start = [], 0.0
    for i, segment in enumerate(shaft):
        ends = segment.outer_diameter / largest, (segment.end_diameter or segment.outer_diameter) / largest
        outline = np.array([ends[0], ends[1], -ends[1], -ends[0], ends[0]])
        places = start + segment.length * np.array([0, 1, 1, 0, 0])
        curves.append(Curve(places, outline, "shaft", GREY, filled=True, named=i == 0, width=1.0))
        start += segment.length
    return curves


def _draw_discs(content: ReportContent) -> list[Curve]:
    rotor, curves = content.measurement.rotor, []
    stated = {disc.node: disc for disc in content.config.machine.rotor.discs}
    for i, node in enumerate(rotor.disc_nodes):
        disc = stated.get(node)
        width = disc.width if disc and disc.width else 0.02 * rotor.positions[-1]
        half = disc.outer_diameter / _largest(content) if disc and disc.outer_diameter else _DISC
        box = _box(rotor.positions[node] - width / 2, rotor.positions[node] + width / 2, half, "disc", BLACK)
        curves.append(box if i == 0 else Curve(box.x, box.y, "disc", BLACK, filled=True, named=False, width=1.0))
    return curves


def _largest(content: ReportContent) -> float:
    """Diameter (m) that is drawn with a half height of 1."""
    rotor = content.config.machine.rotor
    sizes = [segment.outer_diameter for segment in rotor.shaft] + [d.outer_diameter or 0.0 for d in rotor.discs]
    return max(max(sizes), 4 * max(segment.outer_diameter for segment in rotor.shaft)) if rotor.shaft else 1.0


def _half(content: ReportContent) -> float:
    shaft = content.config.machine.rotor.shaft
    return max(s.outer_diameter for s in shaft) / _largest(content) if shaft else _SHAFT


def _box(start: float, stop: float, half: float, label: str, colour: str) -> Curve:
    x, y = np.array([start, stop, stop, start, start]), half * np.array([1, 1, -1, -1, 1])
    return Curve(x, y, label, colour, filled=True, width=1.0)


def _list_probes(content: ReportContent) -> Table:
    positions = content.measurement.rotor.positions
    rows = [[p.name, f"{p.node}", f"{1e3 * positions[p.node]:.4g}", f"{p.angle:g}"] for p in content.shown_probes]
    caption = "Probes" + (" (those that are drawn)" if len(rows) < len(content.probes) else "")
    return Table(caption, ["probe", "node", "position, mm", "angle from x towards y, deg"], rows)


def _list_runs(content: ReportContent) -> Table:
    data, rows = content.dataset, []
    for r, run in enumerate(data.runs):
        acting = [excitation for excitation in data.excitations if excitation.run == run and excitation.magnitude]
        use = "predicted, not fitted" if content.held_out(r) else "fitted"
        turning = synchronous(data.frequencies[:, r], data.speeds).all()
        hertz = data.frequencies[:, r] / (2 * np.pi)
        at = "rotor speed" if turning else f"{hertz[0]:.4g} Hz" if np.ptp(hertz) < 1e-9 * hertz[0] else "own ratio"
        rows.append([run, "; ".join(map(describe_excitation, acting)) or "nothing", at, use])
    if len(rows) > 30:
        rows = [*rows[:29], [f"and {len(rows) - 29} more", "", "", ""]]
    return Table("Runs", ["run", "excited by", "frequency", "use"], rows)


def describe_excitation(excitation: Excitation) -> str:
    """Such as ``node 2: 200 g mm at 30°``; angles are from x towards y at the tacho pulse."""
    size = (
        f"{_G_MM * excitation.magnitude:.4g} g mm"
        if excitation.kind == "unbalance"
        else f"{excitation.magnitude:.4g} N {excitation.whirl}"
    )
    return f"node {excitation.node}: {size} at {np.degrees(excitation.phase):.4g}°"
