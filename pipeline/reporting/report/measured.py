"""The machine: a sketch and the tables of its parts; and what was measured of it.

That is Bode and polar plots, orbits, and what time signals show beyond 1X.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from pipeline.data.dataset import Excitation, synchronous
from pipeline.data.operating import split_states
from pipeline.data.vibration_files import to_rpm
from pipeline.ingest.conventions import SourceUnits
from pipeline.ingest.full_spectrum import FullSpectra
from pipeline.reporting.blocks import (
    BLACK,
    BLUE,
    GREEN,
    GREY,
    ORANGE,
    PURPLE,
    RPM,
    Amplitude,
    Axes,
    Block,
    Cell,
    Curve,
    Figure,
    HeatMap,
    Mark,
    Panel,
    Table,
)
from pipeline.reporting.content import ReportContent, View
from pipeline.reporting.measured_figures import (
    AMPLITUDE,
    BODE,
    ORBITS,
    draw_bode_panels,
    draw_orbit_panels,
    name_point,
    pick_speeds,
)
from pipeline.write_numbers import count, write_number

_SHAFT, _DISC = 0.16, 0.75
"""Half heights in the sketch of shaft and discs whose diameters are not known."""


def describe_machine(content: ReportContent) -> list[Block]:
    """Sketch, bearings, probes and runs."""
    rotor, source = content.measurement.rotor, content.config.machine.rotor.file
    return [
        f"Rotor of {write_number(rotor.total_mass)} kg, {count(rotor.n_nodes, 'node')} over "
        f"{write_number(float(rotor.positions[-1]))} m"
        + (f", from the file {source}" if source else "")
        + f"; {count(len(rotor.bearing_nodes), 'bearing')}, {count(len(rotor.disc_nodes), 'disc')}, "
        f"{count(len(content.probes), 'probe')}. Node numbers start at 0.",
        _draw_sketch(content),
        _list_probes(content),
        _list_runs(content),
    ]


def _draw_sketch(content: ReportContent) -> Figure:
    rotor, data = content.measurement.rotor, content.dataset
    x, bearings, (curves, shaft) = rotor.view_positions, list(rotor.bearing_nodes), _draw_bodies(content)
    beside = shaft + 0.14
    probes = sorted({probe.node for probe in content.probes}) if len(content.probes) < 2 * rotor.n_nodes else []
    acting = {kind: sorted({e.node for e in data.excitations if e.kind == kind}) for kind in ("unbalance", "force")}
    marks: tuple[tuple[list[int], float, str, str, str, dict[str, Any]], ...] = (
        (list(range(rotor.n_nodes)), 0.0, "node", BLACK, "o", {"full": True, "size": 2.5}),
        (bearings, -beside, "bearing", BLUE, "^", {}),
        (bearings, beside, "", BLUE, "v", {}),
        (bearings, -1.32, "", BLUE, "", {"texts": [f"node {node}" for node in bearings]}),
        (probes, 1.05, "probes", GREEN, "D", {}),
        (acting["unbalance"], 1.25, "weights", ORANGE, "s", {}),
        (acting["force"], 1.45, "forces", PURPLE, "s", {}),
    )
    curves += [
        Curve(x[nodes], np.full(len(nodes), height), label, colour, "none", marker, **look)
        for nodes, height, label, colour, marker, look in marks
        if nodes
    ]
    return Figure(
        "sketch",
        "The machine as it is modelled; radii are drawn larger than lengths. Dots are nodes."
        + ("" if probes else " Probes see x and y at every node."),
        [Panel("", "position along the shaft (m)", [Axes(curves, "", y_range=(-1.5, 1.65))], wide=True, bare=True)],
    )


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
    positions = content.measurement.rotor.view_positions
    rows = [
        [p.name, f"{p.node}", write_number(1e3 * float(positions[p.node])), f"{p.angle:g}"]
        for p in content.shown_probes
    ]
    return Table(
        "Probes" + " (those that are drawn)" * (len(rows) < len(content.probes)),
        ["probe", "node", "position, mm", "angle from x towards y, deg"],
        rows,
    )


def _list_runs(content: ReportContent, most: int = 30) -> Table:
    data, rows = content.dataset, []
    for r, run in enumerate(data.runs):
        acting = [excitation for excitation in data.excitations if excitation.run == run and excitation.magnitude]
        use = "predicted, not fitted" if content.held_out(r) else "fitted" if content.fit else ""
        turning, hertz = synchronous(data.frequencies[:, r], data.speeds).all(), data.frequencies[:, r] / (2 * np.pi)
        constant = np.ptp(hertz) < 1e-9 * hertz[0]
        at = "rotor speed" if turning else f"{write_number(float(hertz[0]))} Hz" if constant else "own ratio"
        rows.append(
            [run, "; ".join(describe_excitation(content.source, each) for each in acting) or "nothing", at, use]
        )
    if len(rows) > most:
        rows = [*rows[: most - 1], [f"and {len(rows) - most + 1} more", "", "", ""]]
    return Table(
        f"Runs; angles of weights are {content.counted}", ["run", "excited by", "frequency", "use"], rows
    ).without_blank()


def describe_excitation(source: SourceUnits, excitation: Excitation) -> str:
    """Such as ``node 2: 200 g mm at 30°``, a weight as the machine's file has it, a force from x towards y."""
    if excitation.kind == "unbalance":
        weight = source.weights(excitation.magnitude * np.exp(1j * excitation.phase))
        angle = round(float(np.degrees(np.angle(weight))), 9) % 360
        return f"node {excitation.node}: {describe_weight(float(np.abs(weight)), angle)}"
    size = f"{write_number(excitation.magnitude)} N {excitation.whirl}"
    return f"node {excitation.node}: {size} at {write_number(float(np.degrees(excitation.phase)))}°"


