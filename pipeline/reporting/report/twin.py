"""The identified machine in the terms of API RP 684 and API 617: critical speeds, stability, unbalance response."""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from typing import Any, cast

import numpy as np

from pipeline.data.dataset import synchronous
from pipeline.data.vibration_files import write_range
from pipeline.ingest.conventions import GRAM_MILLIMETRE
from pipeline.reporting.blocks import (
    RPM,
    Amplitude,
    Axes,
    Block,
    Cell,
    Figure,
    Mark,
    Panel,
    Table,
)
from pipeline.reporting.content import FitContent, ReportContent, list_reservations
from pipeline.reporting.measured_figures import AMPLITUDE
from pipeline.reporting.report.measured import describe_weight
from pipeline.reporting.summary import describe_stability
from pipeline.reporting.twin import (
    CRITICAL,
    NATURAL,
    describe_measured,
    draw_modes,
    draw_sizes,
    list_critical,
    show,
    summarize_modes,
)
from pipeline.twin.modes import Stability
from pipeline.twin.twin import Twin
from pipeline.write_numbers import write_number


def describe_modes(content: ReportContent, fit: FitContent, twin: Twin, rounding: float = 1e-9) -> list[Block]:
    """Critical speeds, Campbell diagram and stability map.

    The growth rate of a machine at rest in a mode is known to ``rounding`` (1/s).
    """
    running, behaviour = content.config.machine.prediction.speed_rpm, twin.behaviour["identified"]
    speeds, identified = behaviour.modes.speeds, cast("Mapping[str, Any]", summarize_modes(behaviour, running))
    stability, critical = identified["stability"], identified["critical_speeds"]
    largest, known = stability["largest_growth"], stability.get("largest_growth_std") or 0.0
    growth = write_number(largest, known if known > rounding else None, 3)
    text = (
        f"The identified machine is {describe_stability(stability)} (from {write_range(speeds)}{fit.state}, modes up "
        "to twice the top speed)"
        + f"; the largest growth rate of all modes is {growth} 1/s"
        * (stability["verdict"] == Stability.STABLE and largest < -2.0 * known)
        + ". A critical speed is where a damped natural frequency equals the rotor speed. In the sense of API RP 684 "
        "one with an amplification factor below 2.5 is critically damped. "
        f"Separation margins are from {write_number(running, digits=6)} rpm, the speed of the prediction, in percent "
        "of it."
    )
    return [
        *list_reservations(content),
        Mark("warning" if stability["verdict"] == "unstable" else "", text),
        *(
            Mark(
                "warning",
                f"{text[0].upper()}{text[1:]}: the bands grow there, and rest on the model of the coefficients alone.",
            )
            for text in fit.beyond
        ),
        f"No damped natural frequency equals the rotor speed from {write_range(speeds)}."
        if not critical
        else Table(
            "Damped critical speeds",
            ["critical speed", *CRITICAL],
            [[number, *cells] for number, cells in zip(critical, list_critical(critical), strict=True)],
        ),
        *(
            Table(
                "Damped natural frequencies at this speed",
                ["mode", *NATURAL],
                [[n, show(m, "hz"), show(m, "logarithmic_decrement"), describe_measured(m)] for n, m in modes.items()],
            )
            for modes in (identified.get("modes"),)
            if modes is not None
        ),
        *([draw_modes(twin.behaviour, fit.state.removeprefix(" at "))] if len(speeds) > 1 else ()),
    ]


def describe_response(content: ReportContent, fit: FitContent) -> list[Block]:
    """Verification as in API 617, and the prediction of an unbalance that no run has."""
    return [
        *list_reservations(content),
        *_verify(content, fit),
        *([_predict(content, fit, fit.twin)] if fit.twin else ()),
    ]


def find_peak(
    rpm: np.ndarray, size: np.ndarray, beside: float | None = None, least_prominence: float = 0.05
) -> tuple[float, float] | None:
    """Speed and height of a peak of ``size`` (S,) inside the range, by a parabola; None without one.

    It is the highest, or that which lies nearest ``beside`` a speed (rpm). A peak stands out by ``least_prominence`` of
    the largest value at least: noise does not.
    """
    from scipy.signal import find_peaks

    inner, _ = find_peaks(size, prominence=least_prominence * size.max())
    if not len(inner):
        return None
    s = int(inner[size[inner].argmax() if beside is None else np.abs(rpm[inner] - beside).argmin()])
    further = 2 if size[max(s - 2, 0) : s + 3].min() > size[s] / 2 else 1  # more than three: they are noisy
    near = slice(max(s - further, 0), s + further + 1)
    a, b, c = np.polyfit(rpm[near] - rpm[s], size[near], 2)
    top = float(np.clip(-b / (2 * a), rpm[near][0] - rpm[s], rpm[near][-1] - rpm[s])) if a < 0 else 0.0
    return float(rpm[s] + top), float(a * top**2 + b * top + c)


