"""The one picture of an experiment: coefficients, a run as measured and predicted, and the twin's response."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from pipeline.coefficients import COEFFICIENTS, is_direct, unit
from pipeline.data.vibration_files import to_rpm
from pipeline.reporting.figures import BLUE, GREEN, GREY, MARKERS, ORANGE, PURPLE, draw_markers, figure
from pipeline.reporting.summary_text import Results, channel_words
from pipeline.twin.prediction import PredictedVibration
from pipeline.units import RAD_S_PER_RPM

_MICROMETRES = 1e6
_COLOURS = (BLUE, GREEN, PURPLE, ORANGE)
_MARKS = ("o", "s", "^", "D", "v", "P")
_POINTS = 15
"""Markers a curve: several curves share a panel, each with its own phase."""


def summary_figure(path: Path, results: Results, title: str) -> Path:
    """Stiffness, damping, one run at one probe, and the predicted unbalance response, all over the speed."""
    with figure(path, 2, 2, 12.0, 8.2) as axes:
        _coefficients(axes[0, 0], results, "k")
        _coefficients(axes[0, 1], results, "c")
        _run(axes[1, 0], results)
        _response(axes[1, 1], results)
        for ax in axes.flat:
            ax.set_xlabel("rotor speed (rpm)")
        axes[0, 0].figure.suptitle(title, fontweight="bold")
    return path


def _coefficients(ax: Any, results: Results, letter: str) -> None:
    """A colour a coefficient, a marker a bearing; what is known is dashed."""
    some = [name for name in COEFFICIENTS if name[0] == letter and any(name in of for of in results.unknowns)]
    direct = [name for name in COEFFICIENTS if name[0] == letter and is_direct(name)]
    names, seen = some or direct, []
    for colour, name in zip(_COLOURS, names, strict=False):
        for b in range(len(results.identified.nodes)):
            seen.append(_coefficient(ax, results, b, name, colour))
    kind = "stiffness" if letter == "k" else "damping"
    ax.set_title(f"{kind} of the bearings" if some else f"{kind} of the bearings (known, not identified)")
    ax.set_ylabel(f"{kind} ({unit(names[0])})")
    values = np.concatenate(seen)
    if values.min() > 0 and values.max() > 5 * values.min():
        ax.set_yscale("log")
    elif values.min() > 0:
        # Noise of an axis that starts at its curves would look like a finding.
        ax.set_ylim(0, 1.15 * values.max())
    _key(ax, results, dict(zip(names, _COLOURS, strict=False)), bool(some))


def _coefficient(ax: Any, results: Results, b: int, name: str, colour: str) -> np.ndarray:
    """Draw one; its values (S,)."""
    rpm, values = to_rpm(results.identified.speeds), results.identified.coefficient(name)[b]
    if name not in results.unknowns[b]:
        ax.plot(rpm, values, color=colour, ls="--", lw=1.2)
        return values
    if results.modelled is not None:
        ax.plot(rpm, results.modelled.coefficient(name)[b], color=colour, lw=1.4)
    c = COEFFICIENTS.index(name)
    if results.deviation is not None:
        low, high = (values + k * results.deviation[b, :, c] for k in (-2, 2))
        ax.fill_between(
            rpm, np.maximum(low, 1e-3 * values) if values.min() > 0 else low, high, color=colour, alpha=0.25, lw=0
        )
    every = max(1, len(rpm) // _POINTS)
    first = (b * every) // len(results.identified.nodes)
    ax.plot(
        rpm[first::every], values[first::every], ls="", marker=_MARKS[b % len(_MARKS)], ms=5, mfc="none", mec=colour
    )
    return values


def _key(ax: Any, results: Results, colours: dict[str, str], identified: bool) -> None:
    """Colours and markers each once, above the axes' top corner."""
    for name, colour in colours.items():
        ax.plot([], [], color=colour, lw=4, label=name)
    if identified:
        for b, node in enumerate(results.identified.nodes):
            mark = _MARKS[b % len(_MARKS)]
            ax.plot([], [], ls="", marker=mark, ms=5, mfc="none", mec=GREY, label=f"identified, node {node}")
    if identified and results.modelled is not None:
        ax.plot([], [], color=GREY, lw=1.4, label="modelled")
    if identified and results.deviation is not None:
        ax.fill_between([], [], [], color=GREY, alpha=0.25, lw=0, label="± 2 standard deviations")
    ax.legend(fontsize="small", ncols=2)


def _run(ax: Any, results: Results) -> None:
    """Amplitude of one run at the probe that moves most: measured as markers, predicted as a line."""
    shown, rpm = results.shown, to_rpm(results.dataset.speeds)
    measured, predicted = (_MICROMETRES * np.abs(of[:, shown.probe]) for of in (shown.measured, shown.predicted))
    label = "measured" if results.modelled is None else "measured (modelled data)"
    draw_markers(ax, rpm, measured, BLUE, label, 2 * MARKERS)
    ax.plot(rpm, predicted, color=ORANGE, lw=1.4, label="predicted from the identified coefficients")
    fitted = "not fitted" if shown.held_out else "fitted"
    ax.set_title(f"run {shown.name} ({fitted}), {channel_words(results.dataset.channels[shown.probe])}")
    _amplitudes(ax)
    ax.legend(fontsize="small")


def _response(ax: Any, results: Results) -> None:
    """The response to the unbalance that no run has, and the critical speeds."""
    vibration = results.vibration
    rpm = to_rpm(results.dataset.speeds)
    for d, colour in enumerate((BLUE, ORANGE)):
        found = vibration["identified"]
        size = _MICROMETRES * np.abs(found.displacement[:, d])
        if "modelled" in vibration:
            ax.plot(
                rpm,
                _MICROMETRES * np.abs(vibration["modelled"].displacement[:, d]),
                color=colour,
                lw=1.4,
                label=f"{'xy'[d]} modelled",
            )
            every = max(1, len(rpm) // MARKERS)
            ax.plot(
                rpm[::every],
                size[::every],
                ls="",
                marker="os"[d],
                ms=4.5,
                mfc="none",
                mec=colour,
                label=f"{'xy'[d]} predicted",
            )
        else:
            ax.plot(rpm, size, color=colour, ls=("-", "--")[d], lw=1.4, label=f"{'xy'[d]} predicted")
        _band(ax, rpm, found, d, colour)
    for i, one in enumerate(results.critical):
        label = "critical speed" if i == 0 else None
        ax.axvline(one.speed / RAD_S_PER_RPM, color=GREY, ls=":", lw=1.2, label=label)
    ax.set_title(f"predicted: node {vibration['identified'].node} under an unbalance that no run has")
    _amplitudes(ax)
    ax.legend(fontsize="small")


def _amplitudes(ax: Any) -> None:
    """A logarithmic axis with plain numbers."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    ax.set_ylabel("amplitude (µm, zero-to-peak)")
    ax.set_yscale("log")
    low, high = ax.get_ylim()
    ax.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0) if high < 300 * low else (1.0,)))
    ax.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    ax.yaxis.set_minor_formatter(NullFormatter())


def _band(ax: Any, rpm: np.ndarray, found: PredictedVibration, d: int, colour: str) -> None:
    """Two standard deviations either side, where they are known."""
    if found.deviation is not None:
        size = np.abs(found.displacement[:, d])
        low, high = (_MICROMETRES * (size + k * found.deviation[:, d]) for k in (-2, 2))
        ax.fill_between(rpm, np.maximum(low, 1e-3 * _MICROMETRES * size), high, color=colour, alpha=0.25, lw=0)