def describe_weight(size: float, angle: float) -> str:
    """Such as ``200 g mm at 30°``."""
    return f"{write_number(size)} g mm at {write_number(angle)}°"


def describe_measured(content: ReportContent) -> list[Block]:
    """1X vectors of the probes, before any fit."""
    subtracted = (
        f"The run {content.config.data.baseline} is the machine as it was found. It is subtracted from the other runs "
        "that turn with the rotor, and with it residual unbalance and runout."
    )
    left = {
        "probes": len(content.probes) - len(content.shown_probes),
        "runs": len(content.dataset.runs) - len(content.shown_runs),
    }
    sentences = [
        "All figures here show readings, not the model.",
        *([] if content.baseline() is None else [subtracted]),
        *(f"{number} further {name} are not shown." for name, number in left.items() if number),
    ]
    return [
        " ".join(sentences),
        *(
            Mark("warning", f"{note[:1].upper()}{note[1:]}.")
            for note in content.files.get("ingest", {}).get("notes", [])
        ),
        _list_peaks(content),
        _draw_bode(content),
        _draw_polar(content),
        *_draw_orbits(content),
        *_draw_waveforms(content),
    ]


def _list_peaks(content: ReportContent) -> Table:
    rows: list[list[Cell]] = []
    for probe in content.shown_probes:
        size = np.abs(probe.read(content.dataset.displacement))
        s, r = np.unravel_index(size.argmax(), size.shape)
        rows.append(
            [probe.name, Amplitude(float(size[s, r])), name_point(content.dataset, int(s)), content.dataset.runs[r]]
        )
    return Table("Largest 1X amplitude of each probe (µm pk-pk)", ["probe", "amplitude", "at", "run"], rows)


def _draw_bode(content: ReportContent) -> Figure:
    """With the machine as it was found, where that was subtracted."""
    data, runs = content.dataset, len(content.dataset.runs)
    displacement, traces = data.displacement, content.traces()
    if (baseline := content.baseline()) is not None:
        look = {"colour": GREY, "dash": "dot", "width": 1.2, "label": f"{content.config.data.baseline} (as found)"}
        displacement = np.concatenate([displacement, baseline[..., None]], axis=2)
        traces = [*((runs, points, look) for _, points in split_states(data.speeds, data.operating)), *traces]
    seen = {_title(probe): probe.read(displacement) for probe in content.shown_probes}
    return Figure("bode", BODE, draw_bode_panels(data.speeds, seen, traces))


def _title(probe: View) -> str:
    return probe.name if probe.name.startswith("node") else f"{probe.name} (node {probe.node}, {probe.angle:g}°)"


