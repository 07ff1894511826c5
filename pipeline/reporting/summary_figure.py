"""The one picture of an experiment: coefficients, a run as measured and predicted, and the twin's response."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from pipeline.coefficients import COEFFICIENTS, is_direct
from pipeline.data.operating import find_nearest
from pipeline.reporting.blocks import (
    BLUE,
    GREEN,
    GREY,
    LOOKS,
    MICROMETRES,
    NOTHING,
    ORANGE,
    PURPLE,
    RPM,
    Axes,
    Curve,
    Figure,
    Panel,
    mark,
)
from pipeline.reporting.coefficient_figures import KINDS, UNITS, Coefficients, clip_bands
from pipeline.reporting.content import FitContent, ReportContent
from pipeline.reporting.matplotlib_figures import write_figure
from pipeline.reporting.summary import name_channel
from pipeline.reporting.twin import draw_sizes
from pipeline.twin.twin import Twin
from pipeline.units import RAD_S_PER_RPM

_AMPLITUDE = "amplitude (µm, zero-to-peak)"


def draw_summary(path: Path, content: ReportContent, fit: FitContent) -> Path:
    """Stiffness, damping, one run at one probe, and the predicted unbalance response, all over the speed.

    Where data have operating conditions, it is at the measured state that is nearest to the prediction's.
    """
    data = content.dataset
    label, points = find_nearest(data.speeds, data.operating, fit.operating)
    beside = f", {label}" if data.operating else ""
    panels = [draw_kind(fit.coefficients.at(points), letter, beside) for letter in "kc"]
    panels += [_draw_run(content, fit, points, beside), *([_draw_response(fit.twin, fit.state)] if fit.twin else [])]
    return write_figure(path, Figure("summary", content.config.name, panels))


def draw_kind(shown: Coefficients, letter: str, beside: str) -> Panel:
    """A colour a coefficient, a marker a bearing; what is known is dashed."""
    some, nodes, (scale, measured_in) = shown.choose(letter), shown.identified.nodes, UNITS[letter]
    names = some or [name for name in COEFFICIENTS if name[0] == letter and is_direct(name)]
    curves = []
    for name, colour in zip(names, (BLUE, GREEN, PURPLE, ORANGE), strict=False):
        for b, node in enumerate(nodes):
            curves += shown.draw(b, name, f"{name}, node {node}", (colour, LOOKS[b % 5][1]), scale)
    values = scale * np.concatenate([shown.identified.coefficient(name).ravel() for name in names])
    positive, several = values.min() > 0, values.max() > 5 * values.min()
    scaled = "log" if positive and several else "linear"
    # Noise of an axis that starts at its curves would look like a finding.
    usual = (0.0, 1.15 * float(values.max())) if positive and not several else ()
    reach = clip_bands(curves, scaled == "log") or usual
    known = "" if some else " (known, not identified)"
    return Panel(
        f"{KINDS[letter]} of the bearings{known}{beside}",
        RPM,
        [Axes(curves, f"{KINDS[letter]} ({measured_in})", scale=scaled, y_range=reach)],
        legend=True,
    )


def _draw_run(content: ReportContent, fit: FitContent, points: np.ndarray, beside: str) -> Panel:
    """The amplitude of one run at the probe that moves most: measured as markers, predicted as a line."""
    (r, *vectors), data = content.example, content.dataset
    probe = int(np.abs(vectors[0]).max(axis=0).argmax())
    at = points[vectors[0][points].any(axis=1)]  # that the run was measured at
    rpm, (measured, predicted) = content.rpm[at], (MICROMETRES * np.abs(vector[at, probe]) for vector in vectors)
    label = "measured (modelled data)" if fit.coefficients.compared else "measured"
    fitted = "not fitted" if content.held_out(r) else "fitted"
    title = f"run {data.runs[r]} ({fitted}), {name_channel(data.channels[probe])}{beside}"
    return Panel(
        title,
        RPM,
        [
            Axes(
                [
                    mark(rpm, measured, label, BLUE, count=60),
                    Curve(rpm, predicted, "predicted from the identified coefficients", ORANGE),
                ],
                _AMPLITUDE,
                scale="log",
            )
        ],
        legend=True,
    )


def _draw_response(twin: Twin, state: str) -> Panel:
    """The response to the unbalance that no run has, and the critical speeds."""
    curves, critical = draw_sizes(twin.vibration), [mode.speed for mode in twin.behaviour["identified"].critical]
    if critical:
        curves.append(Curve(NOTHING, NOTHING, "critical speed", GREY, "dot"))
    axes = Axes(curves, _AMPLITUDE, scale="log", rules=[(speed / RAD_S_PER_RPM, "") for speed in critical])
    at = f",{state.removeprefix(' at')}" if state else ""
    node = twin.vibration["identified"].node
    return Panel(f"predicted: node {node} under an unbalance that no run has{at}", RPM, [axes], legend=True)
