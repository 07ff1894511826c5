"""The digital twin: its vibration, modes and critical speeds in files, on screen and in figures (paper, Figure 6)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.config.schema import Config
from pipeline.data.operating import list_columns, name_state
from pipeline.data.sensors import NOMINAL_95
from pipeline.data.vibration_files import to_rpm
from pipeline.reporting.blocks import (
    BLACK,
    BLUE,
    GREY,
    LOOKS,
    MICROMETRES,
    NOTHING,
    ORANGE,
    RPM,
    Axes,
    Curve,
    Figure,
    Panel,
    mark,
    mark_beyond,
    reach,
)
from pipeline.reporting.console import say, table
from pipeline.reporting.matplotlib_figures import write_figure, write_panel
from pipeline.twin.mode_deviations import Behaviour
from pipeline.twin.modes import amplify, find_reached, follow_modes, require_separation
from pipeline.twin.prediction import PredictedVibration, sample_motion
from pipeline.units import RAD_S_PER_RPM
from pipeline.write_numbers import write_number, write_rough

RAD_S_PER_HERTZ = 2.0 * np.pi


def summarize_modes(behaviour: Behaviour, running_rpm: float) -> dict[str, object]:
    """Critical speeds and stability for ``prediction.json``; margins are from the running speed, in percent of it.

    Standard deviations stand beside (``*_std``) where the fit states them.
    """
    margin = behaviour.margin
    stability: dict[str, object] = {
        "stable": margin.stable,
        "verdict": behaviour.stability.value,
        "largest_growth": margin.largest_growth,
        "smallest_logarithmic_decrement": margin.smallest_logarithmic_decrement,
        "at_rpm": None if margin.at_speed is None else margin.at_speed / RAD_S_PER_RPM,
    }
    if behaviour.deviations is not None:
        growth, decrement = behaviour.margin_deviations
        stability |= {"largest_growth_std": growth, "smallest_logarithmic_decrement_std": decrement}
    return {
        "critical_speeds": {
            f"{i + 1}": _summarize_critical(behaviour, i, running_rpm) for i in range(len(behaviour.critical))
        },
        "stability": stability,
        **({"modes": _summarize_natural(behaviour)} if len(behaviour.modes.speeds) == 1 else {}),
    }


def _summarize_natural(behaviour: Behaviour) -> dict[str, dict[str, float]]:
    """The modes at the only speed there is, up to what excited them; beside each, what the responses alone show, and
    whether the decrements agree: they differ by less than the nominal 95 % band of the difference."""
    modes, (hz_std, decrement_std) = behaviour.modes, list_deviations(behaviour)
    numbers = {
        "hz": modes.frequency[0] / RAD_S_PER_HERTZ,
        "hz_std": hz_std[0] / RAD_S_PER_HERTZ,
        "logarithmic_decrement": modes.logarithmic_decrement[0],
        "logarithmic_decrement_std": decrement_std[0],
    }
    if len(behaviour.shown):
        hz, spread, decrement, decrement_spread = behaviour.shown.T
        limit = NOMINAL_95 * np.hypot(decrement_spread, np.nan_to_num(decrement_std[0]))
        numbers |= {
            "measured_hz": hz / RAD_S_PER_HERTZ,
            "measured_hz_std": spread / RAD_S_PER_HERTZ,
            "measured_logarithmic_decrement": decrement,
            "measured_logarithmic_decrement_std": decrement_spread,
            "decrements_apart": np.abs(decrement - modes.logarithmic_decrement[0]) / limit,  # agree up to 1
        }
    return {
        f"{i + 1}": {key: float(values[i]) for key, values in numbers.items() if np.isfinite(values[i])}
        for i in np.flatnonzero(find_reached(modes)[0]).tolist()
    }


def describe_measured(mode: Mapping[str, Any]) -> str:
    """The logarithmic decrement of a mode that responses show without a model, and whether the model agrees; "" where
    they show none."""
    if "measured_hz" not in mode:
        return ""
    agrees = "which agrees" if mode["decrements_apart"] <= 1 else "which DIFFERS: rotor or bearings lack something"
    return f"{show(mode, 'measured_logarithmic_decrement')} at {show(mode, 'measured_hz')} Hz, {agrees}"


def _summarize_critical(behaviour: Behaviour, i: int, running_rpm: float) -> dict[str, float | None]:
    critical, deviations = behaviour.critical[i], behaviour.deviations
    rpm, decrement = critical.speed / RAD_S_PER_RPM, critical.logarithmic_decrement
    speed_std, decrement_std = (0.0, 0.0) if deviations is None else deviations.of_critical(critical)
    factor, factor_std = amplify(decrement, decrement_std) or (None, None)
    stated = {
        "rpm_std": speed_std / RAD_S_PER_RPM,
        "logarithmic_decrement_std": decrement_std,
        "amplification_factor_std": factor_std,
        "separation_margin_percent_std": 100.0 * speed_std / RAD_S_PER_RPM / running_rpm,
    }
    return {
        "rpm": rpm,
        "logarithmic_decrement": decrement,
        "amplification_factor": factor,
        "separation_margin_percent": 100.0 * abs(rpm / running_rpm - 1.0),
        "separation_margin_required_percent": require_separation(factor, rpm > running_rpm),
        **({} if deviations is None else stated),
    }


def list_deviations(behaviour: Behaviour) -> tuple[np.ndarray, np.ndarray]:
    """(S, K) standard deviations of frequencies (rad/s) and logarithmic decrements; NaN where the fit states none."""
    stated, nothing = behaviour.deviations, np.full_like(behaviour.modes.frequency, np.nan)
    return (nothing, nothing) if stated is None else (stated.frequency, stated.logarithmic_decrement)


def follow_lines(behaviour: Behaviour) -> list[np.ndarray]:
    """(S, K) frequencies (rad/s) and logarithmic decrements, each before its deviation, by the shapes of the modes; NaN
    above twice the top speed."""
    modes, deviations, order = behaviour.modes, list_deviations(behaviour), follow_modes(behaviour.modes)
    values = (modes.frequency, deviations[0], modes.logarithmic_decrement, deviations[1])
    reached = [np.where(find_reached(modes), value, np.nan) for value in values]
    return [np.take_along_axis(value, order, axis=1) for value in reached]


def measure_sizes(predicted: PredictedVibration, scale: float = MICROMETRES) -> tuple[np.ndarray, np.ndarray]:
    """(S, 2) amplitudes, zero-to-peak, and their standard deviations; NaN where the fit states none. They are in um, or
    in m by a ``scale`` of 1."""
    size = scale * np.abs(predicted.displacement)
    return size, np.full_like(size, np.nan) if predicted.deviation is None else scale * predicted.deviation


def tabulate_modes(behaviour: Mapping[str, Behaviour], operating: Mapping[str, float]) -> dict[str, np.ndarray]:
    """Columns of ``modes.csv``: a row a system, speed and mode that oscillates, by ascending frequency.

    ``operating`` are the conditions (SI) of all rows.
    """
    systems = []
    for name, machine in behaviour.items():
        modes, (frequency_std, decrement_std) = machine.modes, list_deviations(machine)
        present = ~np.isnan(modes.frequency)
        speed, mode = np.nonzero(present)
        systems.append(
            {
                "system": np.full(len(speed), name),
                "speed_rpm": to_rpm(modes.speeds)[speed],
                "mode": mode + 1,
                "frequency_hz": modes.frequency[present] / RAD_S_PER_HERTZ,
                "logarithmic_decrement": modes.logarithmic_decrement[present],
                "frequency_std_hz": frequency_std[present] / RAD_S_PER_HERTZ,
                "logarithmic_decrement_std": decrement_std[present],
                **_repeat_conditions(operating, len(speed)),
            }
        )
    return {name: np.concatenate([rows[name] for rows in systems]) for name in systems[0]}


def _repeat_conditions(operating: Mapping[str, float], count: int) -> dict[str, np.ndarray]:
    """A column a condition, named with its unit."""
    return list_columns({name: np.full(count, value) for name, value in operating.items()})


def tabulate_vibration(
    vibration: Mapping[str, PredictedVibration], operating: Mapping[str, float]
) -> dict[str, np.ndarray]:
    """Columns of ``prediction.csv``: amplitudes (zero-to-peak, m) and phases over the speed.

    ``operating`` are the conditions (SI) of all rows.
    """
    columns = {"speed_rpm": to_rpm(next(iter(vibration.values())).speeds)}
    columns |= _repeat_conditions(operating, len(columns["speed_rpm"]))
    for name, predicted in vibration.items():
        for d, direction in enumerate("xy"):
            columns[f"{direction}_{name}_amplitude_m"] = np.abs(predicted.displacement[:, d])
            if predicted.deviation is not None:
                columns[f"{direction}_{name}_amplitude_std_m"] = predicted.deviation[:, d]
            columns[f"{direction}_{name}_phase_deg"] = np.degrees(np.angle(predicted.displacement[:, d]))
    return columns


def print_twin(
    config: Config,
    summary: Mapping[str, Any],
    vibration: Mapping[str, PredictedVibration],
    at: int,
    operating: Mapping[str, float],
) -> None:
    """The vibration at the prediction's speed and ``operating`` conditions (SI), the stability, each critical speed."""
    prediction, rpm = config.machine.prediction, config.machine.prediction.speed_rpm
    state = f", at {name_state(operating)}" if operating else ""
    rows, criticals = [], []
    for name, predicted in vibration.items():
        size, known_to = measure_sizes(predicted)
        shown = [write_number(*known, 5) for known in zip(size[at].tolist(), known_to[at].tolist(), strict=True)]
        rows.append([name, *shown, show(summary[name]["stability"], "smallest_logarithmic_decrement")])
        criticals += [[name, *cells] for cells in list_critical(summary[name]["critical_speeds"])]
    table(
        f"{config.name}: node {prediction.node} under {prediction.what} never seen{state} (+- standard deviation)",
        ["system", f"x at {rpm:g} rpm, um", f"y at {rpm:g} rpm, um", "smallest log decrement"],
        rows,
    )
    table(f"critical speeds{state}; separation is that from {rpm:g} rpm", ["system", *CRITICAL], criticals)
    natural = [
        [name, *(show(mode, key) for key in ("hz", "logarithmic_decrement")), describe_measured(mode)]
        for name in vibration
        for mode in summary[name].get("modes", {}).values()
    ]
    table(f"natural frequencies at {rpm:g} rpm{state}", ["system", *NATURAL], natural)
    if not criticals and not natural:
        say(f"critical speeds{state}: none in the range of speeds")
    if "displacement" in summary:
        errors = (
            f"{direction} {write_rough(e['mean_error_percent'])} % mean, {write_rough(e['max_error_percent'])} % max"
            for direction, e in summary["displacement"].items()
        )
        say(f"error of the displacement over all speeds: {'; '.join(errors)}")