def _draw_polar(content: ReportContent) -> Figure:
    panels = []
    for probe in content.shown_probes[:4]:
        curves: list[Curve] = []
        seen, traces = probe.read(content.dataset.displacement), list(content.traces())
        largest = max(traces, key=lambda trace: float(np.abs(seen[trace[1], trace[0]]).max()))
        for run, points, look in traces:
            vectors = seen[points, run]
            curves.append(Curve(-np.degrees(np.angle(vectors)), np.abs(vectors), **look))
            if run == largest[0] and points is largest[1]:
                ticks = _space_evenly(vectors)
                at, texts = vectors[ticks], [f"{content.rpm[s]:.0f}" for s in points[ticks]]
                curves.append(
                    Curve(
                        -np.degrees(np.angle(at)), np.abs(at), "", BLACK, "none", "o", full=True, size=2.5, texts=texts
                    )
                )
        panels.append(Panel(_title(probe), "", [Axes(curves, AMPLITUDE, quantity="amplitude")], polar=probe.angle))
    return Figure(
        "polar",
        "Polar plots, 1X, amplitude in µm pk-pk. Zero lies at the probe; the shaft turns counterclockwise, from x "
        "(right) towards y (up), and the lag counts against it. Numbers are speeds in rpm.",
        tuple(panels),
    )


def _space_evenly(vectors: np.ndarray) -> np.ndarray:
    """Indices of up to five points that lie evenly along the path of ``vectors`` (S,), none at another."""
    path = np.r_[0.0, np.cumsum(np.abs(np.diff(vectors)))]
    at = np.unique(np.searchsorted(path, np.linspace(0, path[-1], 5)).clip(max=len(path) - 1))
    near = np.tril(np.abs(vectors[at][:, None] - vectors[at]) < 0.2 * np.abs(vectors).max(), -1)
    return at[~near.any(axis=1)]


def _draw_orbits(content: ReportContent) -> list[Figure]:
    """Orbits of the bearings' nodes at a few speeds; nothing where no node was seen in x and y."""
    data = content.dataset
    seen = data.orbits
    nodes = [node for node in content.measurement.rotor.bearing_nodes if node in seen] or sorted(seen)
    if not nodes:
        return []
    places = {node: seen[node] for node in nodes[:2]}
    picked = pick_speeds(data)[: 4 if len(nodes) <= 2 else 2]
    return [Figure("orbits", ORBITS, draw_orbit_panels(data, places, picked, content.looks))]


def _draw_waveforms(content: ReportContent, least_move: float = 1e-6) -> list[Figure]:
    """Full spectra and the shaft centreline, where there are time signals that show them.

    A shaft whose mean position moves by less than ``least_move`` (m), as AC-coupled signals have it, has no centreline.
    """
    if not content.spectra:
        return []
    caption = (
        "Full spectra of the run-ups in orders of the rotor speed: positive orders whirl with the rotation, negative "
        "ones against it. Levels are powers of ten of the amplitude in µm pk-pk."
    )
    moves = {title: s for title, s in content.spectra.items() if np.ptp(s.centre, axis=0).max() > least_move}
    shifted = [_draw_centreline(title, spectra) for title, spectra in moves.items()]
    return [
        Figure("spectra", caption, [_draw_spectrum(title, spectra) for title, spectra in content.spectra.items()]),
        *(
            [
                Figure(
                    "centreline",
                    "Mean position of the shaft from the DC part of the probes, against the lowest speed (square).",
                    shifted,
                )
            ]
            if shifted
            else []
        ),
    ]


def _draw_spectrum(title: str, spectra: FullSpectra) -> Panel:
    order = np.argsort(rpm := to_rpm(spectra.speeds))
    levels = np.log10(np.maximum(2e6 * spectra.spectrum[order], 1e-4))
    return Panel(title, "order", [Axes((), RPM)], heat=HeatMap(spectra.orders, rpm[order], levels, "log10 amplitude"))


def _draw_centreline(title: str, spectra: FullSpectra) -> Panel:
    order = np.argsort(spectra.speeds)
    x, y = (spectra.centre[order] - spectra.centre[order[0]]).T
    return Panel(
        title,
        "x (µm)",
        [
            Axes(
                [
                    Curve(x, y, "mean position", GREY, "solid", "o"),
                    Curve(x[:1], y[:1], "lowest speed", BLACK, "none", "s"),
                ],
                "y (µm)",
                quantity="amplitude",
            )
        ],
        equal=True,
    )
