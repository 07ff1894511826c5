"""Amplitude and phase of a run-up over the speed: measured, the ramp's model, and the same modes at constant speeds."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from pipeline.data.vibration_files import to_rpm
from pipeline.reporting.figures import BLACK, BLUE, MICROMETRES, ORANGE, open_figure
from pipeline.sweep.fit import ModalFit, RunUp
from pipeline.units import RAD_S_PER_RPM


def draw_run_up(path: Path, run_up: RunUp, fit: ModalFit, steady: np.ndarray, probe: str) -> Path:
    """Write the figure: markers are measured, the line is the model of the ramp, dashes are its ``steady`` (S,)."""
    rpm = to_rpm(run_up.speeds)
    ratios = {"height_ratios": [1.6, 1.0]}
    modes = " and ".join(f"{speed:.4g} rpm" for speed in to_rpm(fit.frequencies))
    with open_figure(path, 2, 1, 9.5, 6.6, sharex=True, gridspec_kw=ratios) as axes:
        for ax, quantity in ((axes[0, 0], _size), (axes[1, 0], _lag)):
            ax.plot(rpm, quantity(run_up.vectors), ls="", marker="o", ms=3.5, mfc="none", mec=BLACK, label="measured")
            ax.plot(rpm, quantity(fit.fitted), color=BLUE, lw=1.6, label=f"ramp modelled, {modes}")
            ax.plot(rpm, quantity(steady), color=ORANGE, lw=1.4, ls="--", label="the same modes at constant speeds")
        axes[0, 0].set_title(f"{probe}, {run_up.rate / RAD_S_PER_RPM:.4g} rpm/s", loc="left")
        axes[0, 0].set_ylabel("amplitude (µm, zero to peak)")
        axes[1, 0].set_ylabel("phase lag (deg)")
        axes[1, 0].set_xlabel("rotor speed (rpm)")
        axes[0, 0].legend()
    return path


def _size(vectors: np.ndarray) -> np.ndarray:
    return np.asarray(MICROMETRES * np.abs(vectors))


def _lag(vectors: np.ndarray) -> np.ndarray:
    """Without jumps, and between -180 and 180 at the first row."""
    lag = np.unwrap(-np.angle(vectors))
    return np.asarray(np.degrees(lag))