NATURAL = ("Hz", "log decrement", "log decrement that the responses alone show")
"""Columns of a table of modes at one speed."""
CRITICAL = {
    "rpm": "rpm",
    "log decrement": "logarithmic_decrement",
    "amplification factor": "amplification_factor",
    "separation, %": "separation_margin_percent",
    "API 617 asks, %": "separation_margin_required_percent",
}
"""Columns of a table of critical speeds, and their keys in ``prediction.json``."""


def list_critical(critical: Mapping[str, Mapping[str, Any]]) -> list[list[str]]:
    """A row a critical speed below ``CRITICAL``."""
    return [[show(mode, key) for key in CRITICAL.values()] for mode in critical.values()]


def show(entry: Mapping[str, Any], key: str) -> str:
    """A number with its deviation; "none" where there is none."""
    digits = 2 if key.endswith("required_percent") else 5
    return "none" if entry[key] is None else write_number(entry[key], entry.get(f"{key}_std"), digits)


def _draw(name: str, x: np.ndarray, y: np.ndarray, colour: str, deviation: np.ndarray = NOTHING) -> Curve:
    if name == "modelled":
        return Curve(x, y, name, colour)
    return mark(x, y, "predicted by the twin", colour, deviation=deviation)


def draw_time(path: Path, vibration: Mapping[str, PredictedVibration], at: int, state: str = "") -> Path:
    """Figure 6 (a) and (b): x and y of the node over two turns; ``state`` names the operating conditions."""
    motions = {name: sample_motion(p.displacement[at], p.frequencies[at]) for name, p in vibration.items()}
    rows = [
        [_draw(name, 1e3 * time, MICROMETRES * motion[:, d], colour) for name, (time, motion) in motions.items()]
        for d, colour in enumerate((BLUE, ORANGE))
    ]
    return write_panel(
        path,
        Panel(
            f"{_name_place(vibration, at, state)}, unbalance never seen in training",
            "time (ms)",
            [Axes(row, f"{direction}-displacement (µm)") for direction, row in zip("xy", rows, strict=True)],
            wide=True,
        ),
    )


