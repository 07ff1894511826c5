"""The results of an experiment: one screen of 40 lines and 100 columns at most (paths are not cut), and a picture."""

from __future__ import annotations

import textwrap
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.coefficients import COEFFICIENTS, is_direct, unit
from pipeline.config.machine import PredictionConfig
from pipeline.config.schema import Config
from pipeline.data.operating import find_nearest, split_states
from pipeline.data.sensors import NOMINAL_95
from pipeline.data.vibration_files import to_rpm
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
from pipeline.reporting.content import FitContent, ReportContent, name_channel
from pipeline.reporting.fit_tables import describe_verdicts, list_numbers
from pipeline.reporting.matplotlib_figures import write_figure
from pipeline.reporting.twin import describe_measured, draw_sizes, measure_sizes, show, summarize_modes
from pipeline.trust.misfit import describe_held_out, describe_readings, measure_misfit
from pipeline.twin.modes import Stability
from pipeline.twin.twin import Twin
from pipeline.units import RAD_S_PER_RPM
from pipeline.write_numbers import count, format_engineering, write_number, write_percent, write_rough

WIDTH = 100
_INDENT = " " * 13
_MOST_ROWS, _MOST_RUNS = 16, 6
"""All eight coefficients of two bearings; runs that are named."""


def write_summary(content: ReportContent, fit: FitContent, picture: Path) -> str:
    """Write the whole screen; it ends with a newline."""
    config, judged = content.config, content.machine_verdict
    whole = (judged["reservation"] or f"{judged['verdict']}: {judged['reason']}").rstrip(".")
    rotor, file = content.measurement.rotor, config.machine.rotor.file
    machine = (
        f"{rotor.n_nodes} nodes, {write_number(rotor.total_mass)} kg, bearings at {_name_nodes(rotor.bearing_nodes)}, "
        f"discs at {_name_nodes(rotor.disc_nodes)}" + (f", from '{file}'" if file else "")
    )
    numbers = [
        f"{number['label']} {write_number(number['value'], number['deviation'])} {number['unit']}"
        for number in list_numbers(fit.training.get("physical_numbers", {}), config)
    ]
    lines = [
        *_wrap(f"{config.name}: {config.description}", "", 1),
        "",
        *_wrap_entry("machine", machine),
        *_wrap_entry("data", describe_data(content, fit)),
        "",
        *_list_coefficients(config, fit),
        "",
        *(_wrap_entry("numbers", "; ".join(numbers)) if numbers else ()),
        *_wrap_entry("verdict", f"{whole}; {describe_verdicts(fit.training)}"),
        *_wrap_entry("fit", _describe_fit(fit.training)),
        *_wrap_entry("", _describe_run(content)),
        *_describe_twin(content, fit),
        f"{'picture':<{len(_INDENT)}}{picture}",
    ]
    return "\n".join(lines) + "\n"


def _describe_twin(content: ReportContent, fit: FitContent) -> list[str]:
    """What the machine does where nobody measured, or why nothing can be said of it."""
    if fit.twin is None:
        return _wrap_entry("missing", f"critical speeds, stability, prediction: {content.missing['twin']}")
    asked = content.config.machine.prediction
    modes: Mapping[str, Any] = summarize_modes(fit.twin.behaviour["identified"], asked.speed_rpm)
    rejected = "OF A REJECTED MODEL: " if content.machine_verdict["reservation"] else ""
    return [
        *_wrap_entry("critical", rejected + list_critical_speeds(fit, modes)),
        *_wrap_entry("stability", rejected + describe_stability(modes["stability"])),
        *_wrap_entry("prediction", rejected + _describe_prediction(asked, fit, fit.twin)),
        *(line for text in fit.beyond for line in _wrap_entry("beyond", f"{text}: the bands grow there")),
    ]


def _wrap_entry(name: str, text: str) -> list[str]:
    return _wrap(text, f"{name:<{len(_INDENT)}}", 3)


def _wrap(text: str, first: str, lines: int) -> list[str]:
    return textwrap.wrap(
        text, WIDTH, initial_indent=first, subsequent_indent=_INDENT, max_lines=lines, placeholder=" ..."
    )


def describe_data(content: ReportContent, fit: FitContent) -> str:
    """Say what was read: runs, speeds, states and channels."""
    data, baseline = content.dataset, content.config.data.baseline
    rpm, nodes = _list_speeds(fit), dict.fromkeys(node for node, _ in data.channels)
    states = [label for label, _ in split_states(data.speeds, data.operating)]
    at = f" at {_join(states)}" if data.operating else ""
    less = f", less the run {baseline}" if baseline else ""
    counts = zip(data.runs, data.present.sum(axis=0), strict=True)
    runs = data.runs if data.complete else [f"{run} at {count(int(n), 'point')}" for run, n in counts]
    more = f" and {len(data.runs) - _MOST_RUNS} more" if len(data.runs) > _MOST_RUNS else ""
    kind = "modelled" if fit.coefficients.compared else "measured"
    return (
        f"{kind}, {count(len(data.runs), 'run')} ({_join(runs[:_MOST_RUNS])}{more}){less}; "
        f"{count(len(rpm), 'speed')} from {rpm[0]:g} to {rpm[-1]:g} rpm{at}; {count(len(data.channels), 'channel')} at "
        f"{_name_nodes(nodes)}"
    )


