"""What was measured: Bode and polar plots, orbits, and what time signals show beyond 1X."""

from __future__ import annotations

from typing import Any

import numpy as np

from pipeline.data.operating import split_states
from pipeline.reporting.figures import BLACK, GREY
from pipeline.reporting.ingest_figures import find_lag, pick_speeds
from pipeline.reporting.report.content import ReportContent, View, Waveforms
from pipeline.reporting.report.figure import Axes, Curve, Figure, HeatMap, Panel
from pipeline.reporting.report.section import Amplitude, Block, Cell, Paragraph, Section, Table

RPM = "rotor speed (rpm)"
AMPLITUDE = "amplitude (µm pk-pk)"
_LEAST_MOVE = 1e-6
"""m; a shaft whose mean position moves by less, as AC-coupled signals have it, has no centreline to draw."""


def describe_measured(content: ReportContent) -> Section:
    """1X vectors of the probes, before any fit."""
    text = "All figures here show readings, not the model."
    if content.baseline() is not None:
        text += (
            f" The run {content.config.data.baseline} is the machine as it was found. It is subtracted from the other "
            "runs that turn with the rotor, and with it residual unbalance and runout."
        )
    left = len(content.probes) - len(content.shown_probes), len(content.dataset.runs) - len(content.shown_runs)
    for number, name in zip(left, ("probes", "runs"), strict=True):
        if number:
            text += f" {number} further {name} are not shown."
    blocks: list[Block] = [
        Paragraph(text),
        *_write_notes(content),
        _list_peaks(content),
        _draw_bode(content),
        _draw_polar(content),
    ]
    orbits = _draw_orbits(content)
    blocks += [orbits] if orbits is not None else []
    return Section("measured", "What was measured", (*blocks, *_draw_waveforms(content)))


def _write_notes(content: ReportContent) -> list[Paragraph]:
    return [
        Paragraph(note[:1].upper() + note[1:] + ".", warning=True)
        for note in content.files.get("ingest", {}).get("notes", [])
    ]


def _list_peaks(content: ReportContent) -> Table:
    rows: list[list[Cell]] = []
    for probe in content.shown_probes:
        size = np.abs(content.dataset.displacement.transpose(0, 2, 1) @ probe.weights)  # (S, R)
        s, r = np.unravel_index(size.argmax(), size.shape)
        rows.append([probe.name, Amplitude(float(size[s, r])), content.name_point(int(s)), content.dataset.runs[r]])
    return Table("Largest 1X amplitude of each probe (µm pk-pk)", ["probe", "amplitude", "at", "run"], rows)


def vectors_of(content: ReportContent, probe: View, run: int) -> np.ndarray:
    """(S,) complex, m: what a probe read in a run."""
    return np.asarray(content.dataset.displacement[..., run] @ probe.weights)


def _draw_bode(content: ReportContent) -> Figure:
    panels = []
    baseline = content.baseline()
    few = "o" if len(content.rpm) <= 12 else ""
    for probe in content.shown_probes:
        above, below = [], []
        drawn: list[tuple[np.ndarray, np.ndarray, dict[str, Any]]] = []
        if baseline is not None:
            style: dict[str, Any] = {"colour": GREY, "dash": "dot", "width": 1.2}
            style["label"] = f"{content.config.data.baseline} (as found)"
            states = split_states(content.dataset.speeds, content.dataset.operating)
            drawn += [(points, (baseline @ probe.weights)[points], style) for _, points in states]
        for r in content.shown_runs:
            vectors = vectors_of(content, probe, r)
            drawn += [(points, vectors[points], look | {"marker": few}) for points, look in content.traces(r)]
        for points, vectors, look in drawn:
            above.append(Curve(content.rpm[points], np.abs(vectors), **look))
            below.append(Curve(content.rpm[points], find_lag(vectors), **look))
        axes = (
            Axes(tuple(above), AMPLITUDE, amplitude=True),
            Axes(tuple(below), "phase lag (deg)", lag=True),
        )
        panels.append(Panel(_title(probe), RPM, axes))
    caption = (
        "Bode plots, 1X. The lag is the rotation from the tacho pulse to the next positive peak, the high spot passing "
        "the probe."
    )
    return Figure("bode", caption, tuple(panels))


def _title(probe: View) -> str:
    return probe.name if probe.name.startswith("node") else f"{probe.name} (node {probe.node}, {probe.angle:g}°)"


def _draw_polar(content: ReportContent) -> Figure:
    panels = []
    for probe in content.shown_probes[:4]:
        curves = []
        for r in content.shown_runs:
            for points, look in content.traces(r):
                vectors = vectors_of(content, probe, r)[points]
                curves.append(Curve(-np.degrees(np.angle(vectors)), np.abs(vectors), **look))
                if len(curves) > 1:
                    continue
                ticks = _space_evenly(vectors)
                labels = tuple(f"{content.rpm[s]:.0f}" for s in points[ticks])
                at = vectors[ticks]
                curves.append(
                    Curve(-np.degrees(np.angle(at)), np.abs(at), "", BLACK, "none", ".", words=labels, named=False)
                )
        panels.append(Panel(_title(probe), "", (Axes(tuple(curves), AMPLITUDE, amplitude=True),), polar=probe.angle))
    caption = (
        "Polar plots, 1X, amplitude in µm pk-pk. Zero lies at the probe; the shaft turns counterclockwise, from x "
        "(right) towards y (up), and the lag counts against it. Numbers are speeds in rpm."
    )
    return Figure("polar", caption, tuple(panels))


