"""Figures of the digital twin (paper, Figure 6): modelled as a line, predicted as markers."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.data.vibration_files import to_rpm
from pipeline.reporting.figures import (
    BLUE,
    GREY,
    LOOKS,
    MICROMETRES,
    ORANGE,
    draw_band,
    draw_markers,
    open_figure,
    place_legend,
)
from pipeline.reporting.twin_tables import RAD_S_PER_HERTZ
from pipeline.twin.mode_deviations import Behaviour
from pipeline.twin.modes import follow_modes
from pipeline.twin.prediction import PredictedVibration, sample_motion


def _draw(ax: Any, name: str, x: np.ndarray, y: np.ndarray, colour: str) -> None:
    if name == "modelled":
        ax.plot(x, y, color=colour, lw=1.5, label="modelled")
    else:
        draw_markers(ax, x, y, colour, "predicted by the twin")


def draw_time(path: Path, vibration: Mapping[str, PredictedVibration], at: int, state: str = "") -> Path:
    """Figure 6 (a) and (b): x and y of the node over two turns; ``state`` names the operating conditions."""
    with open_figure(path, 2, 1, 8.0, 5.6, sharex=True) as axes:
        for name, predicted in vibration.items():
            time, curve = sample_motion(predicted.displacement[at], predicted.speeds[at])
            for d, colour in enumerate((BLUE, ORANGE)):
                _draw(axes[d, 0], name, 1e3 * time, MICROMETRES * curve[:, d], colour)
                axes[d, 0].set_ylabel(f"{'xy'[d]}-displacement (µm)")
        where = f"node {predicted.node} at {to_rpm(predicted.speeds)[at]:g} rpm{_beside(state)}"
        axes[0, 0].figure.suptitle(f"{where}, unbalance never seen in training")
        axes[1, 0].set_xlabel("time (ms)")
        place_legend(axes[0, 0])
    return path


def _beside(state: str) -> str:
    return f", {state}" if state else ""


def draw_orbit(path: Path, vibration: Mapping[str, PredictedVibration], at: int, state: str = "") -> Path:
    """The orbit of the node at one speed; ``state`` names the operating conditions."""
    with open_figure(path, 1, 1, 5.4, 5.2) as axes:
        ax = axes[0, 0]
        for name, predicted in vibration.items():
            _, curve = sample_motion(predicted.displacement[at], predicted.speeds[at], turns=1.0)
            _draw(ax, name, MICROMETRES * curve[:, 0], MICROMETRES * curve[:, 1], BLUE)
        where = f"at {to_rpm(predicted.speeds)[at]:g} rpm{_beside(state)}"
        ax.figure.suptitle(f"orbit of node {predicted.node} {where}")
        ax.set(xlabel="x-displacement (µm)", ylabel="y-displacement (µm)")
        ax.set_aspect("equal", adjustable="datalim")
        place_legend(ax)
    return path


def draw_response(path: Path, vibration: Mapping[str, PredictedVibration], state: str = "") -> Path:
    """Amplitude and phase over all speeds, and the error of the prediction; ``state`` names the conditions."""
    rows = 1 + len(vibration)
    identified = vibration["identified"]
    rpm = to_rpm(identified.speeds)
    with open_figure(path, rows, 2, 10.5, 2.4 * rows, sharex=True) as axes:
        for d, (direction, colour) in enumerate(zip("xy", (BLUE, ORANGE), strict=True)):
            for name, predicted in vibration.items():
                q = predicted.displacement[:, d]
                _draw(axes[0, d], name, rpm, MICROMETRES * np.abs(q), colour)
                _draw(axes[1, d], name, rpm, np.degrees(np.unwrap(np.angle(q))), colour)
            if identified.deviation is not None:
                size = MICROMETRES * np.abs(identified.displacement[:, d])
                draw_band(axes[0, d], rpm, size, MICROMETRES * identified.deviation[:, d], colour, 1e-12)
            if "modelled" in vibration:
                error = identified.error_percent(vibration["modelled"])[:, d]
                axes[2, d].semilogy(rpm, np.maximum(error, 1e-14), color=GREY, lw=1.2)
            axes[0, d].set(title=f"{direction} of node {identified.node}{_beside(state)}", yscale="log")
            axes[-1, d].set_xlabel("rotor speed (rpm)")
        for row, label in zip(axes, ("amplitude (µm)", "phase (deg)", "error (%)"), strict=False):
            row[0].set_ylabel(label)
        axes[0, 0].legend()
    return path


def draw_campbell(path: Path, behaviour: Mapping[str, Behaviour], state: str = "") -> Path:
    """The Campbell diagram and the logarithmic decrements, with two standard deviations either side.

    Modes up to twice the top speed; the modelled machine as lines, the identified one as markers. ``state`` names the
    operating conditions.
    """
    modes = behaviour["identified"].modes
    rpm, top = to_rpm(modes.speeds), 2.0 * modes.speeds.max() / RAD_S_PER_HERTZ
    with open_figure(path, 2, 1, 8.0, 8.0, sharex=True, height_ratios=(3, 2)) as axes:
        frequencies, decrements = axes[:, 0]
        synchronous = modes.speeds / RAD_S_PER_HERTZ
        frequencies.plot(rpm, synchronous, color=GREY, ls="--", lw=1.2, label="rotor speed (1X)")
        decrements.axhline(0.0, color=GREY, ls="--", lw=1.2)
        for name, machine in behaviour.items():
            _draw_modes(axes[:, 0], name, machine, top)
        frequencies.set(ylabel="damped natural frequency (Hz)", ylim=(0.0, top), title=state)
        decrements.set(xlabel="rotor speed (rpm)", ylabel="logarithmic decrement (stable above 0)")
        decrements.set_yscale("symlog", linthresh=0.1)
        decrements.yaxis.set_major_formatter("{x:g}")
        _show_each_once(frequencies)
    return path


def _draw_modes(axes: Any, name: str, behaviour: Behaviour, top: float) -> None:
    rpm, order = to_rpm(behaviour.modes.speeds), follow_modes(behaviour.modes)

    def follow(values: np.ndarray, scale: float = 1.0) -> np.ndarray:
        return np.take_along_axis(values, order, axis=1) / scale

    hertz = follow(behaviour.modes.frequency, RAD_S_PER_HERTZ)
    seen = hertz <= top  # false for NaN
    lines = [np.where(seen, line, np.nan) for line in (hertz, follow(behaviour.modes.logarithmic_decrement))]
    for k in np.flatnonzero(seen.any(axis=0)):
        colour = LOOKS[k % len(LOOKS)][0]
        for ax, line in zip(axes, lines, strict=True):
            _draw(ax, name, rpm, line[:, k], colour)
        if behaviour.deviations is not None:
            draw_band(
                axes[0], rpm, lines[0][:, k], follow(behaviour.deviations.frequency, RAD_S_PER_HERTZ)[:, k], colour
            )
            draw_band(axes[1], rpm, lines[1][:, k], follow(behaviour.deviations.logarithmic_decrement)[:, k], colour)
    if name == "identified":
        for critical in behaviour.critical:
            speed = critical.speed / RAD_S_PER_HERTZ
            axes[0].plot(60.0 * speed, speed, "k*", ms=11, label="critical speed")


def _show_each_once(ax: Any) -> None:
    """A legend with one entry for all modes of a kind."""
    handles, labels = ax.get_legend_handles_labels()
    first = dict(zip(reversed(labels), reversed(handles), strict=True))
    ax.legend(list(first.values())[::-1], list(first)[::-1], loc="upper left")
