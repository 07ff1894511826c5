"""The one picture of an experiment: coefficients, a run as measured and predicted, and the twin's response."""

from __future__ import annotations

from itertools import cycle
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.coefficients import COEFFICIENTS, is_direct, unit
from pipeline.data.vibration_files import to_rpm
from pipeline.reporting.figures import (
    BLUE,
    GREEN,
    GREY,
    KINDS,
    MARKERS,
    MICROMETRES,
    ORANGE,
    PURPLE,
    draw_band,
    draw_markers,
    open_figure,
)
from pipeline.reporting.summary_text import Results, name_channel
from pipeline.units import RAD_S_PER_RPM

_COLOURS = (BLUE, GREEN, PURPLE, ORANGE)
_MARKS = ("o", "s", "^", "D", "v", "P")
_POINTS = 15
"""Markers a curve: several curves share a panel, each with its own phase."""


def draw_summary(path: Path, results: Results, title: str) -> Path:
    """Stiffness, damping, one run at one probe, and the predicted unbalance response, all over the speed.

    Where data have operating conditions, it is at the measured state that is nearest to the prediction's.
    """
    label = ""
    if results.dataset.operating:
        label, results = results.nearest()
    with open_figure(path, 2, 2, 12.0, 8.2) as axes:
        _draw_coefficients(axes[0, 0], results, "k")
        _draw_coefficients(axes[0, 1], results, "c")
        _draw_run(axes[1, 0], results)
        _draw_response(axes[1, 1], results)
        for ax in axes.flat:
            ax.set_xlabel("rotor speed (rpm)")
        for ax in axes.flat[:3] if label else ():
            ax.set_title(f"{ax.get_title()}, {label}")
        axes[0, 0].figure.suptitle(title, fontweight="bold")
    return path


def _draw_coefficients(ax: Any, results: Results, letter: str) -> None:
    """Draw a colour a coefficient, a marker a bearing; what is known is dashed."""
    some = [name for name in COEFFICIENTS if name[0] == letter and any(name in unknown for unknown in results.unknowns)]
    names = some or [name for name in COEFFICIENTS if name[0] == letter and is_direct(name)]
    for colour, name in zip(_COLOURS, names, strict=False):
        for b in range(len(results.identified.nodes)):
            _draw_coefficient(ax, results, b, name, colour)
        ax.plot([], [], color=colour, lw=4, label=name)
    kind = f"{KINDS[letter]} of the bearings"
    ax.set_title(kind if some else f"{kind} (known, not identified)")
    ax.set_ylabel(f"{KINDS[letter]} ({unit(names[0])})")
    values = np.concatenate([results.identified.coefficient(name).ravel() for name in names])
    if values.min() > 0 and values.max() > 5 * values.min():
        ax.set_yscale("log")
    elif values.min() > 0:
        # Noise of an axis that starts at its curves would look like a finding.
        ax.set_ylim(0, 1.15 * values.max())
    if some:
        _explain(ax, results)
    ax.legend(fontsize="small", ncols=2)


def _draw_coefficient(ax: Any, results: Results, b: int, name: str, colour: str) -> None:
    rpm, values = to_rpm(results.identified.speeds), results.identified.coefficient(name)[b]
    if name not in results.unknowns[b]:
        ax.plot(rpm, values, color=colour, ls="--", lw=1.2)
        return
    if results.modelled is not None:
        ax.plot(rpm, results.modelled.coefficient(name)[b], color=colour, lw=1.4)
    if results.deviation is not None:
        least = 1e-3 * values if values.min() > 0 else -np.inf
        draw_band(ax, rpm, values, results.deviation[b, :, COEFFICIENTS.index(name)], colour, least)
    shift = b / len(results.identified.nodes)
    draw_markers(ax, rpm, values, colour, marker=_MARKS[b % len(_MARKS)], count=_POINTS, shift=shift)


def _explain(ax: Any, results: Results) -> None:
    """Name the marker of each bearing, the line and the band in the legend."""
    for node, mark in zip(results.identified.nodes, cycle(_MARKS), strict=False):
        ax.plot([], [], ls="", marker=mark, ms=5, mfc="none", mec=GREY, label=f"identified, node {node}")
    if results.modelled is not None:
        ax.plot([], [], color=GREY, lw=1.4, label="modelled")
    if results.deviation is not None:
        ax.fill_between([], [], [], color=GREY, alpha=0.25, lw=0, label="± 2 standard deviations")


def _draw_run(ax: Any, results: Results) -> None:
    """Draw the amplitude of one run at the probe that moves most: measured as markers, predicted as a line."""
    shown, rpm = results.shown, to_rpm(results.dataset.speeds)
    measured_at = shown.measured.any(axis=1)  # points that the run was measured at
    rpm = rpm[measured_at]
    measured, predicted = (
        MICROMETRES * np.abs(vibration[measured_at, shown.probe]) for vibration in (shown.measured, shown.predicted)
    )
    label = "measured" if results.modelled is None else "measured (modelled data)"
    draw_markers(ax, rpm, measured, BLUE, label, count=2 * MARKERS)
    ax.plot(rpm, predicted, color=ORANGE, lw=1.4, label="predicted from the identified coefficients")
    fitted = "not fitted" if shown.held_out else "fitted"
    ax.set_title(f"run {shown.name} ({fitted}), {name_channel(results.dataset.channels[shown.probe])}")
    _scale_amplitudes(ax)
    ax.legend(fontsize="small")


def _draw_response(ax: Any, results: Results) -> None:
    """Draw the response to the unbalance that no run has, and the critical speeds."""
    identified, modelled, rpm = results.vibration["identified"], results.vibration.get("modelled"), results.rpm
    size = MICROMETRES * np.abs(identified.displacement)
    for d, (direction, colour) in enumerate(zip("xy", (BLUE, ORANGE), strict=True)):
        if modelled is None:
            ax.plot(rpm, size[:, d], color=colour, ls=("-", "--")[d], lw=1.4, label=f"{direction} predicted")
        else:
            true = MICROMETRES * np.abs(modelled.displacement[:, d])
            ax.plot(rpm, true, color=colour, lw=1.4, label=f"{direction} modelled")
            draw_markers(ax, rpm, size[:, d], colour, f"{direction} predicted", "os"[d])
        if identified.deviation is not None:
            draw_band(ax, rpm, size[:, d], MICROMETRES * identified.deviation[:, d], colour, 1e-3 * size[:, d])
    for i, critical in enumerate(results.behaviour.critical):
        label = "critical speed" if i == 0 else None
        ax.axvline(critical.speed / RAD_S_PER_RPM, color=GREY, ls=":", lw=1.2, label=label)
    ax.set_title(f"predicted: node {identified.node} under an unbalance that no run has{results.state}")
    _scale_amplitudes(ax)
    ax.legend(fontsize="small")


def _scale_amplitudes(ax: Any) -> None:
    """Give the amplitudes a logarithmic axis with plain numbers."""
    from matplotlib.ticker import LogLocator, NullFormatter, StrMethodFormatter

    ax.set_ylabel("amplitude (µm, zero-to-peak)")
    ax.set_yscale("log")
    low, high = ax.get_ylim()
    ax.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0) if high < 300 * low else (1.0,)))
    ax.yaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
    ax.yaxis.set_minor_formatter(NullFormatter())