def _space_evenly(vectors: np.ndarray) -> np.ndarray:
    """Indices of five points that lie evenly along the path of ``vectors`` (S,)."""
    path = np.r_[0.0, np.cumsum(np.abs(np.diff(vectors)))]
    return np.unique(np.searchsorted(path, np.linspace(0, path[-1], 5)).clip(max=len(path) - 1))


def _draw_orbits(content: ReportContent) -> Figure | None:
    """Orbits of the bearings' nodes at a few speeds; None where no node was seen in x and y."""
    data = content.dataset
    dof, resolution = data.resolution()
    nodes = [node for node in content.measurement.rotor.bearing_nodes if {4 * node, 4 * node + 1} <= set(dof.tolist())]
    nodes = nodes or sorted({int(d) // 4 for d in dof if d % 4 == 0 and d + 1 in dof})
    if not nodes:
        return None
    picked = pick_speeds(data)[: 4 if len(nodes) <= 2 else 2]
    panels = []
    for node in nodes[:2]:
        rows = resolution[[int(np.flatnonzero(dof == 4 * node + d)[0]) for d in range(2)]]
        for s in picked:
            curves: list[Curve] = []
            reach = float(np.abs(rows @ data.displacement[s][:, list(content.shown_runs)]).max())
            for r in content.shown_runs:
                if data.present[s, r]:
                    curves += _draw_orbit(rows @ data.displacement[s, :, r], content.look(r), reach)
            axes = Axes(tuple(curves), "y (µm)", amplitude=True)
            panels.append(Panel(f"node {node}, {content.name_point(s)}", "x (µm)", (axes,), equal=True))
    caption = (
        "1X orbits: their extent is the peak-to-peak amplitude. The dot is the shaft at the tacho pulse (the "
        "keyphasor dot); from it the orbit runs to the gap, and the arrow shows the sense. "
        "x is to the right, y is up, the rotor turns counterclockwise."
    )
    return Figure("orbits", caption, tuple(panels))


def _draw_orbit(vector: np.ndarray, look: dict[str, Any], reach: float) -> list[Curve]:
    """The orbit of x and y (2,), its keyphasor dot and an arrow head at a quarter turn; ``reach`` (m) is its scale."""
    turn = np.exp(2j * np.pi * np.linspace(0, 0.94, 120))
    x, y = ((v * turn).real for v in vector)
    colour = look["colour"]
    tangent, place = np.array([x[31] - x[29], y[31] - y[29]]), np.array([x[30], y[30]])
    arrow = tangent / (np.linalg.norm(tangent) or 1.0) * 0.07 * reach
    across = np.array([-arrow[1], arrow[0]]) * 0.6
    head = np.stack([place - arrow + across, place + arrow, place - arrow - across, place - arrow + across])
    return [
        Curve(x, y, **look),
        Curve(head[:, 0], head[:, 1], "", colour, filled=True, named=False),
        Curve(x[:1], y[:1], "", colour, "none", ".", named=False),
    ]


def _draw_waveforms(content: ReportContent) -> list[Figure]:
    """Full spectra and the shaft centreline, where there are time signals that show them."""
    if not content.waveforms:
        return []
    panels = tuple(_draw_spectrum(waveform) for waveform in content.waveforms)
    caption = (
        "Full spectra of the run-ups in orders of the rotor speed: positive orders whirl with the rotation, negative "
        "ones against it. Levels are powers of ten of the amplitude in µm pk-pk."
    )
    figures = [Figure("spectra", caption, panels)]
    centrelines = [waveform for waveform in content.waveforms if np.ptp(waveform.centre, axis=0).max() > _LEAST_MOVE]
    if centrelines:
        caption = "Mean position of the shaft from the DC part of the probes, against the lowest speed (square)."
        figures.append(Figure("centreline", caption, tuple(_draw_centreline(waveform) for waveform in centrelines)))
    return figures


def _draw_spectrum(waveforms: Waveforms) -> Panel:
    rpm = waveforms.speeds * 30 / np.pi
    order = np.argsort(rpm)
    levels = np.log10(np.maximum(2e6 * waveforms.spectrum[order], 1e-4))
    heat = HeatMap(waveforms.orders, rpm[order], levels, "log10 amplitude")
    return Panel(f"{waveforms.run}, node {waveforms.node}", "order", (Axes((), RPM),), heat=heat)


def _draw_centreline(waveforms: Waveforms) -> Panel:
    order = np.argsort(waveforms.speeds)
    place = waveforms.centre[order] - waveforms.centre[order[0]]
    curves = (
        Curve(place[:, 0], place[:, 1], waveforms.run, GREY, "solid", "o", named=False),
        Curve(place[:1, 0], place[:1, 1], "lowest speed", BLACK, "none", "s", named=False),
    )
    axes = Axes(curves, "y (µm)", amplitude=True)
    return Panel(f"{waveforms.run}, node {waveforms.node}", "x (µm)", (axes,), equal=True)
