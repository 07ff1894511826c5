"""Critical speeds, Campbell diagram and stability of the identified machine, in the terms of API RP 684."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from pipeline.data.noise import NOMINAL_95
from pipeline.data.operating import name_state
from pipeline.data.vibration_files import to_rpm
from pipeline.reporting.figure import BLACK, DASHES, GREY, LOOKS, NOTHING, RPM, Axes, Curve, Figure, Panel, mark
from pipeline.reporting.report.content import FitContent, ReportContent, list_reservations
from pipeline.reporting.report.section import Block, Paragraph, Section
from pipeline.reporting.tables import Table
from pipeline.reporting.twin_tables import CRITICAL, list_critical
from pipeline.units import RAD_S_PER_RPM
from pipeline.write_numbers import write_number


def describe_modes(content: ReportContent, fit: FitContent, rounding: float = 1e-9) -> Section | None:
    """Critical speeds, Campbell diagram and stability map; None without a prediction.

    The growth rate of a machine at rest in a mode is known to ``rounding`` (1/s).
    """
    identified = content.files.get("prediction", {}).get("identified")
    if identified is None:
        return None
    stability, rpm = identified["stability"], to_rpm(fit.modes.speeds)
    verdict = stability.get("verdict", "stable" if stability["stable"] else "unstable")
    said = {"stable": "stable", "not told": "at the edge of stability, its growth not told from none,"}.get(verdict)
    known = stability.get("largest_growth_std") or 0.0
    growth = write_number(stability["largest_growth"], known if known > rounding else None, 3)
    at = f" at {name_state(fit.operating)}" if fit.operating else ""
    text = f"The identified machine is {said or 'UNSTABLE'} {_name_range(rpm)}{at}; "
    text += f"the largest growth rate is {growth} 1/s."
    least = stability["smallest_logarithmic_decrement"]
    if least is not None:
        decrement = write_number(least, stability.get("smallest_logarithmic_decrement_std"), 3)
        speed = write_number(stability["at_rpm"], digits=6)
        text += f" The smallest logarithmic decrement is {decrement}, at {speed} rpm (modes up to twice the top speed)."
    running = write_number(content.config.machine.prediction.speed_rpm, digits=6)
    text += (
        " A critical speed is where a damped natural frequency equals the rotor speed. In the sense of API RP 684 one "
        "with an amplification factor below 2.5 is critically damped. "
        f"Separation margins are from {running} rpm (machine.prediction.speed_rpm), in percent of it."
    )
    beyond = "the bands grow there, and rest on the model of the coefficients alone."
    blocks: list[Block] = [*list_reservations(content), Paragraph(text, warning=verdict == "unstable")]
    blocks += [Paragraph(f"{text[0].upper()}{text[1:]}: {beyond}", warning=True) for text in fit.beyond]
    blocks.append(_list_critical_speeds(rpm, identified["critical_speeds"]))
    figures = () if len(rpm) < 2 else (_draw_campbell(content, fit, identified), _draw_stability(content, fit))
    return Section("modes", "Critical speeds and stability", (*blocks, *figures))


def _name_range(rpm: np.ndarray) -> str:
    first, last = (write_number(float(speed), digits=6) for speed in rpm[[0, -1]])
    return f"from {first} to {last} rpm"


def _list_critical_speeds(rpm: np.ndarray, critical: Mapping[str, Any]) -> Table | Paragraph:
    if not critical:
        return Paragraph(f"No damped natural frequency equals the rotor speed {_name_range(rpm)}.")
    rows = [[number, *cells] for number, cells in zip(critical, list_critical(critical), strict=True)]
    return Table("Damped critical speeds", ["critical speed", *CRITICAL], rows)


def _draw_campbell(content: ReportContent, fit: FitContent, identified: Mapping[str, Any]) -> Figure:
    rpm, frequency = to_rpm(fit.modes.speeds), fit.modes.frequency / RAD_S_PER_RPM
    shown = np.flatnonzero(np.nanmin(frequency, axis=0, initial=np.inf) <= 2.2 * rpm[-1])
    curves = []
    for i, k in enumerate(shown.tolist()):
        band = 60.0 * _read_band(content, rpm, k, "frequency_std_hz")
        curves.append(Curve(rpm, frequency[:, k], f"mode {i + 1}", LOOKS[i % 8][0], DASHES[i % 4], band=band))
    curves.append(Curve(rpm, rpm, "1X", BLACK, "solid", width=1.0))
    crossings = np.array([mode["rpm"] for mode in identified["critical_speeds"].values()])
    curves += [Curve(crossings, crossings, "critical speed", BLACK, "none", "o")] if len(crossings) else []
    axes = Axes(curves, "frequency (cycles/min)", y_range=(0.0, 2.2 * float(rpm[-1])))
    caption = "Modes in the order of their damped natural frequencies; over-damped ones have none."
    return Figure("campbell", caption, [Panel("Campbell diagram", RPM, [axes], wide=True)])


def _read_band(content: ReportContent, rpm: np.ndarray, mode: int, column: str) -> np.ndarray:
    """(U,) half the width of a mode's nominal 95 % band, in the unit of the table; empty where none is stated."""
    table = content.tables.get("modes")
    if table is None:
        return NOTHING
    rows = (table["system"] == "identified") & (table["mode"] == mode + 1)
    band = np.full(len(rpm), np.nan)
    band[np.abs(rpm[:, None] - table["speed_rpm"][rows]).argmin(axis=0)] = NOMINAL_95 * table[column][rows]
    return band


def _draw_stability(content: ReportContent, fit: FitContent, highest: float = 1.5, points: int = 60) -> Figure:
    """Decrements below the ``highest``: what is damped more, nobody asks for. About so many ``points`` a mode."""
    rpm, decrement = to_rpm(fit.modes.speeds), fit.modes.logarithmic_decrement
    within = np.where(fit.modes.frequency <= 2.0 * fit.modes.speeds.max(), decrement, np.nan)
    curves = []
    for i, k in enumerate(np.flatnonzero(np.isfinite(within).any(axis=0)).tolist()):
        band = _read_band(content, rpm, k, "logarithmic_decrement_std")
        every = slice(None, None, max(1, len(rpm) // points))
        drawn = mark(rpm, within[:, k], f"mode {i + 1}", *LOOKS[i % 8], count=points)
        curves.append(replace(drawn, band=band[every]))
    curves.append(Curve(rpm[[0, -1]], np.zeros(2), "limit of stability", GREY, "solid", width=1.0))
    limits = (min(-0.1, 1.1 * float(np.nanmin(within, initial=0.0))), highest)
    axes = Axes(curves, "logarithmic decrement", y_range=limits)
    caption = (
        "Logarithmic decrement of the modes up to twice the top speed, in the order of their frequencies at each "
        f"speed, where it is below {highest:g}. Below zero the machine is unstable; API RP 684 asks for 0.1 at least."
    )
    return Figure("stability", caption, [Panel("Stability map", RPM, [axes], wide=True)])
