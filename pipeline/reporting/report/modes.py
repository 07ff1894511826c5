"""Critical speeds, Campbell diagram and stability of the identified machine, in the terms of API RP 684."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from pipeline.data.noise import NOMINAL_95
from pipeline.data.operating import name_state
from pipeline.data.vibration_files import to_rpm
from pipeline.reporting.figures import BLACK, GREY, LOOKS
from pipeline.reporting.report.content import DASHES, FitContent, ReportContent
from pipeline.reporting.report.figure import Axes, Curve, Figure, Panel
from pipeline.reporting.report.section import Block, Paragraph, Section, Table, write_number
from pipeline.reporting.report.verdicts import list_reservations
from pipeline.units import RAD_S_PER_RPM

_POINTS, _HIGHEST_DECREMENT = 60, 1.5
"""Points of a mode, and what is damped so much that nobody asks."""
_ROUNDING = 1e-9
"""1/s."""
_RPM, _HERTZ = "rotor speed (rpm)", "frequency_std_hz"


def describe_modes(content: ReportContent) -> Section | None:
    """Critical speeds, Campbell diagram and stability map; None without a fit."""
    fit, identified = content.fit, content.files.get("prediction", {}).get("identified")
    if fit is None or identified is None:
        return None
    stability, rpm = identified["stability"], to_rpm(fit.modes.speeds)
    verdict = stability.get("verdict", "stable" if stability["stable"] else "unstable")
    said = {"stable": "stable", "not told": "at the edge of stability, its growth not told from none,"}.get(verdict)
    known = stability.get("largest_growth_std")  # of a machine at rest in a mode: rounding
    growth = write_number(stability["largest_growth"], known if known and known > _ROUNDING else None, 3)
    at = f" at {name_state(fit.operating)}" if fit.operating else ""
    text = f"The identified machine is {said or 'UNSTABLE'} from {rpm[0]:.6g} to {rpm[-1]:.6g} rpm{at}; "
    text += f"the largest growth rate is {growth} 1/s."
    least = stability["smallest_logarithmic_decrement"]
    if least is not None:
        decrement = write_number(least, stability.get("smallest_logarithmic_decrement_std"), 3)
        text += (
            f" The smallest logarithmic decrement is {decrement}, at {stability['at_rpm']:.6g} rpm (modes up to twice "
        )
        text += "the top speed)."
    text += (
        " A critical speed is where a damped natural frequency equals the rotor speed. In the sense of API RP 684 one "
    )
    text += "with an amplification factor below 2.5 is critically damped. "
    running = content.config.machine.prediction.speed_rpm
    text += f"Separation margins are from {running:.6g} rpm (machine.prediction.speed_rpm), in percent of it."
    told = Paragraph(text, warning=verdict == "unstable")
    blocks: list[Block] = [*list_reservations(content), told, *_warn_beyond(fit)]
    blocks.append(_list_critical_speeds(rpm, identified))
    figures = () if len(rpm) < 2 else (_draw_campbell(content, fit, identified), _draw_stability(content, fit))
    return Section("modes", "Critical speeds and stability", (*blocks, *figures))


def _warn_beyond(fit: FitContent) -> list[Paragraph]:
    """What lies outside the measured conditions."""
    rest = "the bands grow there, and rest on the model of the coefficients alone."
    return [Paragraph(f"{text[0].upper()}{text[1:]}: {rest}", warning=True) for text in fit.beyond]


def _list_critical_speeds(rpm: np.ndarray, identified: Mapping[str, Any]) -> Table | Paragraph:
    critical = identified["critical_speeds"]
    if not critical:
        return Paragraph(
            f"No damped natural frequency equals the rotor speed between {rpm[0]:.6g} and {rpm[-1]:.6g} rpm."
        )
    rows = []
    for number, mode in critical.items():
        decrement, known = mode["logarithmic_decrement"], mode.get("logarithmic_decrement_std")
        factor, factor_known = mode.get("amplification_factor"), mode.get("amplification_factor_std")
        if factor is None and decrement > 0:
            factor, factor_known = np.pi / decrement, None if known is None else np.pi * known / decrement**2
        margin, margin_known = mode.get("separation_margin_percent"), mode.get("separation_margin_percent_std")
        rows.append(
            [
                number,
                write_number(mode["rpm"], mode.get("rpm_std"), 6),
                write_number(decrement, known),
                write_number(factor, factor_known, 3),
                write_number(margin, margin_known, 3),
                write_number(mode.get("separation_margin_required_percent"), digits=3),
            ]
        )
    header = ["critical speed", "rpm", "log decrement", "amplification factor", "separation margin, %", "required, %"]
    return Table("Damped critical speeds", header, rows)


def _draw_campbell(content: ReportContent, fit: FitContent, identified: Mapping[str, Any]) -> Figure:
    rpm = to_rpm(fit.modes.speeds)
    frequency = fit.modes.frequency / RAD_S_PER_RPM
    shown = np.nanmin(frequency, axis=0, initial=np.inf) <= 2.2 * rpm[-1]
    curves = [
        Curve(
            rpm,
            frequency[:, k],
            f"mode {i + 1}",
            LOOKS[i % 8][0],
            DASHES[i % 4],
            band=_read_band(content, rpm, int(k), _HERTZ),
        )
        for i, k in enumerate(np.flatnonzero(shown))
    ]
    curves.append(Curve(rpm, rpm, "1X", BLACK, "solid", width=1.0))
    crossings = np.array([mode["rpm"] for mode in identified["critical_speeds"].values()])
    if len(crossings):
        curves.append(Curve(crossings, crossings, "critical speed", BLACK, "none", "o"))
    axes = Axes(tuple(curves), "frequency (cycles/min)", y_range=(0.0, 2.2 * float(rpm[-1])))
    panel = Panel("Campbell diagram", _RPM, (axes,), wide=True)
    return Figure(
        "campbell", "Modes in the order of their damped natural frequencies; over-damped ones have none.", (panel,)
    )


def _read_band(content: ReportContent, rpm: np.ndarray, mode: int, column: str) -> np.ndarray | None:
    """(U,) half the width of a mode's nominal 95 % band, in the unit of the figure; None where none is stated."""
    table = content.tables.get("modes")
    if table is None:
        return None
    rows = (table["system"] == "identified") & (table["mode"] == mode + 1)
    band = np.full(len(rpm), np.nan)
    at = np.abs(rpm[:, None] - table["speed_rpm"][rows]).argmin(axis=0)
    band[at] = NOMINAL_95 * table[column][rows] * (60.0 if column == _HERTZ else 1.0)
    return band if np.isfinite(band).any() else None


