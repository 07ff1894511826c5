"""Stiffness and damping over speed and operating conditions: a panel a coefficient, a line a state, cold to hot.

Beside the measured states stands that of the prediction, measured or not.
"""

from __future__ import annotations

import numpy as np

from pipeline.coefficients import COEFFICIENTS
from pipeline.data.noise import NOMINAL_95
from pipeline.data.operating import name_state, split_states
from pipeline.data.vibration_files import to_rpm
from pipeline.reporting.figures import BLACK, GREEN, KINDS
from pipeline.reporting.identified_figure import UNITS
from pipeline.reporting.report.content import FitContent, ReportContent
from pipeline.reporting.report.figure import Axes, Curve, Figure, Panel
from pipeline.reporting.report.section import Table, write_number
from pipeline.reporting.state_figures import colour_states, pick_states
from pipeline.rotor.bearing_table import BearingTable

_MOST_TABLES, _ROWS = 4, 5
_State = tuple[str, BearingTable, np.ndarray | None]
"""Name, coefficients at its speeds, and their deviations (B, U, 8)."""


def list_states(fit: FitContent) -> list[_State]:
    """The measured states, and that of the prediction where it is none of them."""
    every = [
        (label, fit.bearings.at(points), None if fit.deviation is None else fit.deviation[:, points])
        for label, points in pick_states(fit.bearings.speeds, fit.bearings.operating)
    ]
    asked = name_state(fit.operating)
    if any(label == asked for label, _ in split_states(fit.bearings.speeds, fit.bearings.operating)):
        return every
    return [*every, (f"{asked} (not measured)", fit.at_conditions, fit.at_deviation)]


def draw_states(content: ReportContent, fit: FitContent, letter: str) -> Figure:
    """A panel an identified coefficient of each bearing."""
    states, (scale, unit) = list_states(fit), UNITS[letter]
    measured = sum(bearings is not fit.at_conditions for _, bearings, _ in states)
    looks = [(colour, "solid") for colour in colour_states(measured)] + [(GREEN, "dash")]
    panels = []
    for b, node in enumerate(fit.bearings.nodes):
        for name in COEFFICIENTS:
            if name[0] != letter or name not in fit.unknowns[b]:
                continue
            c, curves = COEFFICIENTS.index(name), []
            for (label, bearings, deviation), (colour, dash) in zip(states, looks, strict=False):
                rpm, values = to_rpm(bearings.speeds), scale * bearings.values[b, :, c]
                band = None if deviation is None else NOMINAL_95 * scale * deviation[b, :, c]
                marker = "o" if len(rpm) == 1 else ""
                curves.append(Curve(rpm, values, label, colour, dash, marker, band=band, width=2.0))
            if fit.modelled is not None:
                for _, points in pick_states(fit.bearings.speeds, fit.bearings.operating):
                    true = scale * fit.modelled.values[b, points, c]
                    curves.append(Curve(content.rpm[points], true, "modelled", BLACK, "dot", width=1.0))
            axes = Axes(tuple(curves), f"{name} ({unit})")
            panels.append(Panel(f"{name}, bearing at node {node}", "rotor speed (rpm)", (axes,)))
    caption = f"{KINDS[letter].capitalize()} over the speed, a line a state of the operating conditions"
    caption += "" if fit.deviation is None else ", with nominal 95 % bands"
    caption += "" if fit.modelled is None else "; black dots are the modelled truth"
    return Figure(KINDS[letter], caption + ".", tuple(panels))


def list_at_states(content: ReportContent, fit: FitContent) -> list[Table]:
    """A table a state: the prediction's, and measured ones from the first to the last."""
    states = list_states(fit)
    if len(states) > _MOST_TABLES:
        states = [states[i] for i in np.linspace(0, len(states) - 1, _MOST_TABLES).round().astype(int)]
    return [_list_state(fit, state) for state in states]


def _list_state(fit: FitContent, state: _State) -> Table:
    label, bearings, deviation = state
    at = np.unique(np.linspace(0, len(bearings.speeds) - 1, _ROWS).round().astype(int)).tolist()
    rows = []
    for b, names in enumerate(fit.unknowns):
        for name in names:
            c, (scale, unit) = COEFFICIENTS.index(name), UNITS[name[0]]
            cells = [
                write_number(
                    scale * float(bearings.values[b, s, c]),
                    None if deviation is None else scale * float(deviation[b, s, c]),
                    5,
                )
                for s in at
            ]
            rows.append([f"node {bearings.nodes[b]} {name}, {unit}", *cells])
    heads = [f"{rpm:.6g} rpm" for rpm in to_rpm(bearings.speeds)[at]]
    stated = "" if deviation is None else " ± one standard deviation"
    return Table(f"Identified coefficients at {label}{stated}", ["coefficient", *heads], rows)