def _name_place(vibration: Mapping[str, PredictedVibration], at: int, state: str) -> str:
    predicted = vibration["identified"]
    return ", ".join(filter(None, (f"node {predicted.node} at {to_rpm(predicted.speeds)[at]:g} rpm", state)))


def draw_orbit(path: Path, vibration: Mapping[str, PredictedVibration], at: int, state: str = "") -> Path:
    """The orbit of the node at one speed; ``state`` names the operating conditions."""
    turns = {n: sample_motion(p.displacement[at], p.frequencies[at], turns=1.0)[1] for n, p in vibration.items()}
    curves = [_draw(name, MICROMETRES * turn[:, 0], MICROMETRES * turn[:, 1], BLUE) for name, turn in turns.items()]
    title, axes = f"orbit of {_name_place(vibration, at, state)}", Axes(curves, "y-displacement (µm)")
    return write_panel(path, Panel(title, "x-displacement (µm)", [axes], equal=True, wide=True))


def draw_response(path: Path, vibration: Mapping[str, PredictedVibration], state: str = "") -> Path:
    """Amplitude and phase over all speeds, and the error of the prediction; ``state`` names the conditions."""
    identified, panels = vibration["identified"], []
    rpm, sizes = to_rpm(identified.speeds), {name: measure_sizes(predicted) for name, predicted in vibration.items()}
    phases = {name: np.degrees(np.unwrap(np.angle(p.displacement), axis=0)) for name, p in vibration.items()}
    errors = [identified.error_percent(vibration["modelled"])] if "modelled" in vibration else []
    for d, (direction, colour) in enumerate(zip("xy", (BLUE, ORANGE), strict=True)):
        above = [_draw(name, rpm, size[:, d], colour, deviation[:, d]) for name, (size, deviation) in sizes.items()]
        below = [_draw(name, rpm, phase[:, d], colour) for name, phase in phases.items()]
        axes = [
            Axes(above, "amplitude (µm)", scale="log"),
            Axes(below, "phase (deg)"),
            *(
                Axes([Curve(rpm, np.maximum(error[:, d], 1e-14), "", GREY)], "error (%)", scale="log")
                for error in errors
            ),
        ]
        panels.append(Panel(", ".join(filter(None, (f"{direction} of node {identified.node}", state))), RPM, axes))
    return write_figure(path, Figure("response", "", panels))


