"""Figures of measured vibration, before any fit: Bode plots and orbits, a colour and a dash a run; records; run-ups.

With operating conditions the colour is that of the state, the dash that of the run. Legend: S points, R runs.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.data.dataset import VibrationDataset
from pipeline.data.operating import describe_point
from pipeline.data.vibration_files import to_rpm
from pipeline.reporting.blocks import (
    BLACK,
    BLUE,
    DASHES,
    GREY,
    LOOKS,
    MICROMETRES,
    ORANGE,
    RPM,
    Axes,
    Curve,
    Figure,
    Panel,
)
from pipeline.reporting.coefficient_figures import colour_states, pick_states
from pipeline.reporting.matplotlib_figures import write_figure, write_panel
from pipeline.units import RAD_S_PER_RPM
from pipeline.write_numbers import write_number

if TYPE_CHECKING:
    from pipeline.ingest.exciter import FrequencyResponse
    from pipeline.sweep.fit import ModalFit, RunUp

AMPLITUDE = "amplitude (µm pk-pk)"
BODE = (
    "Bode plots, 1X. The lag is the rotation from the tacho pulse to the next positive peak, the high spot passing the "
    "probe."
)
ORBITS = (
    "1X orbits: their extent is the peak-to-peak amplitude. The dot is the shaft at the tacho pulse (the keyphasor "
    "dot); from it the orbit runs to the gap, and the arrow shows the sense. "
    "x is to the right, y is up, the rotor turns counterclockwise."
)
Trace = tuple[int, np.ndarray, dict[str, Any]]
"""Run, points by ascending speed, and the look of a curve: a run at a state of its conditions."""


def choose_looks(runs: Sequence[str], baseline: str | None = None) -> list[dict[str, Any]]:
    """Colour, dash and label of each run; the baseline is thin and grey."""
    others = [run for run in runs if run != baseline]
    looks: dict[str, dict[str, Any]] = {
        run: {"colour": LOOKS[i % len(LOOKS)][0], "dash": DASHES[i % len(DASHES)], "label": run}
        for i, run in enumerate(others)
    }
    grey = {"colour": GREY, "dash": "dot", "width": 1.2, "label": f"{baseline} (baseline)"}
    return [looks.get(run, grey) for run in runs]


def list_traces(dataset: VibrationDataset, looks: Mapping[int, dict[str, Any]]) -> list[Trace]:
    """The curves of the runs (indices) that have ``looks``, where they were measured."""
    states, traces = pick_states(dataset.speeds, dataset.operating), []
    colours = colour_states(len(states)) if len(states) > 1 else []
    for run, look in looks.items():
        for s, (label, points) in enumerate(states):
            measured = points[dataset.present[points, run]]
            state_look = {"colour": colours[s], "label": f"{look['label']}, {label}"} if colours else {}
            if len(measured):
                traces.append((run, measured, look | state_look))
    return traces


def name_point(dataset: VibrationDataset, point: int) -> str:
    """Its speed, and its conditions where there are any, such as ``3000 rpm, 45 degC``."""
    rpm = write_number(float(to_rpm(dataset.speeds)[point]), digits=5)
    return f"{rpm} rpm{describe_point(dataset.operating, point, ', ')}"


def draw_bode_panels(speeds: np.ndarray, probes: Mapping[str, np.ndarray], traces: Sequence[Trace]) -> list[Panel]:
    """Peak-to-peak amplitude over phase lag, as an analyser shows them; ``probes`` are (S, R) vectors (m) by title."""
    rpm, panels = to_rpm(speeds), []
    marker = "o" if len(rpm) <= 30 else ""
    for title, vectors in probes.items():
        seen = [(rpm[points], vectors[points, run], look | {"marker": marker}) for run, points, look in traces]
        above = [Curve(x, np.abs(v), **look) for x, v, look in seen]
        below = [Curve(x, find_lag(v), **look) for x, v, look in seen]
        panels.append(
            Panel(
                title,
                RPM,
                [Axes(above, AMPLITUDE, quantity="amplitude"), Axes(below, "phase lag (deg)", quantity="lag")],
            )
        )
    return panels


def draw_bode(
    path: Path, dataset: VibrationDataset, baseline: str | None, probes: Mapping[str, tuple[int, float]]
) -> Path:
    """Bode plots of every probe and run.

    ``probes`` are node and angle (degrees) by name; the ``dataset`` has them, or x and y of their nodes.
    """
    seen = {f"{name}: node {node}, {angle:g}°": dataset.project(node, angle) for name, (node, angle) in probes.items()}
    traces = list_traces(dataset, dict(enumerate(choose_looks(dataset.runs, baseline))))
    return write_figure(path, Figure("bode", BODE, draw_bode_panels(dataset.speeds, seen, traces)))


def draw_responses(path: Path, probes: Sequence[str], tests: Sequence[FrequencyResponse]) -> Path:
    """Displacement over force of every probe and run, with its band, over its coherence."""
    panels, looks = [], choose_looks([test.run.name for test in tests])
    for p, probe in enumerate(probes):
        above = [
            Curve(
                test.frequencies,
                MICROMETRES * np.abs(test.response[:, p]),
                **look,
                deviation=MICROMETRES * test.noise[:, p] / np.sqrt(2),  # of the amplitude alone
            )
            for look, test in zip(looks, tests, strict=True)
        ]
        below = [Curve(t.frequencies, t.coherence[:, p], **look) for look, t in zip(looks, tests, strict=True)]
        axes = [
            Axes(above, "displacement over force (µm/N)", scale="log"),
            Axes(below, "coherence", y_range=(0.0, 1.0)),
        ]
        panels.append(Panel(probe, "frequency (Hz)", axes))
    caption = "Averaged responses to the measured force, with their bands."
    return write_figure(path, Figure("responses", caption, panels))


def find_lag(vectors: np.ndarray) -> np.ndarray:
    """(S,) phase lag in degrees of V = A e^{-j lag}, without jumps, from 0 to 360 at the first speed."""
    lag = np.unwrap(-np.angle(vectors))
    return np.asarray(np.degrees(lag - 2 * np.pi * np.floor(lag[0] / (2 * np.pi))))


def draw_orbit_panels(
    dataset: VibrationDataset,
    nodes: Mapping[int, np.ndarray],
    picked: Sequence[int],
    looks: Mapping[int, dict[str, Any]],
) -> list[Panel]:
    """A panel a node and point that was ``picked``; ``nodes`` have their x and y (S, 2, R), complex, m."""
    panels = []
    for node, places in nodes.items():
        for s in picked:
            shown = [run for run in looks if dataset.present[s, run]]
            reach = float(np.abs(places[s][:, shown]).max(initial=0.0))
            curves = [curve for run in shown for curve in _draw_orbit(places[s, :, run], looks[run], reach)]
            panels.append(
                Panel(
                    f"node {node}, {name_point(dataset, s)}",
                    "x (µm)",
                    [Axes(curves, "y (µm)", quantity="amplitude")],
                    equal=True,
                )
            )
    return panels


def _draw_orbit(vector: np.ndarray, look: dict[str, Any], reach: float) -> list[Curve]:
    """The orbit of x and y (2,), its keyphasor dot and an arrow head at a quarter turn; ``reach`` (m) is its scale."""
    turn = np.exp(2j * np.pi * np.linspace(0, 0.94, 120))
    x, y = ((v * turn).real for v in vector)
    tangent, place = np.array([x[31] - x[29], y[31] - y[29]]), np.array([x[30], y[30]])
    arrow = tangent / (np.linalg.norm(tangent) or 1.0) * 0.07 * reach
    across = np.array([-arrow[1], arrow[0]]) * 0.6
    head = np.stack([place - arrow + across, place + arrow, place - arrow - across, place - arrow + across])
    return [
        Curve(x, y, **look),
        Curve(head[:, 0], head[:, 1], "", look["colour"], filled=True),
        Curve(x[:1], y[:1], "", look["colour"], "none", "o", full=True),
    ]


def draw_measured_orbits(path: Path, dataset: VibrationDataset, baseline: str | None) -> Path:
    """Orbits of every node seen in x and y at several speeds, that of the largest amplitude among them.

    A dot stands at the pulse, an arrow shows the sense in which each is run through; the rotor turns counterclockwise.
    """
    picked = pick_speeds(dataset)
    panels = draw_orbit_panels(dataset, dataset.orbits, picked, dict(enumerate(choose_looks(dataset.runs, baseline))))
    return write_figure(path, Figure("orbits", ORBITS, panels, columns=len(picked)))


def pick_speeds(dataset: VibrationDataset) -> list[int]:
    """Up to four indices: first, last, the largest amplitude, and one half way along the longest gap."""
    count = len(dataset.speeds)
    peak = int(np.abs(dataset.displacement).max(axis=(1, 2)).argmax())
    picked = sorted({0, peak, count - 1})
    while len(picked) < min(4, count):
        gaps = np.diff(picked)
        widest = int(gaps.argmax())
        picked = sorted({*picked, picked[widest] + int(gaps[widest]) // 2})
    return picked


def group_speeds(speeds: np.ndarray, digits: int, most: int = 12) -> Iterator[tuple[str, np.ndarray]]:
    """Ranges of ``speeds`` (S,) rad/s in rpm, such as ``708 to 950``, and their indices; each speed where few."""
    for rows in np.array_split(np.arange(len(speeds)), min(most, len(speeds))):
        yield " to ".join(dict.fromkeys(f"{rpm:.{digits}f}" for rpm in to_rpm(speeds[rows[[0, -1]]]))), rows


def draw_records(path: Path, dataset: VibrationDataset, probes: Sequence[str]) -> Path:
    """The vector of every record in the complex plane, a panel a probe (along) and speed (down); S, P, R as above."""
    panels = []
    for rpm, rows in group_speeds(dataset.speeds, 0):
        vectors = MICROMETRES * dataset.displacement[rows].swapaxes(0, 1)[:, dataset.present[rows]]
        ends, middle = 1.1 * np.abs(vectors).max() * np.array([-1.0, 1.0]), np.zeros(2)
        cross = [Curve(x, y, "", GREY, width=0.8) for x, y in ((ends, middle), (middle, ends))]
        for name, seen in zip(probes, vectors, strict=True):
            axes = Axes([*cross, Curve(seen.real, seen.imag, "", BLUE, "none", "o", size=3)], "imaginary part (µm)")
            panels.append(Panel(f"{name}, {rpm} rpm", "real part (µm)", [axes], equal=True))
    return write_figure(path, Figure("records", "", panels, columns=len(probes)))


def draw_run_up(path: Path, run_up: RunUp, fit: ModalFit, steady: np.ndarray, probe: str) -> Path:
    """Amplitude and phase of a run-up over the speed: measured, the ramp's model, the same modes at constant speeds.

    Markers are measured, the line is the model of the ramp, dashes are its ``steady`` (S,).
    """
    modes = " and ".join(f"{write_number(float(speed))} rpm" for speed in to_rpm(fit.frequencies))
    rpm, above, below = to_rpm(run_up.speeds), [], []
    for vectors, *look in (
        (run_up.vectors, "measured", BLACK, "none", "o"),
        (fit.fitted, f"ramp modelled, {modes}", BLUE, "solid", ""),
        (steady, "the same modes at constant speeds", ORANGE, "dash", ""),
    ):
        above.append(Curve(rpm, MICROMETRES * np.abs(vectors), *look))
        # Without jumps, and between -180 and 180 at the first row.
        below.append(Curve(rpm, np.degrees(np.unwrap(-np.angle(vectors))), *look))
    return write_panel(
        path,
        Panel(
            f"{probe}, {write_number(run_up.rate / RAD_S_PER_RPM)} rpm/s",
            RPM,
            [Axes(above, "amplitude (µm, zero to peak)"), Axes(below, "phase lag (deg)")],
            wide=True,
        ),
    )
