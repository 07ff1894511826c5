"""Figures of the digital twin (paper, Figure 6): modelled as a line, predicted as markers."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from pipeline.data.vibration_files import to_rpm
from pipeline.reporting.figures import BLUE, GREY, ORANGE, draw_markers, figure, legend_above
from pipeline.twin.prediction import PredictedVibration, time_curve

MICROMETRES = 1e6


def _draw(ax: Any, name: str, x: np.ndarray, y: np.ndarray, colour: str) -> None:
    if name == "modelled":
        ax.plot(x, y, color=colour, lw=1.5, label="modelled")
    else:
        draw_markers(ax, x, y, colour, "predicted by the twin")


def time_figure(path: Path, vibration: dict[str, PredictedVibration], at: int) -> Path:
    """Figure 6 (a) and (b): x and y of the node over two turns."""
    with figure(path, 2, 1, 8.0, 5.6, sharex=True) as axes:
        for name, predicted in vibration.items():
            time, curve = time_curve(predicted.displacement[at], predicted.speeds[at])
            for d, colour in enumerate((BLUE, ORANGE)):
                _draw(axes[d, 0], name, 1e3 * time, MICROMETRES * curve[:, d], colour)
                axes[d, 0].set_ylabel(f"{'xy'[d]}-displacement (µm)")
        some = next(iter(vibration.values()))
        axes[0, 0].figure.suptitle(
            f"node {some.node} at {to_rpm(some.speeds)[at]:g} rpm, unbalance never seen in training"
        )
        axes[1, 0].set_xlabel("time (ms)")
        legend_above(axes[0, 0])
    return path


def orbit_figure(path: Path, vibration: dict[str, PredictedVibration], at: int) -> Path:
    """The orbit of the node at one speed."""
    with figure(path, 1, 1, 5.4, 5.2) as axes:
        ax = axes[0, 0]
        for name, predicted in vibration.items():
            _, curve = time_curve(predicted.displacement[at], predicted.speeds[at], turns=1.0)
            _draw(ax, name, MICROMETRES * curve[:, 0], MICROMETRES * curve[:, 1], BLUE)
        some = next(iter(vibration.values()))
        ax.figure.suptitle(f"orbit of node {some.node} at {to_rpm(some.speeds)[at]:g} rpm")
        ax.set_xlabel("x-displacement (µm)")
        ax.set_ylabel("y-displacement (µm)")
        ax.set_aspect("equal", adjustable="datalim")
        legend_above(ax)
    return path


def response_figure(path: Path, vibration: dict[str, PredictedVibration]) -> Path:
    """Amplitude and phase over all speeds, and the error of the prediction."""
    rows = 3 if len(vibration) == 2 else 2
    with figure(path, rows, 2, 10.5, 2.4 * rows, sharex=True) as axes:
        for name, predicted in vibration.items():
            rpm = to_rpm(predicted.speeds)
            for d, colour in enumerate((BLUE, ORANGE)):
                _draw(axes[0, d], name, rpm, MICROMETRES * np.abs(predicted.displacement[:, d]), colour)
                _draw(
                    axes[1, d],
                    name,
                    rpm,
                    np.degrees(np.unwrap(np.angle(predicted.displacement[:, d]))),
                    colour,
                )
                if predicted.deviation is not None:
                    low, high = (
                        MICROMETRES * (np.abs(predicted.displacement[:, d]) + k * predicted.deviation[:, d])
                        for k in (-2, 2)
                    )
                    axes[0, d].fill_between(rpm, np.maximum(low, 1e-12), high, color=colour, alpha=0.25, lw=0)
                axes[0, d].set_title(f"{'xy'[d]} of node {predicted.node}")
        if rows == 3:
            error = vibration["identified"].error_percent(vibration["modelled"])
            for d in range(2):
                axes[2, d].semilogy(rpm, np.maximum(error[:, d], 1e-14), color=GREY, lw=1.2)
        for row, label in zip(axes, ("amplitude (µm)", "phase (deg)", "error (%)"), strict=False):
            row[0].set_ylabel(label)
        for ax in axes[-1]:
            ax.set_xlabel("rotor speed (rpm)")
        for ax in axes[0]:
            ax.set_yscale("log")
        axes[0, 0].legend()
    return path