def _list_speeds(fit: FitContent) -> np.ndarray:
    """(U,) the different speeds of the data in rpm."""
    return to_rpm(np.unique(fit.answer.measurement.dataset.speeds))


def _find_speed(config: Config, fit: FitContent) -> int:
    """The index among these of the one nearest to that of the prediction."""
    return int(np.abs(_list_speeds(fit) - config.machine.prediction.speed_rpm).argmin())


def _pick_columns(config: Config, fit: FitContent) -> list[tuple[str, int]]:
    """Heads and points of the table: up to three speeds, or up to three states at the prediction's speed."""
    answer, rpm, at = fit.coefficients.identified, fit.coefficients.rpm, _find_speed(config, fit)
    if config.model.kind == "constant":
        return [("at every speed", 0)]
    if not answer.operating:
        return [(f"at {rpm[s]:g} rpm", s) for s in sorted({0, at, len(rpm) - 1})]
    states = split_states(answer.speeds, answer.operating)
    shown = [states[i] for i in sorted({0, (len(states) - 1) // 2, len(states) - 1})]
    return [(label, int(points[np.abs(rpm[points] - _list_speeds(fit)[at]).argmin()])) for label, points in shown]


def _list_coefficients(config: Config, fit: FitContent) -> list[str]:
    """A row a bearing and coefficient, at up to three speeds or states; constants have one value."""
    shown, columns = fit.coefficients, _pick_columns(config, fit)
    several = len(columns) > 1 and bool(shown.identified.operating)
    speed = f" at {_list_speeds(fit)[_find_speed(config, fit)]:g} rpm" if several else ""
    known = " +- one standard deviation" if shown.stated else ""
    against = f", and the median error over the {'points' if several else 'speeds'}" if shown.compared else ""
    heads = "".join(f"{head:>22}" for head, _ in columns) + (f"{'error %':>12}" if shown.compared else "")
    lines = [f"identified{speed}{known}{against}", f"{'':20}{heads}"]
    rows = [(b, name) for b, names in enumerate(shown.unknowns) for name in names]
    for b, name in rows[:_MOST_ROWS]:
        head, c = f"  {f'node {shown.identified.nodes[b]} {name}, {unit(name)}':<18}", COEFFICIENTS.index(name)
        answer = shown.identified
        pairs = [(float(answer.values[b, s, c]), float(answer.spread[b, s, c])) for _, s in columns]
        cells = [f"{format_engineering(*pair):>22}" for pair in pairs]
        error = float(np.median(shown.measure_errors(b, name)))
        lines.append("".join([head, *cells, f"{write_rough(error):>12}" if shown.compared else ""]))
    if len(rows) > _MOST_ROWS:
        lines.append(f"  and {len(rows) - _MOST_ROWS} more in 'identified_coefficients.csv'")
    return lines


def _describe_fit(training: Mapping[str, Any]) -> str:
    """Say what the fit leaves over, and how well it predicts what was held out."""
    readings, fit, kind = describe_readings(training), training.get("fit", {}), "held_out_speeds"
    explained = not fit or measure_misfit(fit).explained()
    held_out = [describe_held_out(kind, fit[kind])] if kind in fit else []
    return "; ".join([readings["distance"], *([] if explained else [readings["explain"]]), *held_out])


def _describe_run(content: ReportContent) -> str:
    r, measured, predicted = content.example
    name, share = content.dataset.runs[r], float(np.linalg.norm(predicted - measured) / np.linalg.norm(measured))
    what = f"held-out run {name} predicted" if content.held_out(r) else f"run {name}, which was fitted, reproduced"
    return f"{what} to {write_percent(share)} (root mean square, {count(measured.shape[1], 'channel')})"


def list_critical_speeds(fit: FitContent, modes: Mapping[str, Any]) -> str:
    """Name the critical speeds with their decrements, and between which speeds they were sought; at a single speed the
    natural frequencies.

    Those of so much damping that API 617 asks for no margin (:func:`pipeline.twin.modes.require_separation`) are named
    apart.
    """
    rpm, margin, critical = _list_speeds(fit), "separation_margin_required_percent", modes["critical_speeds"]
    natural = [
        f"{show(m, 'hz')} Hz ({'; the responses alone show '.join(filter(None, said))})"
        for m in modes.get("modes", {}).values()
        for said in [(show(m, "logarithmic_decrement"), describe_measured(m))]
    ]
    if natural:
        return f"at {rpm[0]:g} rpm{fit.state} natural frequencies (logarithmic decrements) {_join(natural)}"
    damped = [show(mode, "rpm") for mode in critical.values() if mode[margin] == 0]
    sharp = [
        f"{show(mode, 'rpm')} rpm (logarithmic decrement {show(mode, 'logarithmic_decrement')})"
        for mode in critical.values()
        if mode[margin] != 0
    ]
    rest = f"; critically damped (amplification factor below 2.5): {_join(damped)} rpm" if damped else ""
    return f"{_join(sharp)}, between {rpm[0]:g} and {rpm[-1]:g} rpm{fit.state}{rest}"


def describe_stability(stability: Mapping[str, Any]) -> str:
    """Say whether the identified machine is stable, and the smallest decrement; as identified, where its band holds
    zero."""
    growth, least = show(stability, "largest_growth"), stability["smallest_logarithmic_decrement"]
    near = 0.0 < (least or 0.0) <= NOMINAL_95 * (stability.get("smallest_logarithmic_decrement_std") or 0.0)
    where = " of a mode that hardly oscillates, or lies above twice the top speed" if (least or 0.0) > 0 else ""
    verdict = {
        Stability.STABLE: "stable at all speeds" + " as identified" * near,
        Stability.NOT_TOLD: f"not told from unstable, growth {growth} 1/s{where}",
        Stability.UNSTABLE: f"UNSTABLE, growth {growth} 1/s{where}",
    }[Stability(stability["verdict"])]
    if least is None or stability["at_rpm"] is None:
        return f"{verdict}; no whirling mode below twice the top speed"
    decrement = show(stability, "smallest_logarithmic_decrement")
    at = f"{stability['at_rpm']:g} rpm" + ", within its band of zero" * near
    return f"{verdict}; smallest logarithmic decrement {decrement} at {at}"


def _describe_prediction(asked: PredictionConfig, fit: FitContent, twin: Twin) -> str:
    """The vibration at the prediction's speed, and the largest of all speeds."""
    identified, at = twin.vibration["identified"], twin.at
    rpm, (size, deviation) = to_rpm(identified.speeds), measure_sizes(identified)
    weights = [f"{1e6 * unbalance.magnitude:g} g mm at node {unbalance.node}" for unbalance in asked.unbalances]
    acting = _join([*weights, *(f"{force.magnitude:g} N at node {force.node}" for force in asked.forces)])
    shown = zip("xy", size[at].tolist(), deviation[at].tolist(), strict=True)
    phrases = [f"{direction} {write_number(value, known, 5)} um" for direction, value, known in shown]
    s, d = np.unravel_index(size.argmax(), size.shape)
    return (
        f"node {identified.node} at {rpm[at]:g} rpm{fit.state}: {', '.join(phrases)} (zero-to-peak); "
        f"at most {write_number(float(size[s, d]))} um in {'xy'[d]} at {rpm[s]:g} rpm; under {acting}"
    )


def _join(things: Iterable[object]) -> str:
    return ", ".join(map(str, things)) or "none"


def _name_nodes(nodes: Iterable[int]) -> str:
    every = sorted(nodes)
    if len(every) > 3 and np.ptp(every) == len(every) - 1:
        return f"nodes {every[0]} to {every[-1]}"
    return f"node{'s' if len(every) != 1 else ''} {_join(every)}"


_AMPLITUDE = "amplitude (µm, zero-to-peak)"


def draw_summary(path: Path, content: ReportContent, fit: FitContent) -> Path:
    """Stiffness, damping, one run at one probe, and the predicted unbalance response, all over the speed.

    Where data have operating conditions, it is at the measured state that is nearest to the prediction's.
    """
    data = content.dataset
    label, points = find_nearest(data.speeds, data.operating, fit.operating)
    beside = f", {label}" if data.operating else ""
    panels = [
        *(draw_kind(fit.coefficients.at(points), letter, beside) for letter in "kc"),
        _draw_run(content, fit, points, beside),
        *([_draw_response(fit.twin, fit.state)] if fit.twin else []),
    ]
    return write_figure(path, Figure("summary", content.config.name, panels))


def draw_kind(shown: Coefficients, letter: str, beside: str) -> Panel:
    """A colour a coefficient, a marker a bearing; what is known is dashed."""
    some, nodes, (scale, measured_in) = shown.choose(letter), shown.identified.nodes, UNITS[letter]
    names = some or [name for name in COEFFICIENTS if name[0] == letter and is_direct(name)]
    curves = [
        curve
        for name, colour in zip(names, (BLUE, GREEN, PURPLE, ORANGE), strict=False)
        for b, node in enumerate(nodes)
        for curve in shown.draw(b, name, f"{name}, node {node}", (colour, LOOKS[b % 5][1]), scale)
    ]
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
    return Panel(f"predicted: node {node}, an unbalance that no run has{at}", RPM, [axes], legend=True)