def _verify(content: ReportContent, fit: FitContent, speed_tolerance: float = 5.0) -> list[str | Table]:
    """The response peaks of the runs that unbalances excite.

    ``speed_tolerance`` is in percent of the predicted critical speed (API 617, unbalanced rotor response verification).
    """
    data, rows = content.dataset, []
    excited = [
        r
        for r in content.shown_runs
        if synchronous(data.frequencies[:, r], data.speeds).all()
        and all(acting.kind == "unbalance" for acting in data.excitation_of(r))
    ]
    for r, probe in itertools.product(excited, content.shown_probes):
        for _, points, look in content.traces(r):
            rpm = content.rpm[points]
            expected = find_peak(rpm, np.abs(probe.read(fit.predicted)[points, r]))
            seen = find_peak(rpm, np.abs(probe.read(data.displacement)[points, r]), beside=expected and expected[0])
            if seen is None or expected is None:
                continue
            off = 100 * (seen[0] / expected[0] - 1)
            at = int(points[np.abs(rpm - seen[0]).argmin()])
            noise = float(probe.read_noise(fit.noise)[at, r] / np.sqrt(2))  # of the amplitude alone
            flat = expected[1] - np.abs(probe.read(fit.predicted)[at, r]) <= 2 * noise  # the noise moves such a peak
            near, low = abs(off) <= speed_tolerance or flat, seen[1] <= 1.05 * expected[1] + 2 * noise
            verdict = "within" if near and low else "speed off" if not near else "higher than predicted"
            row: list[Cell] = [
                look["label"] + (" (not fitted)" if content.held_out(r) else ""),
                probe.name,
                f"{seen[0]:.0f}",
                f"{expected[0]:.0f}",
                f"{round(off, 2) + 0.0:+.2f}",
                Amplitude(seen[1], noise),
                Amplitude(expected[1]),
                Mark("good" if near and low else "no", verdict),
            ]
            rows.append(row)
    if not rows:
        return ["No unbalance run has a response peak inside the speed range: there is nothing to verify."]
    text = (
        "Each row is a response peak inside the speed range. As in API 617's verification test, the measured peak must "
        f"lie within {speed_tolerance:g} % of the predicted speed (or where the predicted amplitude is as high, to two "
        "deviations of the noise), and must not be higher than predicted (here: by "
        "more than two deviations of the noise and 5 %). Runs that were fitted verify less than runs that were not."
    )
    header = ["run", "probe", "peak, rpm", "predicted, rpm", "off, %", "amplitude, µm pk-pk", "predicted, µm pk-pk"]
    return [text, Table("Unbalanced rotor response verification", [*header, "verdict"], rows)]


def _predict(content: ReportContent, fit: FitContent, twin: Twin) -> Figure:
    """The twin's vibration under the unbalance that no run has, with its band."""
    predicted, asked = twin.vibration["identified"], content.config.machine.prediction
    acting = "; ".join(
        f"node {unbalance.node}: "
        + describe_weight(unbalance.magnitude / GRAM_MILLIMETRE, float(np.degrees(unbalance.phase)))
        for unbalance in asked.unbalances
    ) + "; ".join(f"node {force.node}: {force.magnitude:g} N, {force.whirl}" for force in asked.forces)
    stated = "; this fit states no band" if predicted.deviation is None else ", with its nominal 95 % band"
    told = f"({acting}){',' * bool(fit.state)}{fit.state}{stated}"
    order = "1X " * bool(asked.unbalances)
    caption = f"Predicted {order}amplitude of node {asked.node} under {asked.what} that no run has {told}."
    axes = Axes(draw_sizes(twin.vibration, 1.0), AMPLITUDE, quantity="amplitude")
    return Figure("prediction", caption, [Panel(f"node {asked.node}", RPM, [axes], wide=True)])
