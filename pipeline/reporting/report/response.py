"""Unbalance response: measured against predicted at the probes, and vibration that no run has."""

from __future__ import annotations

import itertools

import numpy as np

from pipeline.data.dataset import synchronous
from pipeline.data.noise import NOMINAL_95
from pipeline.data.operating import name_state
from pipeline.reporting.figure import BLUE, NOTHING, ORANGE, RPM, Axes, Curve, Figure, Panel
from pipeline.reporting.measured_figures import AMPLITUDE
from pipeline.reporting.report.content import FitContent, ReportContent, list_reservations
from pipeline.reporting.report.machine import describe_weight
from pipeline.reporting.report.measured import vectors_of
from pipeline.reporting.report.section import Paragraph, Section
from pipeline.reporting.tables import Amplitude, Cell, Mark, Table


def describe_response(content: ReportContent, fit: FitContent) -> Section:
    """Verification as in API 617, and the prediction of an unbalance that no run has."""
    blocks = (*list_reservations(content), *_verify(content, fit), *_predict(content, fit))
    return Section("response", "Unbalance response", blocks)


def find_peak(rpm: np.ndarray, size: np.ndarray, least_prominence: float = 0.05) -> tuple[float, float] | None:
    """Speed and height of the highest peak of ``size`` (S,) inside the range, by a parabola; None without one.

    A peak stands out by ``least_prominence`` of the largest value at least: noise does not.
    """
    from scipy.signal import find_peaks

    inner, _ = find_peaks(size, prominence=least_prominence * size.max())
    if not len(inner):
        return None
    s = int(inner[size[inner].argmax()])
    near = slice(max(s - 2, 0), s + 3)  # more than three readings, for they are noisy
    a, b, c = np.polyfit(rpm[near] - rpm[s], size[near], 2)
    top = float(np.clip(-b / (2 * a), rpm[near][0] - rpm[s], rpm[near][-1] - rpm[s])) if a < 0 else 0.0
    return float(rpm[s] + top), float(a * top**2 + b * top + c)


def _verify(content: ReportContent, fit: FitContent, speed_tolerance: float = 5.0) -> list[Paragraph | Table]:
    """The response peaks of the runs that unbalances excite.

    ``speed_tolerance`` is in percent of the predicted critical speed (API 617, unbalanced rotor response verification).
    """
    data, rows = content.dataset, []
    turning = [r for r in content.shown_runs if synchronous(data.frequencies[:, r], data.speeds).all()]
    excited = [r for r in turning if all(acting.kind == "unbalance" for acting in data.excitation_of(r))]
    for r, probe in itertools.product(excited, content.shown_probes):
        for _, points, look in content.traces(r):
            rpm = content.rpm[points]
            seen = find_peak(rpm, np.abs(vectors_of(content, probe, r))[points])
            expected = find_peak(rpm, np.abs(fit.predicted[points, :, r] @ probe.weights))
            if seen is None or expected is None:
                continue
            off = 100 * (seen[0] / expected[0] - 1)
            at = int(points[np.abs(rpm - seen[0]).argmin()])
            noise = float(np.sqrt(fit.noise[at, :, r] ** 2 @ probe.weights**2 / 2))  # of the amplitude alone
            near, low = abs(off) <= speed_tolerance, seen[1] <= 1.05 * expected[1] + 2 * noise
            verdict = "within" if near and low else "speed off" if not near else "higher than predicted"
            row: list[Cell] = [
                look["label"] + (" (not fitted)" if content.held_out(r) else ""),
                probe.name,
                f"{seen[0]:.0f}",
                f"{expected[0]:.0f}",
                f"{off:+.2f}",
                Amplitude(seen[1], noise),
                Amplitude(expected[1]),
                Mark("good" if near and low else "no", verdict),
            ]
            rows.append(row)
    if not rows:
        return [Paragraph("No unbalance run has a response peak inside the speed range: there is nothing to verify.")]
    text = (
        "Each row is a response peak inside the speed range. As in API 617's verification test, the measured peak must "
        f"lie within {speed_tolerance:g} % of the predicted speed, and must not be higher than predicted (here: by "
        "more than two deviations of the noise and 5 %). Runs that were fitted verify less than runs that were not."
    )
    header = ["run", "probe", "peak, rpm", "predicted, rpm", "off, %"]
    header += ["amplitude, µm pk-pk", "predicted, µm pk-pk", "verdict"]
    return [Paragraph(text), Table("Unbalanced rotor response verification", header, rows)]


def _predict(content: ReportContent, fit: FitContent) -> list[Figure]:
    """The twin's vibration under the unbalance that no run has, with its band."""
    table, asked = content.tables.get("prediction", {}), content.config.machine.prediction
    curves = []
    for direction, colour, dash in (("x", BLUE, "solid"), ("y", ORANGE, "dash")) if table else ():
        size = table[f"{direction}_identified_amplitude_m"]
        band = NOMINAL_95 * table.get(f"{direction}_identified_amplitude_std_m", NOTHING)
        curves.append(Curve(table["speed_rpm"], size, f"{direction} predicted", colour, dash, band=band))
    acting = "; ".join(
        f"node {unbalance.node}: {describe_weight(unbalance.magnitude, unbalance.phase)}"
        for unbalance in asked.unbalances
    )
    panel = Panel(f"node {asked.node}", RPM, [Axes(curves, AMPLITUDE, quantity="amplitude")], wide=True)
    state = name_state(fit.operating)
    caption = f"Predicted 1X amplitude of node {asked.node} under an unbalance that no run has ({acting})"
    caption += f", at {state}" if state else ""
    caption += ", with its nominal 95 % band." if any(len(c.band) for c in curves) else "; this fit states no band."
    return [Figure("prediction", caption, [panel])] if curves else []
