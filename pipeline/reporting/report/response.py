"""Unbalance response: measured against predicted at the probes, and vibration that no run has."""

from __future__ import annotations

import itertools

import numpy as np

from pipeline.data.dataset import synchronous
from pipeline.data.noise import NOMINAL_95
from pipeline.data.operating import name_state
from pipeline.reporting.figures import BLUE, ORANGE
from pipeline.reporting.report.content import ReportContent
from pipeline.reporting.report.figure import Axes, Curve, Figure, Panel
from pipeline.reporting.report.measured import AMPLITUDE, RPM, vectors_of
from pipeline.reporting.report.section import Amplitude, Cell, Mark, Paragraph, Section, Table
from pipeline.reporting.report.verdicts import list_reservations

SPEED_TOLERANCE = 5.0
"""Percent of the predicted critical speed (API 617, unbalanced rotor response verification test)."""
_LEAST_PROMINENCE = 0.05


def describe_response(content: ReportContent) -> Section | None:
    """Verification as in API 617, and the prediction of an unbalance that no run has; None without a fit."""
    if content.fit is None:
        return None
    blocks = [*list_reservations(content), *_verify(content), *_predict(content)]
    return Section("response", "Unbalance response", tuple(blocks))


def find_peak(rpm: np.ndarray, size: np.ndarray) -> tuple[float, float] | None:
    """Speed and height of the highest peak of ``size`` (S,) inside the range, by a parabola; None without one.

    A peak stands out by a twentieth of the largest value at least: noise does not.
    """
    from scipy.signal import find_peaks

    inner, _ = find_peaks(size, prominence=_LEAST_PROMINENCE * size.max())
    if not len(inner):
        return None
    s = int(inner[size[inner].argmax()])
    near = slice(max(s - 2, 0), s + 3)  # more than three readings, for they are noisy
    a, b, c = np.polyfit(rpm[near] - rpm[s], size[near], 2)
    top = float(np.clip(-b / (2 * a), rpm[near][0] - rpm[s], rpm[near][-1] - rpm[s])) if a < 0 else 0.0
    return float(rpm[s] + top), float(a * top**2 + b * top + c)


def _verify(content: ReportContent) -> list[Paragraph | Table]:
    """The response peaks of the runs that unbalances excite."""
    fit, data, rows = content.fit, content.dataset, []
    assert fit is not None
    turning = [r for r in content.shown_runs if synchronous(data.frequencies[:, r], data.speeds).all()]
    for r in turning:
        if any(excitation.kind != "unbalance" for excitation in data.excitation_of(r)):
            continue
        for probe, (points, look) in itertools.product(content.shown_probes, content.traces(r)):
            rpm = content.rpm[points]
            seen = find_peak(rpm, np.abs(vectors_of(content, probe, r))[points])
            expected = find_peak(rpm, np.abs(fit.predicted[points, :, r] @ probe.weights))
            if seen is None or expected is None:
                continue
            off = 100 * (seen[0] / expected[0] - 1)
            at = int(points[np.abs(rpm - seen[0]).argmin()])
            noise = float(np.sqrt(fit.noise[at, :, r] ** 2 @ probe.weights**2 / 2))  # of the amplitude alone
            name = look["label"] + (" (not fitted)" if content.held_out(r) else "")
            rows.append(_row(name, probe.name, (seen, expected), (off, noise)))
    text = (
        "Each row is a response peak inside the speed range. As in API 617's verification test, the measured peak must "
        f"lie within {SPEED_TOLERANCE:g} % of the predicted speed, and must not be higher than predicted (here: by "
        "more than two deviations of the noise and 5 %). Runs that were fitted verify less than runs that were not."
    )
    if not rows:
        return [Paragraph("No unbalance run has a response peak inside the speed range: there is nothing to verify.")]
    header = [
        "run",
        "probe",
        "peak, rpm",
        "predicted, rpm",
        "off, %",
        "amplitude, µm pk-pk",
        "predicted, µm pk-pk",
        "verdict",
    ]
    return [Paragraph(text), Table("Unbalanced rotor response verification", header, rows)]


def _row(
    name: str,
    probe: str,
    peaks: tuple[tuple[float, float], tuple[float, float]],
    off: tuple[float, float],
) -> list[Cell]:
    (at, size), (expected_at, expected) = peaks
    near, low = abs(off[0]) <= SPEED_TOLERANCE, size <= 1.05 * expected + 2 * off[1]
    text = "within" if near and low else "speed off" if not near else "higher than predicted"
    return [
        name,
        probe,
        f"{at:.0f}",
        f"{expected_at:.0f}",
        f"{off[0]:+.2f}",
        Amplitude(size, off[1] or None),
        Amplitude(expected),
        Mark("good" if near and low else "no", text),
    ]


def _predict(content: ReportContent) -> list[Paragraph | Figure]:
    """The twin's vibration under the unbalance that no run has, with its band."""
    table, asked = content.tables.get("prediction"), content.config.machine.prediction
    if table is None:
        return []
    curves = []
    for direction, colour, dash in (("x", BLUE, "solid"), ("y", ORANGE, "dash")):
        size = table[f"{direction}_identified_amplitude_m"]
        stated = table.get(f"{direction}_identified_amplitude_std_m")
        band = None if stated is None else NOMINAL_95 * stated
        curves.append(Curve(table["speed_rpm"], size, f"{direction} predicted", colour, dash, band=band))
    acting = "; ".join(
        f"node {unbalance.node}: {1e6 * unbalance.magnitude:.4g} g mm at {np.degrees(unbalance.phase):.4g}°"
        for unbalance in asked.unbalances
    )
    panel = Panel(f"node {asked.node}", RPM, (Axes(tuple(curves), AMPLITUDE, amplitude=True),), wide=True)
    state = name_state(content.fit.operating) if content.fit is not None else ""
    caption = f"Predicted 1X amplitude of node {asked.node} under an unbalance that no run has ({acting})"
    caption += f", at {state}" if state else ""
    caption += ", with its nominal 95 % band." if curves[0].band is not None else "; this fit states no band."
    return [Figure("prediction", caption, (panel,))]
