"""Figures of the digital twin (paper, Figure 6): modelled as a line, predicted as markers."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from pipeline.data.vibration_files import to_rpm
from pipeline.reporting.figure import (
    BLACK,
    BLUE,
    GREY,
    LOOKS,
    MICROMETRES,
    ORANGE,
    RPM,
    Axes,
    Curve,
    Figure,
    Panel,
    mark,
)
from pipeline.reporting.matplotlib_figures import write_figure
from pipeline.reporting.twin_tables import RAD_S_PER_HERTZ, list_deviations, measure_sizes
from pipeline.twin.mode_deviations import Behaviour
from pipeline.twin.modes import follow_modes
from pipeline.twin.prediction import PredictedVibration, sample_motion


def _draw(name: str, x: np.ndarray, y: np.ndarray, colour: str) -> Curve:
    return Curve(x, y, name, colour) if name == "modelled" else mark(x, y, "predicted by the twin", colour)


def draw_time(path: Path, vibration: Mapping[str, PredictedVibration], at: int, state: str = "") -> Path:
    """Figure 6 (a) and (b): x and y of the node over two turns; ``state`` names the operating conditions."""
    rows: list[list[Curve]] = [[], []]
    for name, predicted in vibration.items():
        time, motion = sample_motion(predicted.displacement[at], predicted.speeds[at])
        for row, shift, colour in zip(rows, motion.T, (BLUE, ORANGE), strict=True):
            row.append(_draw(name, 1e3 * time, MICROMETRES * shift, colour))
    axes = [Axes(row, f"{direction}-displacement (µm)") for direction, row in zip("xy", rows, strict=True)]
    title = f"{_name_place(vibration, at, state)}, unbalance never seen in training"
    return write_figure(path, Figure("time", "", [Panel(title, "time (ms)", axes, wide=True)], columns=1))


def _name_place(vibration: Mapping[str, PredictedVibration], at: int, state: str) -> str:
    predicted = vibration["identified"]
    return f"node {predicted.node} at {to_rpm(predicted.speeds)[at]:g} rpm" + _beside(state)


def _beside(state: str) -> str:
    return f", {state}" if state else ""


def draw_orbit(path: Path, vibration: Mapping[str, PredictedVibration], at: int, state: str = "") -> Path:
    """The orbit of the node at one speed; ``state`` names the operating conditions."""
    curves = []
    for name, predicted in vibration.items():
        x, y = MICROMETRES * sample_motion(predicted.displacement[at], predicted.speeds[at], turns=1.0)[1].T
        curves.append(_draw(name, x, y, BLUE))
    title, axes = f"orbit of {_name_place(vibration, at, state)}", Axes(curves, "y-displacement (µm)")
    return write_figure(
        path, Figure("orbit", "", [Panel(title, "x-displacement (µm)", [axes], equal=True, wide=True)], 1)
    )


def draw_response(path: Path, vibration: Mapping[str, PredictedVibration], state: str = "") -> Path:
    """Amplitude and phase over all speeds, and the error of the prediction; ``state`` names the conditions."""
    identified, panels = vibration["identified"], []
    rpm = to_rpm(identified.speeds)
    for d, (direction, colour) in enumerate(zip("xy", (BLUE, ORANGE), strict=True)):
        sizes, phases, errors = [], [], []
        for name, predicted in vibration.items():
            q = predicted.displacement[:, d]
            phases.append(_draw(name, rpm, np.degrees(np.unwrap(np.angle(q))), colour))
            size, deviation = (values[:, d] for values in measure_sizes(predicted))
            sizes += [Curve(rpm, size, "", colour, "none", band=2 * deviation), _draw(name, rpm, size, colour)]
            if name == "modelled":
                errors.append(Curve(rpm, np.maximum(identified.error_percent(predicted)[:, d], 1e-14), "", GREY))
        axes = [Axes(sizes, "amplitude (µm)", scale="log"), Axes(phases, "phase (deg)")]
        axes += [Axes(errors, "error (%)", scale="log")] * bool(errors)
        panels.append(Panel(f"{direction} of node {identified.node}{_beside(state)}", RPM, axes))
    return write_figure(path, Figure("response", "", panels))


def draw_campbell(path: Path, behaviour: Mapping[str, Behaviour], state: str = "") -> Path:
    """The Campbell diagram and the logarithmic decrements, with two standard deviations either side.

    Modes up to twice the top speed; the modelled machine as lines, the identified one as markers. ``state`` names the
    operating conditions.
    """
    speeds = behaviour["identified"].modes.speeds
    rpm, top = to_rpm(speeds), 2.0 * speeds.max() / RAD_S_PER_HERTZ
    frequencies = [Curve(rpm, speeds / RAD_S_PER_HERTZ, "rotor speed (1X)", GREY, "dash")]
    decrements = [Curve(rpm, np.zeros(len(rpm)), "", GREY, "dash")]
    for name, machine in behaviour.items():
        modes, deviations, order = machine.modes, list_deviations(machine), follow_modes(machine.modes)
        quantities = (
            (modes.frequency / RAD_S_PER_HERTZ, 2 * deviations[0] / RAD_S_PER_HERTZ),
            (modes.logarithmic_decrement, 2 * deviations[1]),
        )
        followed = [[np.take_along_axis(v, order, axis=1) for v in pair] for pair in quantities]
        seen = followed[0][0] <= top  # false for NaN
        for k in np.flatnonzero(seen.any(axis=0)):
            colour = LOOKS[k % len(LOOKS)][0]
            for curves, (values, band) in zip((frequencies, decrements), followed, strict=True):
                line = np.where(seen[:, k], values[:, k], np.nan)
                curves += [Curve(rpm, line, "", colour, "none", band=band[:, k]), _draw(name, rpm, line, colour)]
    critical = np.array([mode.speed for mode in behaviour["identified"].critical]) / RAD_S_PER_HERTZ
    if len(critical):
        frequencies.append(Curve(60.0 * critical, critical, "critical speed", BLACK, "none", "*", full=True, size=8))
    axes = [
        Axes(frequencies, "damped natural\nfrequency (Hz)", y_range=(0.0, top)),
        Axes(decrements, "logarithmic decrement\n(stable above 0)", scale="symlog"),
    ]
    return write_figure(path, Figure("campbell", "", [Panel(state, RPM, axes, wide=True)], columns=1))