def _draw_stability(content: ReportContent, fit: FitContent) -> Figure:
    rpm = to_rpm(fit.modes.speeds)
    within = np.where(fit.modes.frequency <= 2.0 * fit.modes.speeds.max(), fit.modes.logarithmic_decrement, np.nan)
    curves = []
    shown = [k for k in range(within.shape[1]) if np.isfinite(within[:, k]).any()]
    for i, k in enumerate(shown):
        band = _read_band(content, rpm, k, "logarithmic_decrement_std")
        few = slice(None, None, max(1, len(rpm) // _POINTS))
        marks = Curve(rpm[few], within[few, k], f"mode {i + 1}", LOOKS[i % 8][0], "none", LOOKS[i % 8][1])
        curves.append(marks if band is None else replace(marks, band=band[few]))
    curves.append(Curve(rpm[[0, -1]], np.zeros(2), "limit of stability", GREY, "solid", width=1.0))
    limits = (min(-0.1, 1.1 * float(np.nanmin(within, initial=0.0))), _HIGHEST_DECREMENT)
    panel = Panel("Stability map", _RPM, (Axes(tuple(curves), "logarithmic decrement", y_range=limits),), wide=True)
    caption = "Logarithmic decrement of the modes up to twice the top speed, in the order of their frequencies at each "
    caption += (
        f"speed, where it is below {_HIGHEST_DECREMENT:g}. Below zero the machine is unstable; API RP 684 asks for "
    )
    caption += "0.1 at least."
    return Figure("stability", caption, (panel,))
