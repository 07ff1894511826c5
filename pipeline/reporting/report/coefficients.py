"""Stiffness and damping over speed with their bands, beside what else is known of them."""

from __future__ import annotations

import numpy as np

from pipeline.coefficients import COEFFICIENTS
from pipeline.data.noise import NOMINAL_95
from pipeline.data.operating import name_state
from pipeline.data.vibration_files import to_rpm
from pipeline.reporting.figures import BLACK, LOOKS
from pipeline.reporting.identified_figure import UNITS
from pipeline.reporting.report.content import FitContent, ReportContent
from pipeline.reporting.report.figure import Axes, Curve, Figure, Panel
from pipeline.reporting.report.section import Paragraph, Section, Table, write_number
from pipeline.reporting.report.states import draw_states, list_at_states

_KINDS = {"k": "stiffness", "c": "damping"}
_ROWS = 5
_DASHES = ("solid", "dash", "dashdot", "longdash")


def describe_coefficients(content: ReportContent) -> Section | None:
    """Figures over speed and a table; None without a fit."""
    fit = content.fit
    if fit is None:
        return None
    text = "Forces on the shaft are -(K q + C q'); kxy is the force in x for a displacement in y."
    if fit.deviation is None:
        text += " The loss of this fit states no deviations, so there are no bands: loss=response has them."
    else:
        text += (
            " Numbers are given with one standard deviation, bands are nominal 95 % intervals. They count the noise,"
            " what is fitted of the model, and the usual tolerances of rotor, weights and probes, as the verdicts do."
        )
    if fit.modelled is not None:
        text += " The data were modelled, so that the true coefficients are known; the fit did not read them."
    shown: tuple[Table | Figure, ...]
    if fit.bearings.operating:
        shown = (*list_at_states(content, fit), *(draw_states(content, fit, letter) for letter in "kc"))
    else:
        shown = (_list(content, fit), *(_draw(content, fit, letter) for letter in "kc"))
    return Section("coefficients", "Stiffness and damping", (Paragraph(text), *shown, *_compare(content, fit)))


def _draw(content: ReportContent, fit: FitContent, letter: str) -> Figure:
    scale, unit = UNITS[letter]
    panels = []
    for b, node in enumerate(fit.bearings.nodes):
        curves = []
        names = [name for name in COEFFICIENTS if name[0] == letter]
        for name, (colour, marker) in zip(names, LOOKS, strict=False):
            curves += _draw_one(content, fit, (b, name), (colour, marker), scale)
        panels.append(
            Panel(f"bearing at node {node}", "rotor speed (rpm)", (Axes(tuple(curves), f"{_KINDS[letter]} ({unit})"),))
        )
    caption = f"{_KINDS[letter].capitalize()} over speed: coloured lines are identified (dotted where known)"
    caption += "" if fit.deviation is None else ", bands hold the nominal 95 %"
    caption += "" if fit.modelled is None else ", thin black lines are the modelled truth"
    caption += "" if content.reference is None else ", markers are the reference"
    return Figure(_KINDS[letter], caption + ".", tuple(panels))


def _draw_one(
    content: ReportContent, fit: FitContent, coefficient: tuple[int, str], look: tuple[str, str], scale: float
) -> list[Curve]:
    b, name = coefficient
    c, colour, rpm = COEFFICIENTS.index(name), look[0], content.rpm
    values = fit.bearings.values[b, :, c] * scale
    identified = name in fit.unknowns[b]
    if not identified and not values.any():
        return []
    stated = None if fit.deviation is None or not identified else fit.deviation[b, :, c] * scale
    band = None if stated is None else NOMINAL_95 * stated
    marker = "o" if len(rpm) == 1 else ""
    curves = [Curve(rpm, values, name, colour, _DASHES[c % 4] if identified else "dot", marker, band=band, width=2.0)]
    if fit.modelled is not None and identified:
        true = fit.modelled.values[b, :, c] * scale
        curves.append(Curve(rpm, true, "modelled", BLACK, width=0.8))
    if content.reference is not None and name in content.reference:
        rows = content.reference["bearing_node"] == fit.bearings.nodes[b]
        given = content.reference[name][rows] * scale
        curves.append(Curve(content.reference["speed_rpm"][rows], given, f"{name} reference", colour, "none", look[1]))
    return curves


def _list(content: ReportContent, fit: FitContent) -> Table:
    constant = all(
        np.ptp(fit.bearings.values[b, :, COEFFICIENTS.index(n)]) == 0
        for b, unknown in enumerate(fit.unknowns)
        for n in unknown
    )
    at = [0] if constant else np.unique(np.linspace(0, len(content.rpm) - 1, _ROWS).round().astype(int)).tolist()
    rows = []
    for b, names in enumerate(fit.unknowns):
        for name in names:
            c, (scale, unit) = COEFFICIENTS.index(name), UNITS[name[0]]
            cells = []
            for s in at:
                deviation = None if fit.deviation is None else float(fit.deviation[b, s, c]) * scale
                cells.append(write_number(float(fit.bearings.values[b, s, c]) * scale, deviation, 5))
            rows.append([f"node {fit.bearings.nodes[b]} {name}, {unit}", *cells])
    heads = ["at every speed"] if constant else [f"{content.rpm[s]:.6g} rpm" for s in at]
    return Table(
        "Identified coefficients" + ("" if fit.deviation is None else " ± one standard deviation"),
        ["coefficient", *heads],
        rows,
    )


def _compare(content: ReportContent, fit: FitContent) -> list[Table]:
    """Identified against the reference, in percent, and in standard deviations where they are stated."""
    reference = content.reference
    if reference is None:
        return []
    rows, bearings, deviation = [], fit.at_conditions, fit.at_deviation
    rpm = to_rpm(bearings.speeds)
    for b, names in enumerate(fit.unknowns):
        at = reference["bearing_node"] == fit.bearings.nodes[b]
        inside = at & (reference["speed_rpm"] >= rpm[0]) & (reference["speed_rpm"] <= rpm[-1])
        for name in names:
            if name not in reference or not inside.any():
                continue
            c, speeds = COEFFICIENTS.index(name), reference["speed_rpm"][inside]
            identified, given = np.interp(speeds, rpm, bearings.values[b, :, c]), reference[name][inside]
            off = identified - given
            with np.errstate(divide="ignore", invalid="ignore"):
                percent = float(np.nanmedian(100 * off / np.abs(given)))
            cells = [f"node {fit.bearings.nodes[b]} {name}", f"{len(speeds)}", write_number(percent, digits=3)]
            if deviation is not None:
                share = np.abs(off) / np.interp(speeds, rpm, deviation[b, :, c])
                cells.append(write_number(float(np.nanmedian(share)), digits=3))
            rows.append(cells)
    header = ["coefficient", "speeds in common", "difference, % (median)"]
    header += ["difference over its deviation (median)"] if fit.deviation is not None else []
    name = content.origin.get("reference", "the reference")
    at = f" at {name_state(fit.operating)}" if fit.operating else ""
    return [Table(f"Identified{at} less reference ({name})", header, rows)]
