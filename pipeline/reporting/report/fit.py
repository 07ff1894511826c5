"""What was identified, and how the model follows the readings.

Stiffness and damping over speed with their bands, beside what else is known of them. With operating conditions it is a
panel a coefficient and a line a state, cold to hot; beside the measured states stands that of the prediction, measured
or not. Of each probe the residuals, what was held out, and the tests of the fit.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from pipeline.coefficients import COEFFICIENTS
from pipeline.data.operating import name_state, space_evenly, split_states
from pipeline.reporting.blocks import (
    GREEN,
    LOOKS,
    NOTHING,
    RPM,
    Axes,
    Block,
    Curve,
    Figure,
    Panel,
    Table,
    mark,
    mark_beyond,
    reach,
)
from pipeline.reporting.coefficient_figures import (
    KINDS,
    UNITS,
    Coefficients,
    draw_bearing,
    draw_state_panels,
    list_states,
)
from pipeline.reporting.content import FitContent, ReportContent
from pipeline.reporting.fit_tables import list_parameters
from pipeline.reporting.measured_figures import AMPLITUDE
from pipeline.trust.misfit import describe_readings, measure_misfit
from pipeline.write_numbers import write_number, write_rough

_MOST_TABLES, _ROWS = 4, 5


def describe_coefficients(content: ReportContent, fit: FitContent) -> list[Block]:
    """Figures over speed and a table."""
    tolerances = ", and the usual tolerances of rotor, weights and probes" * content.config.identify.usual_tolerances
    stated = (
        "Numbers are given with one standard deviation, bands are nominal 95 % intervals. They count the noise, the "
        f"misfit, and what is fitted of the model{tolerances}, as the verdicts do."
    )
    text = (
        "Forces on the shaft are -(K q + C q'); kxy is the force in x for a displacement in y. "
        + (
            stated
            if fit.coefficients.stated
            else "This fit weighs no noise and states no deviations, so there are no bands."
        )
        + " The data were modelled, so that the true coefficients are known; the fit did not read them."
        * fit.coefficients.compared
    )
    states = _list_states(fit)
    return [
        text,
        *(_list_coefficients(*states[i]) for i in space_evenly(len(states), _MOST_TABLES)),
        *(_draw_values(content, fit, states, letter) for letter in "kc"),
        *_compare(content, fit),
    ]


def _list_states(fit: FitContent) -> list[tuple[str, Coefficients]]:
    """The measured states, and that of the prediction where it is none of them; one without conditions."""
    measured, asked = list_states(fit.coefficients), name_state(fit.operating)
    if any(
        label == asked
        for label, _ in split_states(fit.coefficients.identified.speeds, fit.coefficients.identified.operating)
    ):
        return measured
    return [*measured, (f"{asked} (not measured)", fit.at_conditions)]


def _draw_values(
    content: ReportContent, fit: FitContent, states: list[tuple[str, Coefficients]], letter: str
) -> Figure:
    shown = fit.coefficients
    if shown.identified.operating:
        asked = GREEN if states[-1][1] is fit.at_conditions else ""
        panels = draw_state_panels(states, letter, False, asked) if shown.choose(letter) else []
        said = "a panel a coefficient, a colour a state of the operating conditions"
    else:
        panels = [
            _add_reference(draw_bearing(shown, b, letter), content.reference, node, letter)
            for b, node in enumerate(shown.identified.nodes)
        ]
        filled = ", filled markers the reference" if content.reference else ""
        said = f"markers are identified (dashed where known){filled}"
    stated = ", bands hold the nominal 95 %" if shown.stated else ""
    true = ", black lines are the modelled truth" if shown.compared else ""
    return Figure(KINDS[letter], f"{KINDS[letter].capitalize()} over the speed: {said}{stated}{true}.", panels)


def _add_reference(panel: Panel, reference: Mapping[str, np.ndarray], node: int, letter: str) -> Panel:
    """The panel of a bearing with the coefficients that are compared with."""
    names, rows = [name for name in COEFFICIENTS if name[0] == letter], reference.get("bearing_node", NOTHING) == node
    curves = [
        Curve(
            reference["speed_rpm"][rows],
            UNITS[letter][0] * reference[name][rows],
            f"{name} reference",
            colour,
            "none",
            marker,
            full=True,
        )
        for name, (colour, marker) in zip(names, LOOKS, strict=False)
        if name in reference
    ]
    return replace(panel, axes=[replace(panel.axes[0], curves=[*panel.axes[0].curves, *curves])])


def _list_coefficients(label: str, shown: Coefficients) -> Table:
    """The identified coefficients of a state at a few speeds; constants once."""
    places = [(b, name, COEFFICIENTS.index(name)) for b, names in enumerate(shown.unknowns) for name in names]
    constant = all(np.ptp(shown.identified.values[b, :, c]) == 0 for b, _, c in places)
    at = np.array([0]) if constant else space_evenly(len(shown.rpm), _ROWS)
    rows = []
    for b, name, c in places:
        scale, unit = UNITS[name[0]]
        values, deviations = (scale * table[b, at, c] for table in (shown.identified.values, shown.identified.spread))
        lost = [" *" * bool(each) for each in shown.lost[b, at, c]]
        cells = [
            write_number(float(value), float(spread), 5) + star
            for value, spread, star in zip(values, deviations, lost, strict=True)
        ]
        rows.append([f"node {shown.identified.nodes[b]} {name}, {unit}", *cells])
    heads = ["at every speed"] if constant else [f"{write_number(rpm, digits=6)} rpm" for rpm in shown.rpm[at]]
    some = any(shown.lost[b, at, c].any() for b, _, c in places)
    stated = " +- one standard deviation" * shown.stated + "; * not determined by these data" * some
    return Table(f"Identified coefficients{f' at {label}' if label else ''}{stated}", ["coefficient", *heads], rows)


def _compare(content: ReportContent, fit: FitContent) -> list[Table]:
    """Identified against the reference, in percent, and in standard deviations where they are stated."""
    import pandas as pd

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
            deviation = np.interp(speeds, rpm, shown.identified.spread[b, :, c])
            with np.errstate(divide="ignore", invalid="ignore"):
                differences = pd.DataFrame({"off": 100 * off / np.abs(given), "over": np.abs(off) / deviation})
            off_by, over = (write_number(median, digits=3) for median in differences.median())
            rows.append([f"node {shown.identified.nodes[b]} {name}", f"{len(speeds)}", off_by, over * shown.stated])
    name = content.origin.get("reference", "the reference")
    return [
        Table(
            f"Identified{fit.state} less reference ({name})",
            ["coefficient", "speeds in common", "difference, % (median)", "difference over its deviation (median)"],
            rows,
        ).without_blank()
    ]


def describe_fit(content: ReportContent, fit: FitContent) -> list[Block]:
    """Readings and model of every probe over speed with their residuals; model parameters, before and after."""
    figure = _draw_residuals(content, fit, [r for r in content.shown_runs if not content.held_out(r)], "fit")
    caption = "Uncertain numbers of the model, change against what was stated"
    parameters = list_parameters(
        caption, fit.training.get("model_parameters", {}), spell=lambda kind: kind.replace("_", " ")
    )
    return [_write_quality(fit.training), _list_probes(content, fit), figure, *[parameters] * bool(parameters.rows)]


def describe_held_out(content: ReportContent, fit: FitContent) -> list[Block]:
    """Runs and speeds that the fit did not see."""
    rows = [
        [
            what,
            write_rough(entry["model_error_percent"]),
            entry["rival"],
            write_rough(entry["rival_error_percent"]),
        ]
        for what, entry in content.files.get("metrics", {}).get("held_out", {}).items()
    ]
    held = [r for r in content.shown_runs if content.held_out(r)]
    if not rows and not held:
        return [
            "No run was held out of the fit; speeds were, and their loss stands above."
            if "held_out_loss" in fit.training
            else "No run and no speed was held out of the fit."
        ]
    return [
        "The fit did not see these readings. Beside the model stands what needs no bearing model at all.",
        Table(
            "Root mean square of the error over that of the readings",
            ["held out", "model, error %", "without a model", "its error, %"],
            rows,
        ),
        *([_draw_residuals(content, fit, held, "held-out")] if held else []),
    ]


def _write_quality(training: Mapping[str, Any]) -> str:
    outcome, told = str(training.get("outcome", "unknown")).replace("_", " "), describe_readings(training)
    if "fit" not in training:
        told["explain"] = "its loss weighs no noise, so there is no chi-square"
    elif not measure_misfit(training["fit"]).explained():
        told["explain"] += ". What is left is systematic, and the deviations are too small"
    return " ".join(f"{text[0].upper()}{text[1:]}." for text in (f"the fit ended as: {outcome}", *told.values()))


def _list_probes(content: ReportContent, fit: FitContent) -> Table:
    """Root mean square of the residual of each probe, in percent and in deviations."""
    rows, fitted = [], [r for r in range(len(content.dataset.runs)) if not content.held_out(r)]
    mask = content.dataset.present[:, fitted]
    for probe in content.shown_probes:
        measured = probe.read(content.dataset.displacement[..., fitted])
        rest = measured - probe.read(fit.predicted[..., fitted])
        percent = 100 * np.linalg.norm(rest[mask]) / np.linalg.norm(measured)
        over = ""
        if content.weighs_noise:
            squared = np.abs(rest / probe.read_noise(fit.noise[..., fitted]))[mask] ** 2
            over = write_number(float(np.sqrt(squared.mean())), digits=3)
        rows.append([probe.name, write_number(float(percent), digits=3), over])
    return Table(
        "Fitted runs, root mean square over speeds and runs",
        ["probe", "residual, % of the readings", f"residual over its {_name_noise(content)}"],
        rows,
    ).without_blank()


def _draw_residuals(content: ReportContent, fit: FitContent, runs: list[int], name: str) -> Figure:
    stated, panels = content.weighs_noise, []
    for probe in content.shown_probes:
        above, below = [], []
        every = probe.read(content.dataset.displacement), probe.read(fit.predicted), probe.read_noise(fit.noise)
        for r, points, traced in content.traces(*runs):
            measured, predicted, noise = (vectors[:, r] for vectors in every)
            usual = np.linalg.norm(measured) / np.count_nonzero(measured) ** 0.5 / 100
            size = np.abs(measured - predicted) / (noise if stated else usual)
            look, rpm = dict(traced), content.rpm[points]
            run = look.pop("label")
            above += [
                mark(rpm, np.abs(measured[points]), f"{run} measured", look["colour"], count=40),
                Curve(rpm, np.abs(predicted[points]), f"{run} model", **look),
            ]
            below.append(Curve(rpm, size[points], "", **look))
        unit = f"residual / {_name_noise(content)}" if stated else "residual (%)"
        most = reach(np.concatenate([curve.y for curve in below]))[1]
        below += mark_beyond(below, 0.0, most)
        rest = Axes(below, unit, y_range=(0.0, 1.08 * most))
        panels.append(Panel(probe.name, RPM, [Axes(above, AMPLITUDE, quantity="amplitude"), rest]))
    share = (
        f"over the root mean square of its {_name_noise(content)}"
        if stated
        else "in percent of the root mean square reading"
    )
    caption = f"Above, amplitudes: markers measured, lines the model. Below, the size of the complex residual {share}."
    return Figure(name, caption, panels)


def _name_noise(content: ReportContent) -> str:
    """What residuals are compared with."""
    return "drift" if content.measurement.drift else "noise"
