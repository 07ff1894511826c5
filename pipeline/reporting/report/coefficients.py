"""Stiffness and damping over speed with their bands, beside what else is known of them.

With operating conditions it is a panel a coefficient and a line a state, cold to hot; beside the measured states stands
that of the prediction, measured or not.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from pipeline.coefficients import COEFFICIENTS
from pipeline.data.operating import name_state, split_states
from pipeline.reporting.coefficient_figures import (
    KINDS,
    UNITS,
    Coefficients,
    draw_bearing,
    draw_state_panels,
    list_states,
)
from pipeline.reporting.figure import GREEN, LOOKS, Curve, Figure, Panel
from pipeline.reporting.report.content import FitContent, ReportContent
from pipeline.reporting.tables import Block, Paragraph, Section, Table
from pipeline.write_numbers import write_number

_MOST_TABLES, _ROWS = 4, 5


def describe_coefficients(content: ReportContent, fit: FitContent) -> Section:
    """Figures over speed and a table."""
    text = "Forces on the shaft are -(K q + C q'); kxy is the force in x for a displacement in y."
    if not fit.coefficients.stated:
        text += " The loss of this fit states no deviations, so there are no bands: loss=response has them."
    else:
        text += (
            " Numbers are given with one standard deviation, bands are nominal 95 % intervals. They count the noise,"
            " what is fitted of the model, and the usual tolerances of rotor, weights and probes, as the verdicts do."
        )
    if fit.coefficients.compared:
        text += " The data were modelled, so that the true coefficients are known; the fit did not read them."
    states = _list_states(fit)
    tabled = [states[i] for i in np.unique(np.linspace(0, len(states) - 1, _MOST_TABLES).round().astype(int))]
    shown: list[Block] = [_list(*state) for state in tabled]
    shown += [_draw(content, fit, states, letter) for letter in "kc"]
    return Section("coefficients", "Stiffness and damping", (Paragraph(text), *shown, *_compare(content, fit)))


def _list_states(fit: FitContent) -> list[tuple[str, Coefficients]]:
    """The measured states, and that of the prediction where it is none of them; one without conditions."""
    measured, asked = list_states(fit.coefficients), name_state(fit.twin.operating)
    if any(
        label == asked
        for label, _ in split_states(fit.coefficients.identified.speeds, fit.coefficients.identified.operating)
    ):
        return measured
    return [*measured, (f"{asked} (not measured)", fit.at_conditions)]


def _draw(content: ReportContent, fit: FitContent, states: list[tuple[str, Coefficients]], letter: str) -> Figure:
    shown, over = fit.coefficients, f"{KINDS[letter].capitalize()} over the speed: "
    if shown.identified.operating:
        asked = GREEN if states[-1][1] is fit.at_conditions else ""
        panels = draw_state_panels(states, letter, False, asked) if shown.choose(letter) else []
        over += "a panel a coefficient, a colour a state of the operating conditions"
    else:
        panels = [
            _add_reference(draw_bearing(shown, b, letter), content.reference, node, letter)
            for b, node in enumerate(shown.identified.nodes)
        ]
        over += "markers are identified (dashed where known)"
        over += ", filled markers the reference" if content.reference else ""
    over += ", bands hold the nominal 95 %" if shown.stated else ""
    over += ", black lines are the modelled truth" if shown.compared else ""
    return Figure(KINDS[letter], over + ".", panels)


def _add_reference(panel: Panel, reference: Mapping[str, np.ndarray], node: int, letter: str) -> Panel:
    """The panel of a bearing with the coefficients that are compared with."""
    curves, names = list(panel.axes[0].curves), [name for name in COEFFICIENTS if name[0] == letter]
    for name, (colour, marker) in zip(names, LOOKS, strict=False):
        if name in reference:
            rows = reference["bearing_node"] == node
            given = UNITS[letter][0] * reference[name][rows]
            rpm, label = reference["speed_rpm"][rows], f"{name} reference"
            curves.append(Curve(rpm, given, label, colour, "none", marker, full=True))
    return replace(panel, axes=[replace(panel.axes[0], curves=curves)])


def _list(label: str, shown: Coefficients) -> Table:
    """The identified coefficients of a state at a few speeds; constants once."""
    places = [(b, name, COEFFICIENTS.index(name)) for b, names in enumerate(shown.unknowns) for name in names]
    constant = all(np.ptp(shown.identified.values[b, :, c]) == 0 for b, _, c in places)
    at = [0] if constant else np.unique(np.linspace(0, len(shown.rpm) - 1, _ROWS).round().astype(int)).tolist()
    rows = []
    for b, name, c in places:
        scale, unit = UNITS[name[0]]
        values, deviations = scale * shown.identified.values[b, at, c], scale * shown.deviation[b, at, c]
        cells = [write_number(*pair, 5) for pair in zip(values.tolist(), deviations.tolist(), strict=True)]
        rows.append([f"node {shown.identified.nodes[b]} {name}, {unit}", *cells])
    heads = ["at every speed"] if constant else [f"{write_number(rpm, digits=6)} rpm" for rpm in shown.rpm[at]]
    stated = " +- one standard deviation" if shown.stated else ""
    return Table(f"Identified coefficients{f' at {label}' if label else ''}{stated}", ["coefficient", *heads], rows)


def _compare(content: ReportContent, fit: FitContent) -> list[Table]:
    """Identified against the reference, in percent, and in standard deviations where they are stated."""
    reference, shown = content.reference, fit.at_conditions
    if not reference:
        return []
    rows, rpm = [], shown.rpm
    for b, names in enumerate(shown.unknowns):
        at = reference["bearing_node"] == shown.identified.nodes[b]
        inside = at & (reference["speed_rpm"] >= rpm[0]) & (reference["speed_rpm"] <= rpm[-1])
        for name in names:
            if name not in reference or not inside.any():
                continue
            c, speeds, given = COEFFICIENTS.index(name), reference["speed_rpm"][inside], reference[name][inside]
            off = np.interp(speeds, rpm, shown.identified.values[b, :, c]) - given
            deviation = np.interp(speeds, rpm, shown.deviation[b, :, c])
            with np.errstate(divide="ignore", invalid="ignore"):
                medians = [_take_median(100 * off / np.abs(given)), _take_median(np.abs(off) / deviation)]
            cells = [write_number(median, digits=3) for median in medians]
            cells[1] = cells[1] if shown.stated else ""
            rows.append([f"node {shown.identified.nodes[b]} {name}", f"{len(speeds)}", *cells])
    header = ["coefficient", "speeds in common", "difference, % (median)", "difference over its deviation (median)"]
    name = content.origin.get("reference", "the reference")
    at = f" at {name_state(fit.twin.operating)}" if fit.twin.operating else ""
    return [Table(f"Identified{at} less reference ({name})", header, rows).without_blank()]


def _take_median(values: np.ndarray) -> float:
    """The median of those that are numbers; NaN where none is."""
    known = values[~np.isnan(values)]
    return float(np.median(known)) if len(known) else float("nan")