def draw_sizes(vibration: Mapping[str, PredictedVibration], scale: float = MICROMETRES) -> list[Curve]:
    """Amplitudes in x and y over the speed (um, or m by a ``scale`` of 1), with their bands, beside the truth if known.

    Beside a truth, which is a line, markers are predicted.
    """
    curves: list[Curve] = []
    for name, predicted in vibration.items():
        rpm, (sizes, deviations) = to_rpm(predicted.speeds), measure_sizes(predicted, scale)
        for d, (direction, colour, dash) in enumerate((("x", BLUE, "solid"), ("y", ORANGE, "dash"))):
            if name == "modelled":
                curves.append(Curve(rpm, sizes[:, d], f"{direction} modelled", colour))
                continue
            drawn = mark(rpm, sizes[:, d], f"{direction} predicted", colour, "os"[d], deviation=deviations[:, d])
            curves.append(drawn if "modelled" in vibration else replace(drawn, dash=dash, marker="", every=1))
    return curves


def draw_modes(behaviour: Mapping[str, Behaviour], state: str = "", highest: float = 1.5) -> Figure:
    """The Campbell diagram, and below it the stability map: decrements below the ``highest``.

    What is damped more, nobody asks for. Modes up to twice the top speed, a colour a mode; the modelled machine as
    lines, the identified one as markers. ``state`` names the operating conditions.
    """
    speeds, margin = behaviour["identified"].modes.speeds, behaviour["identified"].margin
    highest_seen = max(2.0 * float(speeds.max()), behaviour["identified"].modes.highest)
    rpm, top, beside = to_rpm(speeds), highest_seen / RAD_S_PER_RPM, f", {state}" if state else ""
    frequencies = [Curve(rpm, rpm, "1X", BLACK, width=1.0)]
    decrements: list[Curve] = []
    for name, machine in behaviour.items():
        frequency, frequency_std, *decrement = follow_lines(machine)
        followed = ((frequency / RAD_S_PER_RPM, frequency_std / RAD_S_PER_RPM), decrement)
        for i, k in enumerate(np.flatnonzero(np.isfinite(frequency).any(axis=0)).tolist()):
            look = LOOKS[i % len(LOOKS)]
            for curves, (values, deviation) in zip((frequencies, decrements), followed, strict=True):
                known = Curve(rpm, values[:, k], "modelled", look[0])
                drawn = mark(rpm, values[:, k], f"mode {i + 1}", *look, deviation=deviation[:, k])
                curves.append(known if name == "modelled" else drawn)
    critical = np.array([mode.speed for mode in behaviour["identified"].critical]) / RAD_S_PER_RPM
    frequencies += [Curve(critical, critical, "critical speed", BLACK, "none", "*", full=True, size=8)][: len(critical)]
    values = np.concatenate([NOTHING, *(curve.y for curve in decrements)])
    ends = np.concatenate([values, *(curve.edges(False)[2] for curve in decrements)])
    # What API RP 684 asks for stays in sight.
    limits = (min(-0.1, 1.1 * reach(values)[0]), min(highest, max(0.2, 1.1 * reach(ends)[1])))
    decrements.append(Curve(rpm[[0, -1]], np.zeros(2), "limit of stability", GREY, width=1.0))
    at, least = np.array([[margin.at_speed], [margin.smallest_logarithmic_decrement]], dtype=float)  # NaN: not drawn
    decrements.append(Curve(at / RAD_S_PER_RPM, least, "smallest decrement", BLACK, "none", "*", size=8))
    decrements += mark_beyond(decrements, limits[0], np.inf)
    return Figure(
        "campbell",
        "Damped natural frequencies of the modes up to twice the top speed, followed by their shapes (over-damped ones "
        f"have none), and their logarithmic decrements where these are below {highest:g}. Below zero the machine is "
        "unstable; API RP 684 asks for 0.1 at least."
        + " Bands hold the nominal 95 %." * any(curve.edges(False)[0].size for curve in decrements)
        + " Lines are modelled, markers predicted by the twin." * ("modelled" in behaviour),
        [
            Panel(f"{title}{beside}", RPM, [axes], wide=True)
            for title, axes in (
                ("Campbell diagram", Axes(frequencies, "frequency (cycles/min)", y_range=(0.0, top))),
                ("Stability map", Axes(decrements, "logarithmic decrement", y_range=limits)),
            )
        ],
        columns=1,
    )
